"""Every result below a folder as one report: HTML, Markdown, LaTeX, CSV and Parquet."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from slipcar.baselines.files import write_atomically
from slipcar.envs.extras import install
from slipcar.evaluation.report import text as report_text
from slipcar.evaluation.report.document import FILE, read_document
from slipcar.evaluation.report.page import Section, html

if TYPE_CHECKING:
    import pandas as pd

#: Kinds of documents in the order in which a report shows them; others follow.
KINDS = (
    "compare", "learning", "suite-random", "suite-slip", "suite-horizon", "frontier", "reproduce",
)  # fmt: skip
#: What is there without pyarrow.
NO_PARQUET = f"no Parquet files: they need pyarrow, {install('report')}"


class Found(NamedTuple):
    """Results of a folder: those that could be read, in order, and what is wrong with others."""

    sections: list[Section]
    problems: list[str]


def find(folder: Path) -> Found:
    """Read every `document.json` in `folder` and below.

    Raises:
        ValueError: if `folder` is none, holds no results, or only such as cannot be read.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder")
    paths = sorted(_documents(folder))
    if not paths:
        raise ValueError(
            f"no results in {folder} or below: a folder of results holds {FILE}, which "
            "`slipcar compare`, `slipcar frontier` and the others write"
        )
    read, problems = [], []
    for path in paths:
        try:
            read.append((path.parent, read_document(path.parent)))
        except (ValueError, OSError) as error:
            problems.append(str(error))
    if not read:
        raise ValueError("; ".join(problems))
    read.sort(key=lambda pair: KINDS.index(pair[1].kind) if pair[1].kind in KINDS else len(KINDS))
    sections = []
    for where, document in read:
        name = where.relative_to(folder).as_posix()
        sections.append(Section(document, where, document.kind if name == "." else name))
    return Found(sections, problems)


def _documents(folder: Path) -> Iterator[Path]:
    """Files of results, not looking into hidden folders."""
    for where, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        if FILE in files:
            yield Path(where) / FILE


def write(found: Found, out: Path) -> tuple[list[Path], list[str]]:
    """Write `out` (HTML), its Markdown and LaTeX beside it, and the frames in `NAME-data`.

    Args:
        found: what to show.
        out: the page; its suffix is replaced for the others.

    Returns:
        The files written, and what a user must be told.
    """
    texts = {
        out: html(found.sections, found.problems),
        out.with_suffix(".md"): markdown(found.sections, out.parent),
        out.with_suffix(".tex"): latex(found.sections),
    }
    written, notes = [], []
    for path, text in texts.items():
        write_atomically(path, text.encode())
        written.append(path)
    data = out.with_name(f"{out.stem}-data")
    for section in found.sections:
        for name, frame in section.document.frames.items():
            stem = f"{re.sub(r'[^A-Za-z0-9._-]+', '-', section.name)}-{name}"
            written.append(data / f"{stem}.csv")
            write_atomically(written[-1], frame.to_csv().encode())
            try:
                content = parquet(frame)
            except ImportError:
                notes = [NO_PARQUET]
                continue
            written.append(data / f"{stem}.parquet")
            write_atomically(written[-1], content)
    return written, notes


def parquet(frame: pd.DataFrame) -> bytes:
    """A frame as a Parquet file, its index as a column; columns of mixed types as text.

    Raises:
        ImportError: without pyarrow.
    """
    import pyarrow as pa

    flat = frame.reset_index() if frame.index.name else frame
    content = io.BytesIO()
    try:
        flat.to_parquet(content, engine="pyarrow", index=False)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        mixed = [name for name in flat if flat[name].dtype == "object"]
        content = io.BytesIO()
        flat.astype(dict.fromkeys(mixed, str)).to_parquet(content, engine="pyarrow", index=False)
    return content.getvalue()


def markdown(sections: Sequence[Section], beside: Path) -> str:
    """All documents in Markdown; figures are linked relative to the folder `beside`."""
    parts = ["# slipcar report"]
    for section in sections:
        parts.append(f"## {report_text.prose(section.document.title)} ({section.name})")
        parts.append(section.document.markdown().rstrip())
        for figure in section.document.figures:
            where = os.path.relpath(section.folder / f"{figure.stem}.png", beside)
            caption = report_text.prose(figure.caption).replace("]", r"\]")
            parts.append(f"![{caption}](<{Path(where).as_posix()}>)")
    return "\n\n".join(parts) + "\n"


_PREAMBLE = r"""\documentclass[a4paper]{article}
\usepackage[T1]{fontenc}
\usepackage[landscape,margin=15mm]{geometry}
\usepackage{booktabs}
\begin{document}
\footnotesize
"""


def latex(sections: Sequence[Section]) -> str:
    r"""All tables as a document that LaTeX compiles; each is fit for `\input` by itself."""
    parts = [_PREAMBLE]
    for section in sections:
        document = section.document
        parts += [rf"\section{{{report_text.tex(document.title)}}}", ""]
        parts += [report_text.tex(document.setting), "", document.latex()]
        parts += [f"{report_text.tex(note)}\n" for note in document.notes]
        parts += [r"\clearpage", ""]
    return "\n".join([*parts, r"\end{document}", ""])

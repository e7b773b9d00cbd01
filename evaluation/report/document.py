"""What a command of the evaluation has to show, as plain data: the source of every rendering.

A :class:`Document` holds tables (text, and the numbers to sort by), figures (file names), raw
numbers and where they come from. Terminal, Markdown, LaTeX and the HTML page are made of it, and
`document.json` brings it back, so a report needs neither controllers nor planner.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.baselines.files import write_atomically
from slipcar.evaluation.report import text as report_text
from slipcar.evaluation.report.table import Table

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group

#: Of document.json; raised when a reader of an older one would misunderstand it.
FORMAT = 1
#: The file that a folder of results is recognised by.
FILE = "document.json"


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure in the folder.

    Attributes:
        stem: its file's name without suffix; PNG, PDF and SVG lie in the folder.
        caption: what it shows.
    """

    stem: str
    caption: str


@dataclasses.dataclass(frozen=True)
class Document:
    """What a command of the evaluation has to show: the source of terminal, Markdown, LaTeX, HTML.

    Attributes:
        kind: "compare", "frontier", "suite-random", "suite-slip", "suite-horizon", "reproduce",
            "learning".
        title: of the section.
        setting: a sentence or two on what was run.
        tables: in order.
        notes: what a reader must be told: failed rows, warnings.
        figures: in order.
        frames: raw numbers by name, the main one `table`; each is written as NAME.csv.
        provenance: versions, machine, date, commit.
        scene: what an animation needs (see :func:`slipcar.evaluation.report.scene.scene`), or None.
    """

    kind: str
    title: str
    setting: str
    tables: tuple[Table, ...]
    notes: tuple[str, ...]
    figures: tuple[Figure, ...]
    frames: Mapping[str, pd.DataFrame]
    provenance: Mapping[str, Any]
    scene: Mapping[str, Any] | None = None

    def terminal(self, tables: int | None = None, sentences: Sequence[str] = ()) -> Group:
        """For a terminal, to be printed by a rich console, which it fits.

        Args:
            tables: only the first so many; None prints all.
            sentences: what the tables say, below them.
        """
        return report_text.terminal(self, tables, sentences)

    def markdown(self) -> str:
        """The setting, the tables, the notes and the provenance in Markdown."""
        return report_text.markdown(self)

    def latex(self) -> str:
        r"""The tables in LaTeX; they need `\usepackage{booktabs}`."""
        return report_text.latex(self)

    def to_json(self) -> str:
        """All of it; :func:`from_json` reads it back."""
        data = {
            "format": FORMAT,
            **{key: getattr(self, key) for key in ("kind", "title", "setting", "notes")},
            "tables": [_table_to_dict(table) for table in self.tables],
            "figures": [dataclasses.asdict(figure) for figure in self.figures],
            "provenance": plain(self.provenance),
            "frames": {name: _frame_to_dict(frame) for name, frame in self.frames.items()},
            "scene": plain(self.scene),
        }
        return json.dumps(data, ensure_ascii=False, allow_nan=False) + "\n"

    def save(self, folder: str | Path) -> list[Path]:
        """Write `table.md`, each frame as CSV, `table.tex` and `document.json`.

        Each file is whole or absent. A frame `times` takes what differs from run to run, so that
        `table.csv` is the same bytes wherever the same is computed.

        Args:
            folder: made if it does not exist.

        Returns:
            The files written.
        """
        texts = {
            "table.md": self.markdown(),
            **{f"{name}.csv": frame.to_csv() for name, frame in self.frames.items()},
            "table.tex": self.latex(),
            FILE: self.to_json(),
        }
        return write_texts(Path(folder), texts)


def read_document(folder: str | Path) -> Document:
    """What :meth:`Document.save` wrote into `folder`.

    Raises:
        ValueError: for a file of another format or that is damaged, naming it.
        OSError: if there is none, or it cannot be read.
    """
    path = Path(folder) / FILE
    try:
        return from_json(path.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    except ValueError as error:
        raise ValueError(f"{path} {error}") from error


def from_json(text: str) -> Document:
    """A document from :meth:`Document.to_json`.

    Raises:
        ValueError: for another format or text that is no document.
    """
    try:
        data = json.loads(text)
    except ValueError as error:
        raise ValueError(f"is damaged: {error}") from error
    found = data.get("format") if isinstance(data, dict) else None
    if found != FORMAT:
        raise ValueError(
            f"has format {found!r}, and this slipcar reads {FORMAT}: write it again with the "
            "command that made it"
        )
    try:
        return Document(
            **{key: _typed(key, data[key], str) for key in ("kind", "title", "setting")},
            notes=tuple(_typed("note", note, str) for note in _typed("notes", data["notes"], list)),
            tables=tuple(_table_from_dict(table) for table in data["tables"]),
            figures=tuple(
                Figure(_file_name(figure["stem"]), _typed("caption", figure["caption"], str))
                for figure in data["figures"]
            ),
            frames={
                _file_name(name): _frame_from_dict(frame) for name, frame in data["frames"].items()
            },
            provenance=_provenance(data["provenance"]),
            scene=None if data["scene"] is None else _typed("scene", data["scene"], dict),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"is damaged: {type(error).__name__}: {error}") from error


def _typed(what: str, value: Any, *types: type) -> Any:
    if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
        wanted = " or ".join(kind.__name__ for kind in types)
        raise TypeError(f"{what} must be {wanted}, not {value!r:.80}")
    return value


def _file_name(name: Any) -> str:
    """A report writes and reads files that are called so: none may lie elsewhere."""
    if not re.fullmatch(r"\w[^/\\:\x00-\x1f]*", _typed("name", name, str)):
        raise ValueError(f"a frame or figure must be named like a file, not {name!r:.80}")
    return str(name)


def _provenance(data: Any) -> dict[str, Any]:
    """Facts of any names; those that renderings take apart are what these take them for."""
    found = dict(_typed("provenance", data, dict))
    _typed("versions", found.get("versions") or {}, dict)
    _typed("commit", found.get("commit") or "", str)
    return found


def _table_to_dict(table: Table) -> dict[str, Any]:
    return {**plain(dataclasses.asdict(table)), "bold": sorted(table.bold)}


def _table_from_dict(data: dict[str, Any]) -> Table:
    return Table(
        caption=_typed("caption", data["caption"], str),
        headers=tuple(_typed("header", header, str) for header in data["headers"]),
        cells=tuple(tuple(_typed("cell", cell, str) for cell in row) for row in data["cells"]),
        values=tuple(
            tuple(_typed("value", value, float, int, type(None)) for value in row)
            for row in data["values"]
        ),
        bold=frozenset((int(i), int(j)) for i, j in data["bold"]),
    )


def _frame_to_dict(frame: pd.DataFrame) -> dict[str, Any]:
    """Columns with their types; floats that JSON cannot say (nan, inf) as their names.

    Raises:
        ValueError: for a frame whose rows or columns have several levels of names.
    """
    if frame.index.nlevels > 1 or frame.columns.nlevels > 1:
        raise ValueError(f"a frame of a document has one name a row, not {frame.index.names}")
    return {
        "index": {"name": frame.index.name, "values": [_spelt(value) for value in frame.index]},
        "columns": [
            {
                "name": str(name),
                "dtype": str(frame[name].dtype),
                "values": [_spelt(value) for value in frame[name]],
            }
            for name in frame
        ],
    }


def _spelt(value: Any) -> Any:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    return value


def _frame_from_dict(data: dict[str, Any]) -> pd.DataFrame:
    import pandas as pd

    def read(values: list[Any]) -> list[Any]:
        return [float(value["float"]) if isinstance(value, dict) else value for value in values]

    index = pd.Index(read(data["index"]["values"]), name=data["index"]["name"])
    columns = {
        column["name"]: pd.Series(read(column["values"]), index=index, dtype=column["dtype"])
        for column in data["columns"]
    }
    return pd.DataFrame(columns, index=index)


def plain(value: Any) -> Any:
    """Lists, dicts, text and numbers of it; JSON has no NaN and no infinity: None."""
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(part) for part in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_texts(folder: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write files, name -> text, into a folder that is made if need be; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, text in texts.items():
        path = folder / name
        write_atomically(path, text.encode())
        written.append(path)
    return written

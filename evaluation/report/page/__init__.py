"""Results as one HTML page that needs nothing else: no network, no server, no other file.

Tables, figures and downloads are in the page itself; its script only adds sorting, zooming and
animation, so it can be read and printed without. Text is escaped by the template, figures are
images (nothing in an SVG can run), and the page's own policy forbids every connection and every
script but its own.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from slipcar.evaluation.report import text as report_text
from slipcar.evaluation.report.document import Document, Figure, plain
from slipcar.evaluation.report.table import Table

__all__ = ["Section", "html"]

#: Raw numbers larger than this are left beside the page [bytes].
_LARGEST_DOWNLOAD = 2_000_000
#: What facts of a document's provenance are called.
_FACTS = {
    "date": "computed",
    "commit": "commit",
    "code": "digest of the code",
    "cpu": "processor",
    "cpu_count": "processors",
    "os": "system",
    "python": "Python",
    "versions": "packages",
}


@dataclasses.dataclass(frozen=True)
class Section:
    """One document of a page.

    Attributes:
        document: what is shown.
        folder: where its figures lie.
        name: tells it from others of its kind, also in names of files: "compare".
    """

    document: Document
    folder: Path
    name: str


def html(sections: Sequence[Section], problems: Sequence[str] = ()) -> str:
    """The page.

    Args:
        sections: in order.
        problems: results that could not be read, one line each.

    Returns:
        HTML in which every resource is embedded.
    """
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    script, style = _asset("page.js"), _asset("page.css")
    return environment.from_string(_asset("page.html")).render(
        sections=[_shown(i, section) for i, section in enumerate(sections, start=1)],
        problems=problems,
        style=style,
        script=script,
        policy=_policy(script),
    )


def _asset(name: str) -> str:
    return resources.files(__name__).joinpath(name).read_text(encoding="utf-8")


def _policy(script: str) -> str:
    """What a browser is to allow: this script, styles, embedded images. No connection at all."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        "default-src 'none'; base-uri 'none'; form-action 'none'; img-src data:; "
        f"style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    )


def _shown(number: int, section: Section) -> dict[str, Any]:
    """What the template needs of a section."""
    document = section.document
    anchor = f"{_slug(section.name)}-{number}"
    return {
        "anchor": anchor,
        "title": document.title,
        "name": section.name,
        "setting": document.setting,
        "notes": document.notes,
        "tables": [
            _table(table, f"{anchor}-table-{i}", f"{_slug(section.name)}-{i}")
            for i, table in enumerate(document.tables, start=1)
        ],
        "figures": [
            {
                "caption": figure.caption,
                "image": _image(section.folder, figure),
                "stem": figure.stem,
            }
            for figure in document.figures
        ],
        "frames": [
            _download(f"{_slug(section.name)}-{name}.csv", "text/csv", frame.to_csv())
            | {"rows": len(frame), "columns": len(frame.columns)}
            for name, frame in document.frames.items()
        ],
        "scene": None if document.scene is None else _json(document.scene),
        "facts": _facts(document.provenance),
    }


def _table(table: Table, anchor: str, stem: str) -> dict[str, Any]:
    rows = [
        [
            {
                "text": _unbroken(text),
                "value": None if value is None else repr(float(value)),
                "bold": (i, j) in table.bold,
            }
            for j, (text, value) in enumerate(zip(texts, values, strict=True))
        ]
        for i, (texts, values) in enumerate(zip(table.cells, table.values, strict=True))
    ]
    return {
        "anchor": anchor,
        "caption": table.caption,
        "headers": [_unbroken(header) for header in table.headers],
        "numeric": [table.numeric(j) for j in range(len(table.headers))],
        "rows": rows,
        "downloads": [
            _download(f"{stem}.csv", "text/csv", report_text.csv_table(table)) | {"kind": "CSV"},
            _download(f"{stem}.tex", "text/x-tex", report_text.latex_table(table))
            | {"kind": "LaTeX"},
            _download(f"{stem}.md", "text/markdown", report_text.markdown_table(table) + "\n")
            | {"kind": "Markdown"},
        ],
    }


def _unbroken(text: str) -> str:
    """A number and its percent sign stay on one line."""
    return re.sub(r"(?<=\d) (?=%)", "\u00a0", text)


def _image(folder: Path, figure: Figure) -> str | None:
    """The figure as a data URI, drawn rather than rastered if it can be; None if it is missing."""
    for suffix, kind in (("svg", "image/svg+xml"), ("png", "image/png")):
        try:
            return _uri(kind, (folder / f"{figure.stem}.{suffix}").read_bytes())
        except OSError:
            continue
    return None


def _download(name: str, kind: str, text: str) -> dict[str, Any]:
    content = text.encode()
    small = len(content) <= _LARGEST_DOWNLOAD
    return {"name": name, "uri": _uri(f"{kind};charset=utf-8", content) if small else None}


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _json(value: Any) -> str:
    """JSON for a script element: it holds no `<`, so nothing in it can end the element."""
    text = json.dumps(plain(value), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _facts(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and text of each fact, the known ones first."""
    keys = [*(key for key in _FACTS if key in provenance)]
    keys += [key for key in provenance if key not in _FACTS]
    named = ((_FACTS.get(key, key.replace("_", " ")), _text(provenance[key])) for key in keys)
    return [(name, text) for name, text in named if text]


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key}\u00a0{_text(part)}" for key, part in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(part) for part in value)
    return "" if value is None else str(value)


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "result"

"""Records in a line, and in a notebook: what came out, not the arrays it came with."""

from __future__ import annotations

import dataclasses
import enum
import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

#: Longer texts are cut.
_LONGEST = 60


def brief(record: Any) -> str:
    """`repr` of a dataclass in one line: arrays by their shape, other records by their type."""
    fields = (field for field in dataclasses.fields(record) if field.repr)
    parts = (f"{field.name}={_short(getattr(record, field.name))}" for field in fields)
    return f"{type(record).__name__}({', '.join(parts)})"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"<array {value.shape}>" if value.ndim else f"{value.item():.6g}"
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, (float, np.floating)):
        return f"{value:.6g}"
    if isinstance(value, str) or value is None or np.isscalar(value):
        text = repr(value)
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 4]}...{text[-1]}"
    if isinstance(value, Mapping):
        return f"<{len(value)} by name>"
    if isinstance(value, Sequence):
        plain = len(value) <= 5 and all(isinstance(part, (str, int, float)) for part in value)
        return f"({', '.join(map(_short, value))})" if plain else f"<{len(value)} items>"
    return f"<{type(value).__name__}>"


def facts(title: str, rows: Mapping[str, str], notes: Sequence[str] = ()) -> str:
    """HTML of a titled table of names and texts, with notes below it; all of it is escaped.

    It has no script and no style but its own, so it is shown alike wherever notebooks are.
    """
    lines = "".join(
        f'<tr><th scope="row" style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(text)}</td></tr>'
        for name, text in rows.items()
    )
    return (
        '<table><caption style="text-align:left;font-weight:bold">'
        f"{html.escape(title)}</caption><tbody>{lines}</tbody></table>"
        + "".join(f"<p>{html.escape(note)}</p>" for note in notes)
    )

"""What a part of the benchmark leaves behind: Markdown, JSON with every single time, and whence."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import math
import os
import shlex
import sys
from pathlib import Path
from typing import Any

import pandas as pd

from slipcar.evaluation.provenance import provenance

Table = list[dict[str, Any]]
_PEER_PACKAGES = ("casadi", "clarabel")


@dataclasses.dataclass(frozen=True)
class Section:
    """What one part measured.

    Attributes:
        part: its name on the command line; its files are called so too.
        title: heading of its page.
        about: what is measured and what the rows are, in Markdown.
        tables: rows by title.
        figures: names of figures that lie in the folder as PNG.
        notes: findings and absences, a line each.
        raw: everything behind the tables.
    """

    part: str
    title: str
    about: str
    tables: dict[str, Table]
    figures: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    raw: dict[str, Any] = dataclasses.field(default_factory=dict)


def where() -> dict[str, Any]:
    """Machine and its load, versions, date and command."""
    told = provenance()
    for package in _PEER_PACKAGES:
        try:
            told["versions"][package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    if hasattr(os, "getloadavg"):
        told["load"] = os.getloadavg()[0]
    told["command"] = "python " + shlex.join(sys.argv)
    return told


def save(folder: Path, section: Section, told: dict[str, Any]) -> list[Path]:
    """Write <part>.md and <part>.json; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{section.part}.md", folder / f"{section.part}.json"]
    paths[0].write_text(f"{machine(told)}\n\n{markdown(section, told)}", encoding="utf-8")
    data = {"provenance": told, **dataclasses.asdict(section)}
    paths[1].write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return paths


def load(folder: Path, part: str) -> tuple[Section, dict[str, Any]]:
    """The inverse of :func:`save`: the section and where it was measured.

    Raises:
        FileNotFoundError: if the part has not been run into this folder.
    """
    data = json.loads((folder / f"{part}.json").read_text(encoding="utf-8"))
    told = data.pop("provenance")
    return Section(**data), told


def machine(told: dict[str, Any]) -> str:
    """Processor and versions, in a sentence."""
    versions = ", ".join(f"{name} {version}" for name, version in told["versions"].items())
    return f"{told['cpu']} ({told['cpu_count']} cores seen), Python {told['python']}, {versions}."


def markdown(section: Section, told: dict[str, Any], figure_prefix: str = "") -> str:
    """The section with its tables, figures and notes; figures are linked under the prefix."""
    lines = [f"## {section.title}", "", section.about.strip(), ""]
    for title, rows in section.tables.items():
        if rows:
            lines += [f"### {title}", "", _table(rows), ""]
    for name in section.figures:
        lines += [f"![{section.title}]({figure_prefix}{name}.png)", ""]
    if section.notes:
        lines += [*(f"* {note}" for note in section.notes), ""]
    load = f", load average {told['load']:.1f} at the start" if "load" in told else ""
    lines += [f"Measured {told['date']}{load}: `{told['command']}`"]
    return "\n".join(lines) + "\n"


def _table(rows: Table) -> str:
    shown = [{key: _shown(key, value) for key, value in row.items()} for row in rows]
    return pd.DataFrame(shown).fillna("").to_markdown(index=False, disable_numparse=True)


def _shown(key: str, value: Any) -> str:
    if not isinstance(value, float):
        return f"{value:,}" if isinstance(value, int) and value >= 10_000 else str(value)
    if math.isnan(value):
        return ""
    if key == "effort + obstacle":
        return f"{value:.6f}"
    if value >= 1e4:
        return f"{value:,.0f}"
    return f"{value:.1e}" if 0.0 < abs(value) < 1e-3 else f"{value:.3g}"

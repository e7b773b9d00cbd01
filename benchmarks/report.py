"""What a run leaves behind: Markdown, JSON with every single time, and where it was measured."""

from __future__ import annotations

import importlib.metadata
import json
import math
from pathlib import Path
from typing import Any

import pandas as pd

from slipcar.evaluation.provenance import provenance

Table = list[dict[str, Any]]
_PEER_PACKAGES = ("casadi", "clarabel")


def where() -> dict[str, Any]:
    """Machine, versions and date."""
    told = provenance()
    for package in _PEER_PACKAGES:
        try:
            told["versions"][package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return told


def markdown(tables: dict[str, Table], told: dict[str, Any], notes: list[str]) -> str:
    """All tables with their titles, then the notes."""
    versions = ", ".join(f"{name} {version}" for name, version in told["versions"].items())
    lines = [f"{told['cpu']}, Python {told['python']}, {versions}, {told['date']}.", ""]
    for title, rows in tables.items():
        if not rows:
            continue
        lines += [f"## {title}", "", _table(rows), ""]
    return "\n".join(lines + [f"* {note}" for note in notes]) + "\n"


def save(
    folder: Path,
    tables: dict[str, Table],
    told: dict[str, Any],
    text: str,
    raw: dict[str, Any],
    name: str = "bench",
) -> list[Path]:
    """Write <name>.md and <name>.json; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.md", folder / f"{name}.json"]
    paths[0].write_text(text, encoding="utf-8")
    data = {"provenance": told, "tables": tables, **raw}
    paths[1].write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return paths


def _table(rows: Table) -> str:
    shown = [{key: _shown(key, value) for key, value in row.items()} for row in rows]
    return pd.DataFrame(shown).to_markdown(index=False, disable_numparse=True)


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

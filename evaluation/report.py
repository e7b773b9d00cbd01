"""A comparison as tables (terminal, Markdown, LaTeX, CSV), as JSON, and as a folder of all."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.baselines.files import write_atomically
from slipcar.evaluation.store import controller_fingerprint

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group

    from slipcar.evaluation.compare import Comparison

_NONE = "–"


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of a printed table.

    Attributes:
        header: with its unit.
        text: from a row of `Comparison.frame` to what is printed.
        best: the key whose smallest (`sign` 1) or largest (−1) value is emphasised, or None.
        sign: see `best`.
        marked: the key that says of each row whether it is emphasised, or None.
    """

    header: str
    text: Callable[[Any], str]
    best: str | None = None
    sign: int = 1
    marked: str | None = None


#: Captions and columns of tables, in order.
Captioned = Sequence[tuple[str, tuple[Column, ...]]]


def with_error(key: str) -> Callable[[Any], str]:
    """Text of a mean and its standard error."""
    return lambda row: f"{row[key]:.3f} ± {row[f'{key}_se']:.3f}"


def collisions(digits: int) -> Callable[[Any], str]:
    """Text of the collision rate and its interval, in percent."""

    def text(row: Any) -> str:
        rate, low, high = (100 * row[f"collision_{part}"] for part in ("rate", "low", "high"))
        return f"{rate:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"

    return text


def _difference(key: str, scale: float, digits: int) -> Callable[[Any], str]:
    def text(row: Any) -> str:
        mean, low, high = (scale * row[f"{key}{part}"] for part in ("", "_low", "_high"))
        return f"{mean:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"

    return text


def _number(key: str, digits: int) -> Callable[[Any], str]:
    return lambda row: f"{round(row[key], digits) + 0.0:.{digits}f}"  # + 0.0: no "-0.000"


def _duration(key: str) -> Callable[[Any], str]:
    def text(row: Any) -> str:
        seconds = row[key]
        for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
            if seconds >= size:
                return f"{seconds / size:.3g} {unit}"
        return f"{seconds / 1e-9:.3g} ns" if seconds > 0.0 else "0 s"

    return text


LOOP = Column("loop", lambda row: "closed" if row["closed_loop"] else "open")
TOTAL = Column("total cost", with_error("total"), "total")
COLLISIONS = Column("collisions [%]", collisions(2), "collision_rate")
_PARTS = ("effort", "obstacle", "goal")
COST = (LOOP, TOTAL, *(Column(part, with_error(part)) for part in _PARTS), COLLISIONS)
#: The same for a terminal, where columns are dear.
COST_BRIEF = (LOOP, TOTAL, *(Column(part, _number(part, 3)) for part in _PARTS), COLLISIONS)
DIFFERENCE = (
    LOOP,
    Column("Δ total cost", _difference("total_difference", 1.0, 3)),
    Column("Δ collisions [% points]", _difference("collision_difference", 100.0, 2)),
)
ACCURACY = (
    LOOP,
    Column("position RMS [m]", _number("position_rms", 4), "position_rms"),
    Column("heading RMS [rad]", _number("heading_rms", 4), "heading_rms"),
    Column("speed RMS [m/s]", _number("speed_rms", 4), "speed_rms"),
    Column("clearance 1 % [m]", _number("clearance_p01", 3), "clearance_p01", -1),
    Column("5 % [m]", _number("clearance_p05", 3), "clearance_p05", -1),
    Column("50 % [m]", _number("clearance_p50", 3), "clearance_p50", -1),
)
WORK = (
    LOOP,
    Column("solver failures", lambda row: f"{int(row['failures'])}"),
    Column("inference per step", _duration("inference_time")),
    Column("planning or training", _duration("preparation_time")),
)


def tables(comparison: Comparison, brief: bool = False) -> list[tuple[str, tuple[Column, ...]]]:
    """Captions and columns of the printed tables, in order."""
    return [
        (
            "Cost of a path (mean ± standard error) and collisions (Wilson 95 % interval)",
            COST_BRIEF if brief else COST,
        ),
        (
            f"Paired difference to “{comparison.reference}” on the same Brownian paths "
            "(bootstrap 95 % interval)",
            DIFFERENCE,
        ),
        ("Error at the goal, and clearance: quantiles of the smallest distance to a rim", ACCURACY),
        ("Solver failures and time (inference: 1024 episodes at once, time for one)", WORK),
    ]


def cells(
    frame: pd.DataFrame, columns: tuple[Column, ...], emphasise: Callable[[str], str]
) -> list[list[str]]:
    """Text of every cell, the name first; the best of a column, or those marked, are emphasised.

    Rows that print the same as the best are emphasised with it.
    """
    rows = [row for _, row in frame.iterrows()]
    printed = [[str(name) for name in frame.index]]
    for column in columns:
        texts = [_NONE if row["error"] else column.text(row) for row in rows]
        texts = [_NONE if "nan" in text else text for text in texts]
        if column.best is not None and sum(text != _NONE for text in texts) > 1:
            best = texts[int(np.nanargmin(column.sign * frame[column.best].astype(float)))]
            texts = [emphasise(text) if text == best else text for text in texts]
        if column.marked is not None:
            chosen = frame[column.marked].eq(True)
            texts = [
                emphasise(text) if mark else text for text, mark in zip(texts, chosen, strict=True)
            ]
        printed.append(texts)
    return [list(row) for row in zip(*printed, strict=True)]


def setting(comparison: Comparison) -> str:
    """A sentence on what was run."""
    scenario = comparison.scenario
    return (
        f"{comparison.episodes:,} episodes a row, seed {comparison.seed}, every row over the "
        f"same Brownian paths; {scenario.nodes - 1} control steps of {scenario.dt:g} s, "
        f"{len(scenario.obstacles)} obstacles."
    )


def machine(comparison: Comparison) -> str:
    """A sentence on where it was run."""
    told = comparison.provenance
    versions = ", ".join(f"{name} {version}" for name, version in told["versions"].items())
    commit = f", commit {told['commit'][:12]}" if told["commit"] else ""
    return f"{told['cpu']}, Python {told['python']}, {versions}{commit}, {told['date']}."


def markdown(comparison: Comparison) -> str:
    """Tables in Markdown with their captions, errors and provenance."""
    parts = [setting(comparison), *markdown_tables(comparison.frame, tables(comparison))]
    parts += [f"`{name}` did not finish: {text}" for name, text in comparison.errors.items()]
    parts.append(f"Computed on {machine(comparison)}")
    return "\n\n".join(parts) + "\n"


def markdown_tables(frame: pd.DataFrame, captioned: Captioned) -> list[str]:
    """Captions and tables in Markdown, in turn."""
    from tabulate import tabulate

    parts = []
    for caption, columns in captioned:
        rows = cells(frame, columns, lambda text: f"**{text}**")
        headers = ["controller", *(column.header for column in columns)]
        parts.append(f"**{caption}**")
        parts.append(tabulate(rows, headers, tablefmt="github", disable_numparse=True))
    return parts


def latex(comparison: Comparison) -> str:
    r"""Tables in LaTeX; they need `\usepackage{booktabs}`."""
    parts = [f"% {setting(comparison)}", f"% {machine(comparison)}"]
    return "\n".join([*parts, *latex_tables(comparison.frame, tables(comparison))])


def latex_tables(frame: pd.DataFrame, captioned: Captioned) -> list[str]:
    """Floating tables in LaTeX."""
    import pandas as pd

    parts = []
    for caption, columns in captioned:
        rows = cells(frame, columns, lambda text: f"\x02{text}\x03")
        headers = ["controller", *(column.header for column in columns)]
        escaped = pd.DataFrame([[_tex(text) for text in row] for row in rows])
        escaped.columns = pd.Index([_tex(text) for text in headers])
        parts.append(
            escaped.to_latex(
                index=False,
                escape=False,
                caption=_tex(caption) + ".",
                column_format="l" * 2 + "r" * (len(columns) - 1),
                position="htb",
            )
        )
    return parts


_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_", "$": r"\$",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "±": r"$\pm$", "Δ": r"$\Delta$", "µ": r"\textmu{}",
    "≤": r"$\leq$", "ν": r"$\nu$", "“": "``", "”": "''", "–": "--",
    "\x02": r"\textbf{", "\x03": "}",
}  # fmt: skip


def _tex(text: str) -> str:
    return "".join(_TEX.get(letter, letter) for letter in text)


def terminal(comparison: Comparison) -> Group:
    """Tables for a terminal, to be printed by a rich console."""
    from rich.console import Group
    from rich.text import Text

    parts: list[Any] = [Text(setting(comparison)), Text()]
    parts += terminal_tables(comparison.frame, tables(comparison, brief=True))
    for name, message in comparison.errors.items():
        parts.append(Text(f"{name} did not finish: {message}", style="bold red"))
    return Group(*parts)


def terminal_tables(frame: pd.DataFrame, captioned: Captioned) -> list[Any]:
    """Captions and tables of rich, in turn."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    parts: list[Any] = []
    for caption, columns in captioned:
        parts.append(Text(caption, style="bold"))
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="")
        table.add_column(Text("controller"), no_wrap=True)
        for i, column in enumerate(columns):
            table.add_column(Text(column.header), justify="left" if i == 0 else "right")
        for row in cells(frame, columns, lambda text: f"\x02{text}"):
            table.add_row(
                *(
                    Text(text[1:], style="bold green") if text[:1] == "\x02" else Text(text)
                    for text in row
                )
            )
        parts.append(table)
    return parts


def json_text(comparison: Comparison, frame: pd.DataFrame | None = None) -> str:
    """Everything needed to repeat the table, and its raw numbers, as JSON.

    Args:
        comparison: what was run.
        frame: a row for each controller; None takes the comparison's own.
    """
    frame = comparison.frame if frame is None else frame
    data = {
        "scenario": comparison.scenario.to_dict(),
        "seed": comparison.seed,
        "episodes": comparison.episodes,
        "substeps": comparison.substeps,
        "reference": comparison.reference,
        "wall_time": comparison.wall_time,
        "reused_rows": list(comparison.reused),
        "provenance": comparison.provenance,
        "rows": [
            {
                "controller": name,
                "fingerprint": controller_fingerprint(comparison.controllers[str(name)]),
                **{key: _plain(value) for key, value in row.items()},
            }
            for name, row in frame.iterrows()
        ],
    }
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """JSON has no NaN and no infinity: null."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def save(comparison: Comparison, folder: Path, figures: bool) -> list[Path]:
    """Write the tables, the JSON and the figures; see `Comparison.save`."""
    written = write_texts(
        folder,
        {
            "table.md": comparison.to_markdown(),
            "table.csv": comparison.frame.to_csv(),
            "table.tex": comparison.to_latex(),
            "results.json": comparison.to_json(),
        },
    )
    if figures:
        with tables_are_in(folder):
            from slipcar.evaluation import plots
        written += plots.save_all(comparison, folder)
    return written


def write_texts(folder: Path, texts: dict[str, str]) -> list[Path]:
    """Write files, name -> text, into a folder that is made if need be; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, text in texts.items():
        path = folder / name
        write_atomically(path, text.encode())
        written.append(path)
    return written


@contextlib.contextmanager
def tables_are_in(folder: Path) -> Iterator[None]:
    """Where matplotlib is missing: say so, how to do without, and that the tables are there."""
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"figures need matplotlib ({error}): pip install 'slipcar[plot]', or do without "
            f"(figures=False, --no-figures); the tables are in {folder}"
        ) from error

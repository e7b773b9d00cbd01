"""A frontier as tables (terminal, Markdown, LaTeX, CSV), as JSON, and as a folder of all."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from slipcar.evaluation import report
from slipcar.evaluation.frontier import RECEDING

if TYPE_CHECKING:
    from rich.console import Group

    from slipcar.evaluation.frontier import Frontier

COLUMNS = (
    report.LOOP,
    report.Column("collisions [%]", report.collisions(3)),
    report.Column("effort", report.with_error("effort"), marked="effort_front"),
    report.Column("total cost", report.with_error("total"), marked="total_front"),
)
TABLES: report.Captioned = [
    (
        "Collisions (Wilson 95 % interval) and cost of a path (mean ± standard error); bold: no "
        "other row over all these paths is both safer and cheaper",
        COLUMNS,
    ),
    ("Solver failures and time (inference: 1024 episodes at once, time for one)", report.WORK),
]


def setting(frontier: Frontier) -> str:
    """A sentence or two on what was run."""
    told = report.setting(frontier.comparison)
    fewer = frontier.receding_episodes < frontier.comparison.episodes
    if fewer and any(point.method == RECEDING for point in frontier.points):
        told += f" The receding horizon drove the first {frontier.receding_episodes:,} of them."
    return told


def markdown(frontier: Frontier) -> str:
    """Tables in Markdown with notes and provenance."""
    parts = [
        setting(frontier),
        *report.markdown_tables(frontier.frame, TABLES),
        *_messages(frontier),
        f"Computed on {report.machine(frontier.comparison)}",
    ]
    return "\n\n".join(parts) + "\n"


def latex(frontier: Frontier) -> str:
    r"""Tables in LaTeX; they need `\usepackage{booktabs}`."""
    comparison = frontier.comparison
    head = [f"% {setting(frontier)}", f"% {report.machine(comparison)}"]
    return "\n".join([*head, *report.latex_tables(frontier.frame, TABLES)])


def terminal(frontier: Frontier) -> Group:
    """Tables for a terminal, to be printed by a rich console."""
    from rich.console import Group
    from rich.text import Text

    parts: list[Any] = [Text(setting(frontier)), Text()]
    parts += report.terminal_tables(frontier.frame, TABLES)
    parts += [Text(message, style="bold red") for message in _messages(frontier)]
    return Group(*parts)


def save(frontier: Frontier, folder: Path, figures: bool) -> list[Path]:
    """Write the tables, the JSON and the figure; see `Frontier.save`."""
    written = report.write_texts(
        folder,
        {
            "table.md": markdown(frontier),
            "table.csv": frontier.frame.to_csv(),
            "table.tex": latex(frontier),
            "results.json": report.json_text(frontier.comparison, frontier.frame),
        },
    )
    if figures and frontier.comparison.results:
        with report.tables_are_in(folder):
            from slipcar.evaluation import plot_frontier
        figure = plot_frontier.frontier_figure(frontier)
        written += plot_frontier.save_figure(figure, folder, "frontier")
    return written


def _messages(frontier: Frontier) -> list[str]:
    errors = frontier.comparison.errors.items()
    return [*frontier.notes, *(f"{name} did not finish: {text}" for name, text in errors)]

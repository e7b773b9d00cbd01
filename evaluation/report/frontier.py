"""A frontier as a document, and as a folder of tables, JSON and figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from slipcar.evaluation.frontier_record import CURVES, RECEDING, FrontierRecord
from slipcar.evaluation.report import comparison as report
from slipcar.evaluation.report.document import Document, write_texts
from slipcar.evaluation.report.formats import collisions, with_error
from slipcar.evaluation.report.table import Column, table_of

if TYPE_CHECKING:
    from rich.console import Group

COLUMNS = (
    report.LOOP,
    Column("collisions [%]", collisions(3), value="collision_rate"),
    Column("effort", with_error("effort"), marked="effort_front", value="effort"),
    Column("total cost", with_error("total"), marked="total_front", value="total"),
)
TABLES = (
    (
        "Collisions (Wilson 95 % interval) and cost of a path (mean ± standard error); bold: no "
        "other row over all these paths is both safer and cheaper",
        COLUMNS,
    ),
    ("Solver failures and time (inference: 1024 episodes at once, time for one)", report.WORK),
)
FIGURES = {
    "frontier": "Effort, and total cost, against how often paths collide, as the price of risk "
    "rises: to the left is safer, below is cheaper."
}


def setting(frontier: FrontierRecord) -> str:
    """A sentence or two on what was run."""
    told = report.setting(frontier.comparison, fewer=False)
    fewer = frontier.receding_episodes < frontier.comparison.episodes
    if fewer and any(point.method == RECEDING for point in frontier.points):
        told += f" The receding horizon drove the first {frontier.receding_episodes:,} of them."
    return told


def document(frontier: FrontierRecord) -> Document:
    """What a frontier has to show; figure and scene are added by :func:`save`."""
    return Document(
        kind="frontier",
        title="The price of safety",
        setting=setting(frontier),
        tables=tuple(table_of(frontier.frame, caption, columns) for caption, columns in TABLES),
        notes=(*frontier.notes, *report.messages(frontier.comparison)),
        figures=(),
        frames=report.frames(frontier.frame, frontier.comparison),
        provenance=frontier.comparison.provenance,
    )


def markdown(frontier: FrontierRecord) -> str:
    """Tables in Markdown with notes and provenance."""
    return document(frontier).markdown()


def terminal(frontier: FrontierRecord) -> Group:
    """Tables for a terminal, to be printed by a rich console."""
    return document(frontier).terminal()


def save(frontier: FrontierRecord, folder: Path, figures: bool) -> list[Path]:
    """Write the tables, the JSON, what a report needs, and the figure; see `Frontier.save`."""
    from slipcar.evaluation.report.scene import scene

    comparison = frontier.comparison

    def draw() -> list[Path]:
        from slipcar.evaluation.figures import frontier as plot_frontier

        if not comparison.results:
            return []
        figure = plot_frontier.frontier_figure(frontier)
        return plot_frontier.save_figure(figure, folder, "frontier")

    texts = {"results.json": report.json_text(comparison, frontier.frame)}
    return write_texts(folder, texts) + report.save_document(
        document(frontier),
        folder,
        draw if figures else None,
        FIGURES,
        lambda: scene(comparison, driven(frontier)),
    )


def driven(frontier: FrontierRecord) -> list[str]:
    """Rows of the animation: the cheap and the dear end of each curve, and all single points."""
    ends: list[str] = []
    for method in CURVES:
        curve = [point for point in frontier.points if point.method == method]
        curve.sort(key=lambda point: point.price)
        ends += [point.name for point in (*curve[:1], *curve[1:][-1:])]
    return ends + [point.name for point in frontier.points if point.method not in CURVES]

"""A comparison as a document (tables, figures, raw numbers), as JSON, and as a folder of all."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.envs.extras import install
from slipcar.evaluation import learning
from slipcar.evaluation.cells import controller_fingerprint
from slipcar.evaluation.comparison_record import ComparisonRecord
from slipcar.evaluation.report import text as report_text
from slipcar.evaluation.report.document import Document, Figure, plain, write_texts
from slipcar.evaluation.report.formats import (
    collisions,
    difference,
    duration,
    number,
    with_error,
)
from slipcar.evaluation.report.table import Column, Table, table_of
from slipcar.evaluation.runs import Runs
from slipcar.evaluation.statistics import Interval, leader, student_interval

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group

LOOP = Column("loop", lambda row: "closed" if row["closed_loop"] else "open")
TOTAL = Column("total cost", with_error("total"), "total", "total_best")
COLLISIONS = Column("collisions [%]", collisions(2), "collision_rate", "collision_best")
_PARTS = ("effort", "obstacle", "goal")
COST = (LOOP, TOTAL, *(Column(part, with_error(part), value=part) for part in _PARTS), COLLISIONS)
#: The same for a terminal, where columns are dear.
COST_BRIEF = (
    *(LOOP, TOTAL, COLLISIONS),
    *(Column(part, number(part, 3), value=part) for part in _PARTS),
)
BETWEEN = (
    LOOP,
    Column("at nodes [%]", collisions(2), "collision_rate", "collision_best"),
    Column("at or between nodes [%]", collisions(2, "between"), "between_rate", "touched_best"),
)
DIFFERENCE = (
    LOOP,
    Column("Δ total cost", difference("total_difference", 1.0, 3), value="total_difference"),
    Column(
        "Δ collisions [% points]",
        difference("collision_difference", 100.0, 2),
        value="collision_difference",
    ),
    Column(
        "at or between nodes",
        difference("between_difference", 100.0, 2),
        value="between_difference",
    ),
)
TAILS = (
    LOOP,
    *(
        Column(f"cost {quantile} %", number(f"total_p{quantile}", 3), f"total_p{quantile}")
        for quantile in (50, 95, 99)
    ),
    Column("dearest 5 %", with_error("total_cvar95"), "total_cvar95", "tail_best"),
    *(
        Column(f"clearance {int(quantile)} % [m]", number(key, 3), key)
        for quantile in ("50", "05", "01")
        for key in (f"clearance_p{quantile}",)
    ),
    Column("closest 5 % [m]", number("clearance_cvar05", 3), "clearance_cvar05"),
)
ACCURACY = (
    LOOP,
    Column("position RMS [m]", number("position_rms", 4), "position_rms"),
    Column("heading RMS [rad]", number("heading_rms", 4), "heading_rms"),
    Column("speed RMS [m/s]", number("speed_rms", 4), "speed_rms"),
)
WORK = (
    LOOP,
    Column("solver failures", lambda row: f"{int(row['failures'])}", value="failures"),
    Column("inference per step", duration("inference_time"), value="inference_time"),
    Column("planning or training", duration("preparation_time"), value="preparation_time"),
)
TRAINING = (
    Column("training", lambda row: str(row["training"])),
    Column("total cost", lambda row: str(row["total_text"]), value="total"),
    Column("spread of cost", number("total_spread", 3), value="total_spread"),
    Column("collisions [%]", lambda row: str(row["collision_text"]), value="collision_rate"),
    Column("spread [% points]", number("collision_spread", 2, 100.0), value="collision_spread"),
)
#: Captions of the figures that `plots.save_all` draws, in the order in which they are shown.
FIGURES = {
    "tradeoff": "What a path costs on average, against how often it collides, with 95 % intervals.",
    "learning": "Validation cost of the trainings, best so far, against samples and time: median "
    "and range over seeds; plans are level lines.",
    "distributions": "How the cost of a path is distributed, and its dear tail.",
    "iterations": "Every accepted iterate of the reference plan, and sample paths of the last.",
    "covariance": "The plan's predicted covariance against Monte Carlo.",
}


def _winners(comparison: ComparisonRecord) -> dict[str, list[bool]]:
    """Which cells are emphasised: by column that says so, of each row."""
    tails = {name: result.cost_cvar for name, result in comparison.results.items()}

    def apart(name: str, best: str) -> Interval:
        (value, error), (other, its) = tails[name], tails[best]
        return student_interval(value - other, float(np.hypot(error, its)), float("inf"))

    leaders = {
        **{f"{metric}_best": first for metric, first in comparison.leaders.items()},
        "tail_best": leader({name: value for name, (value, _) in tails.items()}, apart),
    }
    return {
        key: [found is not None and name == found.winner for name in comparison.controllers]
        for key, found in leaders.items()
    }


def sentences(comparison: ComparisonRecord) -> list[str]:
    """What the main table says, in three sentences: no more than its intervals allow.

    The cheapest row, the safest one, and how many differ from the reference; not told apart are
    rows whose paired difference has an interval that includes zero.
    """
    found = []
    for metric, what, text in (
        ("total", "Cheapest", with_error("total")),
        ("collision", "Fewest collisions", collisions(2)),
    ):
        first = comparison.leaders[metric]
        if first is None:
            continue
        unit = " %" if metric == "collision" else ""
        said = f"{what}: “{first.name}”, {text(comparison.frame.loc[first.name])}{unit}"
        others = len(comparison.results) - 1 - len(first.tied)
        if not first.tied:
            said += "; every other row has more (95 % intervals of paired differences)"
        elif others:
            said += f"; not told apart from it: {', '.join(f'“{name}”' for name in first.tied)}"
        else:
            said += "; no other row can be told apart from it"
        found.append(f"{said}.")
    frame, reference = comparison.frame, comparison.reference
    rows = [name for name in comparison.results if name != reference]
    if reference in comparison.results and rows:
        low, high = frame["total_difference_low"][rows], frame["total_difference_high"][rows]
        cheaper, dearer = int((high < 0.0).sum()), int((low > 0.0).sum())
        found.append(
            f"Against “{reference}” on the same paths: of {len(rows)} other rows {cheaper} "
            f"cheaper, {dearer} dearer, {len(rows) - cheaper - dearer} not told apart "
            "(95 % intervals)."
        )
    return found


def tables(comparison: ComparisonRecord, brief: bool = False) -> tuple[Table, ...]:
    """The printed tables, in order.

    A row is emphasised where its difference to each other has a 95 % interval that excludes zero.
    """
    captioned: list[tuple[str, tuple[Column, ...]]] = [
        (
            "Cost of a path (mean ± standard error) and collisions (Wilson 95 % interval)",
            COST_BRIEF if brief else COST,
        ),
        (
            "Collisions: at a node, and at or between nodes (Brownian bridges between them); "
            "Wilson 95 % intervals. Risks are promised at nodes, and on the path where a name "
            "says so",
            BETWEEN,
        ),
        (
            f"Paired difference to “{comparison.reference}” on the same Brownian paths "
            "(BCa bootstrap 95 % interval)",
            DIFFERENCE,
        ),
        (
            "Tails: quantiles of the cost, and the mean of the dearest 5 % (CVaR ± standard "
            "error); quantiles of the smallest distance to a rim, and the mean of the closest 5 %",
            TAILS,
        ),
        ("Error at the goal", ACCURACY),
    ]
    frame = comparison.frame
    marked = frame.assign(**_winners(comparison))
    done = [table_of(marked, caption, columns) for caption, columns in captioned]
    trainings = training_frame(frame, comparison)
    if len(trainings):
        caption = (
            "Training noise: learners trained from several seeds (mean, its error from trainings "
            "and paths together, and the standard deviation between trainings), then each "
            "training. In all tables their intervals are Student's t over trainings and paths"
        )
        done.append(table_of(trainings, caption, TRAINING))
    learned = learning.table(comparison)
    if learned is not None:
        done.append(learned)
    caption = "Solver failures and time (inference: 1024 episodes at once, time for one)"
    return (*done, table_of(frame, caption, WORK))


def training_frame(frame: pd.DataFrame, comparison: ComparisonRecord) -> pd.DataFrame:
    """Rows of which several trainings were driven, each followed by its trainings."""
    import pandas as pd

    found: list[tuple[str, str, Mapping[Any, Any]]] = []
    for name, result in comparison.results.items():
        if len(result.runs) < 2:
            continue
        controller = comparison.controllers[name]
        labels = controller.labels if isinstance(controller, Runs) else ()
        found.append((name, f"all {len(result.runs)}", frame.loc[name].to_dict()))
        each = zip(labels, result.runs, strict=True)
        found += [(name, label, run.summary()) for label, run in each]
    keys = ("total", "total_se", "total_spread", "collision_rate", "collision_spread")
    rows = [
        {
            "training": training,
            **{key: row.get(key, float("nan")) for key in keys},
            "total_text": with_error("total")(row),
            "collision_text": collisions(2)(row),
        }
        for _, training, row in found
    ]
    index = pd.Index([name for name, _, _ in found], name="controller")
    return pd.DataFrame(rows, index=index)


def frames(frame: pd.DataFrame, comparison: ComparisonRecord) -> dict[str, pd.DataFrame]:
    """Raw numbers by file: `table`, which is the same wherever it is computed, and `times`."""
    import pandas as pd

    timed = [name for name in frame if str(name).endswith("_time")]
    wall = {name: result.wall_time for name, result in comparison.results.items()}
    times = frame[timed].assign(wall_time=pd.Series(wall, dtype=float))
    named = {"table": frame.drop(columns=timed), "times": times}
    trainings = training_frame(frame, comparison)
    if len(trainings):
        named["trainings"] = trainings.drop(columns=["total_text", "collision_text"])
    learned = learning.frame(comparison)
    if len(learned):
        named["learning"] = learned.drop(columns=["planning_time"])  # differs from run to run
    return named


def setting(comparison: ComparisonRecord, fewer: bool = True) -> str:
    """A sentence on what was run.

    Args:
        comparison: it.
        fewer: whether to tell of rows that drove fewer episodes than others.
    """
    scenario = comparison.scenario
    counts = [result.episodes for result in comparison.results.values()] if fewer else []
    least = min(counts, default=comparison.episodes)
    episodes = f"{least:,} to " if least < comparison.episodes else ""
    steps = f" ({comparison.substeps} Euler–Maruyama steps each)" if comparison.substeps > 1 else ""
    return (
        f"{episodes}{comparison.episodes:,} episodes a row, seed {comparison.seed}, every row over "
        f"the same Brownian paths; {scenario.nodes - 1} control steps of {scenario.dt:g} s"
        f"{steps}, {len(scenario.obstacles)} obstacles."
    )


def messages(comparison: ComparisonRecord) -> tuple[str, ...]:
    """What a reader must be told: the comparison's notes, and rows that failed."""
    errors = comparison.errors.items()
    return (*comparison.warnings, *(f"{name} did not finish: {text}" for name, text in errors))


def document(
    comparison: ComparisonRecord,
    *,
    title: str = "Comparison",
    notes: tuple[str, ...] = (),
    brief: bool = False,
) -> Document:
    """What a comparison has to show; figures and scene are added by :func:`save`.

    Args:
        comparison: what was run.
        title: of its section in a report.
        notes: what a reader must be told besides what the comparison says itself.
        brief: with fewer columns, for a terminal.
    """
    return Document(
        kind="compare",
        title=title,
        setting=setting(comparison),
        tables=tables(comparison, brief),
        notes=(*notes, *messages(comparison)),
        figures=(),
        frames=frames(comparison.frame, comparison),
        provenance=comparison.provenance,
    )


def markdown(comparison: ComparisonRecord) -> str:
    """Tables in Markdown with their captions, notes and provenance."""
    return document(comparison).markdown()


def latex(comparison: ComparisonRecord) -> str:
    r"""Tables in LaTeX; they need `\usepackage{booktabs}`."""
    return document(comparison).latex()


def terminal(comparison: ComparisonRecord, all_tables: bool = True) -> Group:
    """For a terminal, to be printed by a rich console: the main table and what it says, or all."""
    shown = document(comparison, brief=True)
    return shown.terminal() if all_tables else shown.terminal(1, sentences(comparison))


def html(comparison: ComparisonRecord) -> str:
    """The main table and what it says, for a notebook."""
    table, *_ = tables(comparison, brief=True)
    said = (setting(comparison), *sentences(comparison), *messages(comparison))
    return report_text.html_table(table) + "".join(f"<p>{escape(text)}</p>" for text in said)


def json_text(comparison: ComparisonRecord, frame: pd.DataFrame | None = None) -> str:
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
                **{key: plain(value) for key, value in row.items()},
            }
            for name, row in frame.iterrows()
        ],
    }
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def save(
    comparison: ComparisonRecord,
    folder: Path,
    figures: bool,
    *,
    title: str = "Comparison",
    notes: tuple[str, ...] = (),
) -> list[Path]:
    """Write the tables, the JSON, what a report needs, and the figures; see `Comparison.save`."""
    from slipcar.evaluation.report.scene import scene

    def draw() -> list[Path]:
        from slipcar.evaluation.figures import saved as plots

        return plots.save_all(comparison, folder)

    shown = document(comparison, title=title, notes=notes)
    written = write_texts(folder, {"results.json": json_text(comparison)})
    draw_if_wanted = draw if figures else None
    return written + save_document(
        shown, folder, draw_if_wanted, FIGURES, lambda: scene(comparison)
    )


def save_document(
    shown: Document,
    folder: Path,
    draw: Callable[[], list[Path]] | None = None,
    captions: Mapping[str, str] = MappingProxyType({}),
    animate: Callable[[], Mapping[str, Any]] | None = None,
) -> list[Path]:
    """Write a document, then once more with its animation and with the figures that were drawn.

    What takes long or can fail comes after the tables are there.

    Args:
        shown: without figures and scene.
        folder: made if it does not exist.
        draw: draws into the folder and returns the files; None for no figures.
        captions: stem -> caption, in the order in which figures are shown.
        animate: makes the scene; None for no animation.

    Returns:
        The files written.

    Raises:
        ImportError: without matplotlib; the tables are there all the same.
    """
    written = shown.save(folder)
    if animate is not None:
        shown = dataclasses.replace(shown, scene=animate())
        shown.save(folder)
    if draw is not None:
        with tables_are_in(folder):
            drawn = draw()
        stems = {path.stem for path in drawn}
        figures = tuple(Figure(stem, text) for stem, text in captions.items() if stem in stems)
        dataclasses.replace(shown, figures=figures).save(folder)
        written += drawn
    return written


@contextlib.contextmanager
def tables_are_in(folder: Path) -> Iterator[None]:
    """Where matplotlib is missing: say so, how to do without, and that the tables are there."""
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"figures need matplotlib ({error}): {install('plot')}, or do without "
            f"(figures=False, --no-figures); the tables are in {folder}"
        ) from error

"""How slippery: the paper's scenario with α² from 0 to 1. Where do the methods cross?

Planners know α² and plan for it. The policies were trained at the paper's 0.1 and drive on: what
they lose elsewhere is the price of not planning again.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.learned import learned_rows
from slipcar.evaluation.makers import Maker
from slipcar.evaluation.metrics import leading
from slipcar.evaluation.report.document import Document, Figure
from slipcar.evaluation.report.table import Column, Table, table_of
from slipcar.evaluation.suites.records import Suite, SuiteResult, Variant
from slipcar.evaluation.suites.shared import frames, notes

if TYPE_CHECKING:
    import pandas as pd

#: α²; β² is a tenth of it, as in the paper.
SLIPS = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
EPISODES = 4096
REFERENCE = "stochastic SCP + feedback"
#: Smaller differences, relative to the cost, are no reason to prefer anything.
MATTERS = 1e-3


def suite(episodes: int = EPISODES, slips: tuple[float, ...] = SLIPS) -> Suite:
    """The paper's scenario, from a dry road to one ten times as slippery.

    Args:
        episodes: of each row at each α², >= 1.
        slips: values of α², >= 0.

    Raises:
        ValueError: for a negative one, or less than two.
    """
    if len(slips) < 2:
        raise ValueError(f"slips must be at least two values of α², not {list(slips)}")
    rows: dict[str, Any] = {
        "deterministic SCP": Maker.of("deterministic"),
        "stochastic SCP": Maker.of("stochastic"),
        REFERENCE: Maker.of("feedback"),
        "planned feedback": Maker.of("planned-feedback"),
        "receding horizon": Maker.of("receding"),
        **learned_rows("paper", ("ppo", "pathwise")),
    }
    paper = Scenario.named("paper")
    variants = [
        Variant(f"α² = {slip:g}", float(slip), paper.replace(slip=(slip, 0.1 * slip)))
        for slip in sorted(slips)
    ]
    return Suite("slip", rows, variants, episodes, REFERENCE)


def document(result: SuiteResult) -> Document:
    """Cost and collisions against α², and where rows change places."""
    costs = wide(result, "total")
    rates = wide(result, "collision_rate")
    crossed = crossings(result)
    values = [variant.value for variant in result.suite.variants]
    tables = [
        _table(result, costs, "Mean cost of a path against α²", "total", "{:.3f}", 1.0),
        _table(result, rates, "Collisions at nodes [%] against α²", "collision", "{:.2f}", 100.0),
    ]
    if len(crossed):
        tables.append(
            table_of(
                crossed,
                "Where two methods change places in mean cost: α² between the two values at "
                "which the paired differences have intervals that exclude zero, with opposite "
                "signs (interpolated)",
                _CROSSING,
            )
        )
    return Document(
        kind="suite-slip",
        title="From dry to slippery",
        setting=(
            f"The paper's scenario with α² from {values[0]:g} to {values[-1]:g}, β² = α²/10; "
            f"{result.suite.episodes:,} episodes of each row at each, seed {result.seed}, the same "
            "Brownian paths everywhere. Planners know α²; policies were trained at α² = 0.1."
        ),
        tables=tuple(tables),
        notes=notes(result),
        figures=(
            Figure(
                "slip",
                "Mean cost of a path and collision rate against α², with 95 % intervals; the paper "
                "has α² = 0.1.",
            ),
        ),
        frames={"table": costs, "collisions": rates, "crossings": crossed, **frames(result)},
        provenance=result.provenance,
    )


def wide(result: SuiteResult, metric: str) -> pd.DataFrame:
    """One line a row, one column a variant (named by its value)."""
    import pandas as pd

    lines = {}
    for row in result.suite.rows:
        line: dict[str, Any] = {}
        for variant in result.suite.variants:
            found = result.results.get((row, variant.label))
            line[f"{variant.value:g}"] = (
                float("nan") if found is None else float(getattr(found, metric))
            )
        lines[row] = line
    return pd.DataFrame.from_dict(lines, orient="index").rename_axis("controller")


def crossings(result: SuiteResult) -> pd.DataFrame:
    """Pairs of rows whose order in mean cost is surely another at small α² than at large.

    Signs are of paired differences whose 95 % interval excludes zero and that are more than a
    thousandth of the cost; a change between two such values of α², with only undecided ones
    between, is a crossing, placed by interpolation.
    """
    import pandas as pd

    lines = []
    variants = result.suite.variants
    for first, second in itertools.combinations(result.suite.rows, 2):
        decided: list[tuple[float, float]] = []
        for variant in variants:
            pair = [result.results.get((row, variant.label)) for row in (first, second)]
            if pair[0] is None or pair[1] is None:
                continue
            mean, low, high = pair[0].difference(pair[1], "total")
            matters = abs(mean) > MATTERS * min(pair[0].total, pair[1].total)
            if matters and (low > 0.0 or high < 0.0):
                decided.append((variant.value, mean))
        for (a, before), (b, after) in itertools.pairwise(decided):
            if np.sign(before) != np.sign(after):
                lines.append(
                    {
                        "below": first if before < 0.0 else second,
                        "above": second if before < 0.0 else first,
                        "crossing": a + (b - a) * before / (before - after),
                        "crossing_low": a,
                        "crossing_high": b,
                    }
                )
    frame = pd.DataFrame(
        lines, columns=["below", "above", "crossing", "crossing_low", "crossing_high"]
    )
    frame.index = pd.Index([str(i + 1) for i in range(len(frame))], name="crossing no.")
    return frame


def _table(
    result: SuiteResult, frame: pd.DataFrame, caption: str, metric: str, form: str, scale: float
) -> Table:
    """One column for each α²; a row is emphasised where no interval ties another to it."""
    marks = {}
    for variant in result.suite.variants:
        found = leading(
            {
                row: cell
                for row in result.suite.rows
                if (cell := result.results.get((row, variant.label))) is not None
            },
            metric,
        )
        winner = found.winner if found is not None else None
        marks[f"{variant.value:g}_best"] = [row == winner for row in frame.index]

    def column(key: str) -> Column:
        return Column(key, lambda row: form.format(scale * row[key]), key, f"{key}_best")

    columns = tuple(column(str(key)) for key in frame.columns)
    return table_of(frame.assign(**marks), caption, columns)


_CROSSING = (
    Column("cheaper below", lambda row: str(row["below"])),
    Column("cheaper above", lambda row: str(row["above"])),
    Column(
        "α²",
        lambda row: f"{row['crossing']:.3f} [{row['crossing_low']:g}, {row['crossing_high']:g}]",
        value="crossing",
    ),
)

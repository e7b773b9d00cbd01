"""How fast methods learn: curves with bands, and what it takes to come as far as a plan.

Every training keeps the validation scores it met on the way (`training["history"]` of a policy:
steps, seconds, mean cost, collision rate). Seeds differ; a curve is their median, its band reaches
from the best to the worst. A cost counts as reached at the first validation that is no higher.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.evaluation.comparison_record import ComparisonRecord
from slipcar.evaluation.report.table import Column, Table, table_of
from slipcar.evaluation.rows import FEEDBACK, STEERED, STOCHASTIC
from slipcar.evaluation.runs import Runs

if TYPE_CHECKING:
    import pandas as pd

#: Rows whose cost learners are measured by.
TARGETS = (STOCHASTIC, FEEDBACK, STEERED)


@dataclasses.dataclass(frozen=True)
class Curve:
    """Validation scores of one training, each array (evaluations,).

    Attributes:
        label: of the training, such as "seed 0".
        steps: environment steps done.
        seconds: of training, of the processor as far as that is known.
        total: mean cost of a path.
        collision_rate: share of episodes.
    """

    label: str
    steps: np.ndarray
    seconds: np.ndarray
    total: np.ndarray
    collision_rate: np.ndarray

    def reached(self, cost: float) -> tuple[float, float]:
        """Steps and seconds at the first validation that costs at most `cost`; inf if none."""
        good = np.flatnonzero(self.total <= cost)
        if not len(good):
            return float("inf"), float("inf")
        return float(self.steps[good[0]]), float(self.seconds[good[0]])


def curves(rows: Mapping[str, Any]) -> dict[str, list[Curve]]:
    """Name -> curves of every row of several trainings that kept their history."""
    found: dict[str, list[Curve]] = {}
    for name, row in rows.items():
        if not isinstance(row, Runs):
            continue
        mine = [
            _curve(label, history)
            for label, policy in zip(row.labels, row.controllers, strict=True)
            if (history := getattr(policy, "training", {}).get("history"))
        ]
        if mine and min(len(curve.steps) for curve in mine) > 1:
            found[name] = mine
    return found


def _curve(label: str, history: list[dict[str, float]]) -> Curve:
    # Of the processor, where they were kept: a busy machine makes no learner slower.
    seconds = "cpu_seconds" if "cpu_seconds" in history[0] else "seconds"
    columns = ("steps", seconds, "total", "collision_rate")
    return Curve(label, *(np.array([float(at[name]) for at in history]) for name in columns))


def targets(comparison: ComparisonRecord) -> dict[str, tuple[float, float]]:
    """Name -> mean cost and planning time of the plans to be reached, cheapest last.

    The paper's plan, the same tracked by an LQR, and planned feedback, as far as there are such
    rows.
    """
    found = {
        name: (comparison.results[name].total, comparison.results[name].preparation_time)
        for name in TARGETS
        if name in comparison.results
    }
    return dict(sorted(found.items(), key=lambda item: -item[1][0]))


def frame(comparison: ComparisonRecord) -> pd.DataFrame:
    """One line a learned method and plan: what it takes to reach the plan's cost.

    Columns: cost, planning_time, runs, reached (how many trainings got there), and of those that
    did steps and seconds: median, least and most.
    """
    import pandas as pd

    lines = {}
    for name, mine in curves(comparison.controllers).items():
        for plan, (cost, planning) in targets(comparison).items():
            steps, seconds = np.array([curve.reached(cost) for curve in mine]).T
            there = np.isfinite(steps)
            line: dict[str, Any] = {
                "method": name,
                "target": plan,
                "cost": cost,
                "planning_time": planning,
                "runs": len(mine),
                "reached": int(there.sum()),
            }
            for kind, values in (("steps", steps), ("seconds", seconds)):
                shown = values[there] if there.any() else np.array([np.nan])
                line[f"{kind}_median"] = float(np.median(shown))
                line[f"{kind}_least"], line[f"{kind}_most"] = float(shown.min()), float(shown.max())
            lines[f"{name} → {plan}"] = line
    return pd.DataFrame.from_dict(lines, orient="index").rename_axis("learner → plan")


def table(comparison: ComparisonRecord) -> Table | None:
    """The printed form of :func:`frame`; None if no row kept a history."""
    numbers = frame(comparison)
    if not len(numbers):
        return None
    caption = (
        "Time and samples until a validation of the training costs no more than a plan does: "
        "median [least, most] of the trainings that got there"
    )
    return table_of(numbers, caption, _COLUMNS)


def _range(kind: str, unit: float, digits: int) -> Any:
    def text(row: Any) -> str:
        median, least, most = (row[f"{kind}_{part}"] / unit for part in ("median", "least", "most"))
        return f"{median:.{digits}f} [{least:.{digits}f}, {most:.{digits}f}]"

    return text


def _planning(row: Any) -> str:
    seconds = row["planning_time"]
    return f"{seconds:.2f} s" if seconds >= 0.1 else f"{1e3 * seconds:.2g} ms"


_COLUMNS = (
    Column("cost of the plan", lambda row: f"{row['cost']:.3f}", value="cost"),
    Column("planning takes", _planning, value="planning_time"),
    Column(
        "trainings that reach it", lambda row: f"{row['reached']} of {row['runs']}", value="reached"
    ),
    Column("steps [10⁶]", _range("steps", 1e6, 2), value="steps_median"),
    Column("seconds of training", _range("seconds", 1.0, 0), value="seconds_median"),
)

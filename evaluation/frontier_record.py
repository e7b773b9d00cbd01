"""The record of a frontier: its points, what came of them, and which are on the Pareto front.

:class:`slipcar.evaluation.frontier.Frontier` is one that can also write itself as text and figures.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.evaluation.comparison_record import ComparisonRecord
from slipcar.evaluation.controller import Controller
from slipcar.evaluation.runs import Runs
from slipcar.planner.display import brief

if TYPE_CHECKING:
    import pandas as pd

#: The methods that have a curve, and the family of all others.
OPEN_LOOP, FEEDBACK, RECEDING = "open loop", "planned feedback", "receding horizon"
CURVES = (OPEN_LOOP, FEEDBACK, RECEDING)
SINGLE = "single point"


@dataclasses.dataclass(frozen=True)
class Point:
    """One controller of the picture.

    Attributes:
        name: of its row.
        method: one of :data:`CURVES`, or :data:`SINGLE`.
        price: ν [cost per unit of probability]; nan for single points.
        controller: who drives.
    """

    name: str
    method: str
    price: float
    controller: Controller | Runs


@dataclasses.dataclass(frozen=True)
class FrontierRecord:
    """Points over common Brownian paths.

    Attributes:
        points: in the order of the table.
        comparison: their results, and where they come from.
        receding_episodes: a point of the receding horizon; `comparison.episodes` are the others'.
        notes: what a reader must be told: plans that did not converge, a policy that is missing.
    """

    points: tuple[Point, ...]
    comparison: ComparisonRecord
    receding_episodes: int
    notes: tuple[str, ...]

    __repr__ = brief

    @functools.cached_property
    def frame(self) -> pd.DataFrame:
        """One row a point, raw numbers in SI units.

        `effort_front` and `total_front` say whether no other row has at most the same collision
        rate and cost and less of one: the Pareto fronts, of estimates. Rows over fewer paths than
        the others are left out of it: luck decides more of theirs.
        """
        import pandas as pd

        found: dict[str, dict[str, Any]] = {}
        for point in self.points:
            row: dict[str, Any] = {"method": point.method, "price": point.price}
            result = self.comparison.results.get(point.name)
            if result is not None:
                row.update(result.summary())
            row["error"] = self.comparison.errors.get(point.name, "")
            found[point.name] = row
        frame = pd.DataFrame.from_dict(found, orient="index").rename_axis("controller")
        for cost in ("effort", "total"):
            frame[f"{cost}_front"] = False
            if cost in frame:  # not if all rows raised
                same = frame["episodes"] == self.comparison.episodes
                rates, costs = frame["collision_rate"].where(same), frame[cost].where(same)
                frame[f"{cost}_front"] = undominated(rates.to_numpy(), costs.to_numpy())
        return frame


def undominated(rates: np.ndarray, costs: np.ndarray) -> np.ndarray:
    """Which points are on the Pareto front: no other is as good in both and better in one.

    Args:
        rates: (n,) of numbers to be small; nan is not on the front and dominates nothing.
        costs: (n,) likewise.

    Returns:
        (n,) of bool.
    """
    rates, costs = np.asarray(rates, dtype=float), np.asarray(costs, dtype=float)
    no_worse = (rates[:, None] <= rates) & (costs[:, None] <= costs)
    better = (rates[:, None] < rates) | (costs[:, None] < costs)
    return ~(no_worse & better).any(axis=0) & np.isfinite(rates) & np.isfinite(costs)

"""What a plan tells of how it was found, beyond its iterations."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable

from slipcar.planner.status import Status


@dataclasses.dataclass(frozen=True)
class Alternative:
    """What one of several guesses led to.

    Attributes:
        label: the guess's.
        status: how it ended.
        cost: effort + penalties + running cost + w ∫ tr Σ dt.
        homotopy: `problem.homotopy_class` of its mean; None if the problem has no such member.
        iterations: sub-problems solved.
        same_as: label of a better-placed alternative that is the same answer, or None.
    """

    label: str
    status: Status
    cost: float
    homotopy: Hashable | None
    iterations: int
    same_as: str | None = None


@dataclasses.dataclass(frozen=True)
class TimeStep:
    """One horizon tried.

    Attributes:
        final_time: T [s].
        objective: V(T) + c T.
        slope: V′(T) + c, the transversality residual; NaN if the plan did not converge.
        radius: Δ it was within [s].
        accepted: whether it became the best.
        iterations: sub-problems solved.
    """

    final_time: float
    objective: float
    slope: float
    radius: float
    accepted: bool
    iterations: int

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


@dataclasses.dataclass(frozen=True)
class ExpectedCost:
    """What a plan costs in expectation, for Gaussian states (linearised moments).

    Attributes:
        effort: Σ dt ūᵀRū.
        feedback: Σ dt tr(K Σ Kᵀ R), the effort of the corrections.
        running: E Σ dt (H + ℓᵀu).
        penalty: E Σ dt Σ w max(0, c)².
        goal: E gᵀWg; 0 where the terminal condition is exact and its spread not charged.
        risk: Σ Φ(h/s) over nodes and constraints, at most 1: Boole's bound of the probability of
            any violation.
    """

    effort: float
    feedback: float
    running: float
    penalty: float
    goal: float
    risk: float

    @property
    def total(self) -> float:
        """All but the risk."""
        return self.effort + self.feedback + self.running + self.penalty + self.goal

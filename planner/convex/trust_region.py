"""How far a step may go: multipliers of E∫‖x − x_k‖² ≤ Δ (paper §3.1, SPEC §3.4).

The constraint enters the sub-problem through its multiplier (−p¹ of the paper) as a quadratic
penalty, which every backend takes; the radius a multiplier stands for is what its step
measures. A schedule proposes a multiplier, sees the step and says whether it is accepted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

#: Relative accuracy of the merit function and of its decrease by the model.
_MERIT_NOISE = 1e-8
#: Beyond this a step is as short as it can be, and rounding errors take over.
_LARGEST_MULTIPLIER = 1e8
#: A multiplier is dropped when its penalty is so small a part of what the step promised.
_NEGLIGIBLE = 1e-3


@dataclasses.dataclass(frozen=True)
class Step:
    """What a schedule judges a step by.

    Attributes:
        radius: ∫ E‖x − x_k‖² dt that the step takes.
        predicted: decrease of the merit function by the convex model, ≥ 0.
        actual: decrease of the merit function; −inf where the model functions are not finite.
        merit: merit function at the new iterate.
        before: merit function at the current one.
    """

    radius: float
    predicted: float
    actual: float
    merit: float
    before: float


class TrustRegion(Protocol):
    """A schedule of trust regions.

    Attributes:
        limits_radius: whether `fits` looks at the radius, which must then be measured in full
            even while the multiplier is zero.
        bold: whether the next step may be long and is not judged; control bounds may then wait.
        accelerates: whether steps may be lengthened or combined where they converge slowly.
    """

    limits_radius: bool
    accelerates: bool

    @property
    def bold(self) -> bool:
        """Whether the next step may be long and is not judged."""
        ...

    @property
    def multiplier(self) -> float:
        """Weight to solve the next sub-problem with."""
        ...

    def cautious(self, multiplier: float) -> TrustRegion | None:
        """A fresh schedule for a second attempt whose steps are short from the first, if any."""
        ...

    def fits(self, radius: float) -> bool:
        """Whether a step of this size is allowed; otherwise solve again with a new multiplier."""
        ...

    def judge(self, step: Step) -> bool:
        """Accept or reject, and adapt."""
        ...

    @property
    def collapsed(self) -> bool:
        """Whether no acceptable step is to be expected any more."""
        ...


class NoTrustRegion:
    """Every step is taken whole."""

    limits_radius = False
    multiplier = 0.0
    bold = False  # the control bounds are to act from the first step
    accelerates = False

    @property
    def collapsed(self) -> bool:
        """Whether a step was refused: there is no shorter one to try."""
        return self._refused

    def __init__(self) -> None:
        self._refused = False

    def cautious(self, multiplier: float) -> None:
        """There is no such schedule."""

    def fits(self, radius: float) -> bool:
        """Always."""
        return True

    def judge(self, step: Step) -> bool:
        """Accept whatever is finite."""
        self._refused = not step.actual > -float("inf")
        return not self._refused


class PaperTrustRegion:
    """Δ_{k+1} = 0.99 Δ_k from Δ_0 = 100, every step accepted (paper §6.4).

    The multiplier that makes the step fit is found by bracketing and bisection on its
    logarithm; the radius decreases with the multiplier.
    """

    limits_radius = True
    bold = False
    accelerates = False

    def __init__(self, radius: float = 100.0, shrink: float = 0.99) -> None:
        self.radius, self.shrink = radius, shrink
        self.multiplier = 0.0
        self._low, self._high = 0.0, float("inf")
        self._refused = False

    @property
    def collapsed(self) -> bool:
        """Whether a step was refused: the schedule is fixed and knows no shorter one."""
        return self._refused

    def cautious(self, multiplier: float) -> None:
        """There is no such schedule."""

    def fits(self, radius: float) -> bool:
        """Whether the step keeps Δ (to 1 %, from inside); moves the multiplier if not.

        Where the dynamics alone demand a longer step (assumption A₃ fails), the shortest there
        is passes.
        """
        if radius <= self.radius:
            tight = radius >= 0.99 * self.radius or self.multiplier == 0.0
            if tight or self._high <= 1.0001 * self._low:
                return True
            self._high = self.multiplier
        elif self.multiplier >= _LARGEST_MULTIPLIER:
            return True
        else:
            self._low = self.multiplier
        if self._high == float("inf"):
            self.multiplier = max(10.0 * self.multiplier, 1e-4)
        else:
            self.multiplier = (max(self._low, 1e-3 * self._high) * self._high) ** 0.5
        return False

    def judge(self, step: Step) -> bool:
        """Accept whatever is finite and shrink the radius."""
        self.radius *= self.shrink
        self.multiplier, self._low, self._high = 0.0, 0.0, float("inf")
        self._refused = not step.actual > -float("inf")
        return not self._refused


class AdaptiveTrustRegion:
    """Ratio of actual to predicted decrease of a merit function (as in SCvx and GuSTO).

    The multiplier is adapted directly. The first `free` steps are taken whole: the plain
    iteration converges from most guesses, and its bold early steps are what finds a way round
    the obstacles. Only where it has not settled by then is each step judged: the multiplier
    rises when one is rejected or barely pays and falls after good ones.
    """

    limits_radius = False
    accelerates = True

    def __init__(self, free: int = 25, patience: int = 30, multiplier: float = 0.0) -> None:
        self.multiplier = multiplier
        self._free, self._patience, self._was_free = free, patience, free > 0
        self._rejected = 0

    @property
    def bold(self) -> bool:
        """Whether free steps are left, but for a few that are taken within bounds."""
        return self._free > 10

    def cautious(self, multiplier: float) -> AdaptiveTrustRegion | None:
        """Every step judged, the first with this multiplier; None if these already were."""
        return AdaptiveTrustRegion(0, self._patience, multiplier) if self._was_free else None

    def fits(self, radius: float) -> bool:
        """Always: the multiplier already shaped the step."""
        return True

    def judge(self, step: Step) -> bool:
        """Accept or reject, and adapt the multiplier."""
        finite = step.actual > -float("inf")
        self._free -= 1
        if self._free >= 0 and finite:
            return True
        # The multiplier that makes the penalty as large as what the step promised.
        natural = step.predicted / max(step.radius, 1e-300)
        # At the end rounding errors are all that is left of both: no reason to change anything.
        noise = _MERIT_NOISE * (1.0 + abs(step.before))
        if finite and step.predicted <= noise and step.actual >= -noise:
            self._rejected = 0
            return True
        ratio = step.actual / max(step.predicted, 1e-300)
        if not finite or ratio < 1e-3:
            self._rejected += 1
            self.multiplier = max(4.0 * self.multiplier, 0.5 * natural) or 1.0
            return False
        self._rejected = 0
        if ratio > 0.7:
            self.multiplier /= 4.0
            if self.multiplier < _NEGLIGIBLE * natural:
                self.multiplier = 0.0
        elif ratio < 0.3:
            self.multiplier *= 2.0
        return True

    @property
    def collapsed(self) -> bool:
        """Whether too many steps in a row were rejected."""
        return self._rejected > self._patience


#: Constructors by name.
TRUST_REGIONS: dict[str, Callable[[], TrustRegion]] = {
    "adaptive": AdaptiveTrustRegion,
    "paper": PaperTrustRegion,
    "none": NoTrustRegion,
}

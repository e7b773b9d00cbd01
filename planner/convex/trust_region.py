"""How far a step may go: multipliers of E∫‖x − x_k‖² ≤ Δ (paper §3.1, §6.4).

The constraint enters the sub-problem through its multiplier (−p¹ of the paper) as a quadratic
penalty, which every backend takes; the radius a multiplier stands for is what its step
measures. A schedule proposes a multiplier, sees the step and says whether it is accepted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

#: Of the free steps so many are taken within the control bounds.
_WITHIN_BOUNDS = 10
#: Relative accuracy of the merit function and of its decrease by the model.
_MERIT_NOISE = 1e-8
#: Beyond this a step is as short as it can be, and rounding errors take over.
_LARGEST_MULTIPLIER = 1e8
#: A multiplier is dropped when its penalty is so small a part of what the step promised.
_NEGLIGIBLE = 1e-3


@dataclasses.dataclass(frozen=True)
class Step:
    """What a schedule judges a step by."""

    radius: float  # ∫ E‖x − x_k‖² dt that the step takes
    predicted: float  # decrease of the merit function by the convex model, ≥ 0
    actual: float  # decrease of the merit function; −inf where something is not finite
    before: float  # merit function at the current iterate


class TrustRegion:
    """A schedule of trust regions; as it stands every step is taken whole."""

    multiplier = 0.0  # weight to solve the next sub-problem with
    bold = False  # the next step may be long and is not judged; control bounds may then wait
    collapsed = False  # no acceptable step is to be expected any more
    limits_radius = False  # `fits` looks at the radius: measure it in full, whatever the multiplier
    accelerates = False  # steps may be lengthened or combined where they converge slowly
    scaled = False  # in units of the problem's size, not the user's

    def cautious(self, multiplier: float) -> TrustRegion | None:
        """A fresh schedule for a second attempt whose steps are short from the first, if any."""
        return None

    def fits(self, radius: float) -> bool:
        """Whether a step of this size is allowed; otherwise solve again with a new multiplier."""
        return True

    def judge(self, step: Step) -> bool:
        """Accept or reject, and adapt; here whatever is finite is accepted."""
        self.collapsed = not step.actual > -math.inf  # there is no shorter step to try
        return not self.collapsed


class PaperTrustRegion(TrustRegion):
    """Δ_{k+1} = 0.99 Δ_k from Δ_0 = 100, every step accepted (paper §6.4).

    The multiplier that makes the step fit is found by bracketing and bisection on its
    logarithm; the radius decreases with the multiplier.
    """

    limits_radius = True

    def __init__(self, radius: float = 100.0, shrink: float = 0.99) -> None:
        self.radius, self.shrink = radius, shrink
        self._low, self._high = 0.0, math.inf

    def fits(self, radius: float) -> bool:
        """Whether the step keeps Δ (to 1 %, from inside); moves the multiplier if not.

        Where the dynamics alone demand a longer step (assumption A₃ fails), the shortest passes.
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
        if self._high == math.inf:
            self.multiplier = max(10.0 * self.multiplier, 1e-4)
        else:
            self.multiplier = (max(self._low, 1e-3 * self._high) * self._high) ** 0.5
        return False

    def judge(self, step: Step) -> bool:
        """Accept whatever is finite and shrink the radius."""
        self.radius *= self.shrink
        self.multiplier, self._low, self._high = 0.0, 0.0, math.inf
        return super().judge(step)


class AdaptiveTrustRegion(TrustRegion):
    """Ratio of actual to predicted decrease of a merit function (as in SCvx and GuSTO).

    The multiplier is adapted directly. The first `free` steps are taken whole: the plain
    iteration converges from most guesses, and its bold early steps are what finds a way round
    the obstacles. Only where it has not settled by then is each step judged: the multiplier
    rises when one is rejected or barely pays and falls after good ones.
    """

    accelerates = scaled = True

    def __init__(self, free: int = 25, patience: int = 30, multiplier: float = 0.0) -> None:
        self.multiplier, self.bold = multiplier, free > _WITHIN_BOUNDS
        self._free, self._patience, self._was_free = free, patience, free > 0
        self._rejected = 0

    def cautious(self, multiplier: float) -> AdaptiveTrustRegion | None:
        """Every step judged, the first with this multiplier; None if these already were."""
        return AdaptiveTrustRegion(0, self._patience, multiplier) if self._was_free else None

    def judge(self, step: Step) -> bool:
        """Accept or reject, and adapt the multiplier."""
        self._free -= 1
        self.bold = self._free > _WITHIN_BOUNDS
        if self._free >= 0 and step.actual > -math.inf:
            return True
        # The multiplier that makes the penalty as large as what the step promised.
        natural = step.predicted / max(step.radius, 1e-300)
        ratio = step.actual / max(step.predicted, 1e-300)
        # At the end rounding errors are all that is left of both: no reason to change anything.
        noise = _MERIT_NOISE * (1.0 + abs(step.before))
        if step.predicted <= noise and step.actual > -noise:
            ratio = 0.5
        if ratio < 1e-3:
            self._rejected += 1
            self.collapsed = self._rejected > self._patience
            self.multiplier = max(4.0 * self.multiplier, 0.5 * natural) or 1.0
            return False
        self._rejected, self.collapsed = 0, False
        if ratio > 0.7:
            self.multiplier /= 4.0
            if self.multiplier < _NEGLIGIBLE * natural:
                self.multiplier = 0.0
        elif ratio < 0.3:
            self.multiplier *= 2.0
        return True


#: Constructors by name.
TRUST_REGIONS: dict[str, Callable[[], TrustRegion]] = {
    "adaptive": AdaptiveTrustRegion,
    "paper": PaperTrustRegion,
    "none": TrustRegion,
}

"""The price of risk at which a plan is as risky as allowed, and no safer.

A plan minimises cost + ν · (predicted risk): the dearer the risk, ν, the fewer paths violate. Of
the rate P(ν), measured on common random numbers, this finds

    (1 − tolerance) δ ≤ P(ν) ≤ δ

in few evaluations, each of which is a plan and a Monte Carlo. log P is nearly linear in log ν
(its slope goes from about −1/2 where risk is cheap to −1 where it is dear), so a secant in those
coordinates needs two or three; safeguards are for all else: rates of zero, plateaus, noise that
breaks monotonicity, and planners that fail. (A root finder has nothing to say to these.)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

#: −d log P / d log ν: assumed where only one rate is known, and the range believed of a secant.
_SLOPE, _FLATTEST, _STEEPEST = 0.7, 0.3, 4.0
#: Largest step in price away from what is known, and downwards, where rates near zero say little.
_FARTHEST, _DOWN = 100.0, 10.0
#: A bracket this narrow (ratio of prices) is not worth another plan.
_NARROW = 1.05
#: Prices below this share of the first are as good as none.
_SMALLEST = 1e-6


@dataclasses.dataclass(frozen=True)
class Trial:
    """A price ν, the answer there and its rate; None where solving failed."""

    price: float
    answer: Any | None
    rate: float | None


@dataclasses.dataclass(frozen=True)
class PriceSearch:
    """What a search came to; None and NaN without any answer."""

    best: Any  #: the answer at the least price that keeps the target, else that of the least rate
    price: float
    rate: float
    reached: bool  #: whether its rate is at most the target
    tried: tuple[Trial, ...]


def search_price(
    solve: Callable[[float], Any | None],
    measure: Callable[[Any], float],
    *,
    target: float,
    start: float,
    largest: float,
    evaluations: int = 12,
    tolerance: float = 0.15,
    resolution: float = 0.0,
) -> PriceSearch:
    """Find a price whose rate is at most the target and not far below it.

    Args:
        solve: price -> answer, or None if it fails. Where it fails above a price that is still
            too risky, the search closes in on the dearest price that it solves.
        measure: answer -> rate in [0, 1]; falls with the price, up to noise.
        target: δ > 0.
        start: the first price. At 10⁻⁶ of it, risk is held to be free.
        largest: no price beyond is tried, ≥ `start`.
        evaluations: how many solves at most.
        tolerance: rates from (1 − tolerance) · target on are near enough, in (0, 1).
        resolution: the least rate `measure` can tell from zero (1 / episodes). Zero counts as
            half of it; if not given, as a hundredth of the target. The last multiple of it within
            the target is near enough whatever the tolerance says.
    """
    near = min((1.0 - tolerance) * target, target - 0.999 * resolution)
    # The middle of what is accepted, on the logarithmic scale, is what steps aim at.
    aim, zero = target * math.sqrt(1.0 - tolerance), 0.5 * resolution or 0.01 * target
    search = _Search(_SMALLEST * start, largest)
    trials: list[Trial] = []
    price: float | None = start
    while price is not None and len(trials) < evaluations:
        answer = solve(price)
        rate = None if answer is None else float(measure(answer))
        trials.append(Trial(price, answer, rate))
        if rate is None:
            search.failed = price
        elif near <= rate <= target:
            break
        else:
            search.add(_End(price, math.log(max(rate, zero) / aim)), rate > target)
        price = search.next_price()
    solved = [(t.rate, t.price, t.answer) for t in trials if t.rate is not None]
    kept = [row for row in solved if row[0] <= target]
    if kept:
        best = min(kept, key=lambda row: row[1])
    else:
        best = min(solved, key=lambda row: row[:2], default=(math.nan, math.nan, None))
    return PriceSearch(best[2], best[1], best[0], bool(kept), tuple(trials))


class _End(NamedTuple):
    """An end of the bracket: a price, and log(rate / aim) there, a rate of zero replaced."""

    price: float
    excess: float


@dataclasses.dataclass(eq=False)
class _Search:
    """The prices that enclose the one looked for: `low` is too risky; `high`, dearer, is not.

    Either may be missing. `before` is the answer before the last, `failed` the price at which
    solving failed last, and `width` the bracket's when a secant was last drawn in it.
    """

    smallest: float
    largest: float
    low: _End | None = None
    high: _End | None = None
    before: _End | None = None
    failed: float | None = None
    width: float = math.inf

    def add(self, end: _End, risky: bool) -> None:
        """Take in an answer."""
        self.before = self.low or self.high
        if risky:
            self.low = end
        else:
            self.high = end

    def next_price(self) -> float | None:
        """Where to look next; None when there is nothing left to gain."""
        low, high, failed = self.low, self.high, self.failed
        if low is not None and high is not None:
            return self._between(low, high)
        if low is not None:  # on to a higher price, short of those that fail
            price = min(low.price * self._stride(low, _FARTHEST), self.largest)
            if failed is not None and failed > low.price:
                price = min(price, math.sqrt(low.price * failed))
            return price if price > _NARROW * low.price else None
        if high is not None:
            lower = high.price / self._stride(high, _DOWN)
            return max(lower, self.smallest) if high.price > self.smallest else None
        assert failed is not None
        return max(failed / 10.0, self.smallest) if failed > self.smallest else None

    def _stride(self, end: _End, largest: float) -> float:
        """Ratio of prices from the last answer to where the rate should be the aim.

        By the secant through the last two, within the slopes that are believed; on a plateau,
        where a secant says nothing, ever faster.
        """
        slope, least = _SLOPE, 1.1
        if self.before is not None:
            moved = math.log(end.price / self.before.price)
            slope = (self.before.excess - end.excess) / moved
            if slope < _FLATTEST:
                least = min(max(3.0, math.exp(2.0 * abs(moved))), _FARTHEST)
            slope = min(max(slope, _FLATTEST), _STEEPEST)
        return max(math.exp(min(abs(end.excess) / slope, math.log(largest))), least)

    def _between(self, low: _End, high: _End) -> float | None:
        """On the secant between the ends; halfway if it misleads, or around a failure."""
        a, b = math.log(low.price), math.log(high.price)
        if b - a < math.log(_NARROW):
            return None
        if self.failed is not None and low.price < self.failed < high.price:
            c = math.log(self.failed)
            return math.exp(0.5 * (a + c) if c - a > b - c else 0.5 * (c + b))
        last, self.width = self.width, b - a
        if self.width > 0.5 * last:  # a secant that does not halve the bracket misleads
            return math.exp(0.5 * (a + b))
        # Not next to the ends, where it would learn nothing.
        fraction = min(max(low.excess / (low.excess - high.excess), 0.05), 0.95)
        return math.exp(a + fraction * (b - a))

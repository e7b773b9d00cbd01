"""The price of risk at which a plan is as risky as allowed, and no safer.

A plan minimises cost + ν · (predicted risk): the dearer the risk, ν, the fewer paths violate. Of
the rate P(ν), measured on common random numbers, this finds

    (1 − tolerance) δ ≤ P(ν) ≤ δ

in few evaluations, each of which is a plan and a Monte Carlo. log P is nearly linear in log ν
(its slope goes from about −1/2 where risk is cheap to −1 where it is dear), so a secant in those
coordinates needs two or three; safeguards are for all else: rates of zero, plateaus, noise that
breaks monotonicity, and planners that fail.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from slipcar.planner.options import check_count, check_number

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
    """One price tried.

    Attributes:
        price: ν.
        answer: what `solve` gave; None where it failed.
        rate: what `measure` said of it; None where there was no answer.
    """

    price: float
    answer: Any | None
    rate: float | None


@dataclasses.dataclass(frozen=True)
class PriceSearch:
    """What was found.

    Attributes:
        best: the answer at the least price that keeps the target; if none does, that of the
            least rate; None if every solve failed.
        price: its price; NaN without one.
        rate: its rate; NaN without one.
        reached: whether its rate is at most the target.
        tried: every price, in order.
    """

    best: Any | None
    price: float
    rate: float
    reached: bool
    tried: tuple[Trial, ...]


def search_price(
    solve: Callable[[float, Any | None], Any | None],
    measure: Callable[[Any], float],
    *,
    target: float,
    first: float,
    largest: float,
    evaluations: int = 12,
    tolerance: float = 0.15,
    resolution: float = 0.0,
) -> PriceSearch:
    """Find a price whose rate is at most the target and not far below it.

    Args:
        solve: (price, warm) -> answer, or None if it fails; `warm` is the answer at the nearest
            price that has one, None if there is none yet. Where it fails above a price that is
            still too risky, the search closes in on the dearest price that it solves.
        measure: answer -> rate in [0, 1]; falls with the price, up to noise.
        target: δ > 0.
        first: the price to begin with, > 0. Below 10⁻⁶ of it, risk is held to be free: if even
            there the rate keeps the target, the answer there is taken.
        largest: no price beyond is tried, ≥ `first`.
        evaluations: how many solves at most.
        tolerance: rates from (1 − tolerance) · target on are near enough, in (0, 1).
        resolution: the least rate `measure` can tell from zero (1 / episodes). Zero counts as
            half of it; if not given, as a hundredth of the target. The last multiple of it within
            the target is near enough whatever the tolerance says.

    Raises:
        ValueError: naming the bad number.
    """
    check_number("target", target)
    check_number("first", first)
    check_count("evaluations", evaluations)
    check_number("resolution", resolution, zero_allowed=True)
    check_number("largest", largest)
    if largest < first:
        raise ValueError(f"largest must be at least first = {first!r}, not {largest!r}")
    check_number("tolerance", tolerance)
    if tolerance >= 1.0:
        raise ValueError(f"tolerance must be in (0, 1), not {tolerance!r}")
    near = min((1.0 - tolerance) * target, target - 0.999 * resolution)
    # The middle of what is accepted, on the logarithmic scale, is what steps aim at.
    search = _Search(
        aim=target * math.sqrt(1.0 - tolerance),
        target=target,
        zero=0.5 * resolution or 0.01 * target,
        smallest=_SMALLEST * first,
        largest=largest,
    )
    price: float | None = first
    while price is not None and len(search.trials) < evaluations:
        answer = solve(price, search.nearest(price))
        rate = None if answer is None else float(measure(answer))
        search.add(Trial(price, answer, rate))
        if rate is not None and near <= rate <= target:
            break
        price = search.next_price()
    return search.result()


class _Search:
    """Trials so far, and the prices that enclose the one looked for.

    `low` is a trial above the target and `high` one below, dearer than `low`; either may be
    missing. `failed` is the price at which solving failed last.
    """

    def __init__(
        self, aim: float, target: float, zero: float, smallest: float, largest: float
    ) -> None:
        self.aim, self.target, self.zero = aim, target, zero
        self.smallest, self.largest = smallest, largest
        self.trials: list[Trial] = []
        self.low: Trial | None = None
        self.high: Trial | None = None
        self.failed: float | None = None
        self._width = math.inf  # of the bracket, when a secant was last drawn in it

    def nearest(self, price: float) -> Any | None:
        """The answer at the nearest price, on the logarithmic scale."""
        solved = [trial for trial in self.trials if trial.rate is not None]
        if not solved:
            return None
        return min(solved, key=lambda trial: abs(math.log(trial.price / price))).answer

    def add(self, trial: Trial) -> None:
        """Take in a trial: it becomes an end of the bracket, or the price that fails."""
        self.trials.append(trial)
        if trial.rate is None:
            self.failed = trial.price
            return
        if trial.rate > self.target:
            self.low = trial
        else:
            self.high = trial

    def next_price(self) -> float | None:
        """Where to look next; None when there is nothing left to gain."""
        if self.high is None:
            return self._dearer() if self.low is not None else self._cheaper_than_failure()
        return self._cheaper() if self.low is None else self._between()

    def result(self) -> PriceSearch:
        """The best of the trials."""
        solved = [(t.rate, t.price, t) for t in self.trials if t.rate is not None]
        if not solved:
            return PriceSearch(None, math.nan, math.nan, False, tuple(self.trials))
        kept = [row for row in solved if row[0] <= self.target]
        if kept:
            rate, price, best = min(kept, key=lambda row: row[1])
        else:
            rate, price, best = min(solved, key=lambda row: row[:2])
        return PriceSearch(best.answer, price, rate, bool(kept), tuple(self.trials))

    def _excess(self, trial: Trial) -> float:
        """log(rate / aim), a rate of zero taken for `zero`."""
        assert trial.rate is not None
        return math.log(max(trial.rate, self.zero) / self.aim)

    def _stride(self, trial: Trial, largest: float) -> float:
        """Ratio of prices from the trial, the last one, to where the rate should be the aim.

        By the secant through the last two answers, within the slopes that are believed; on a
        plateau, where a secant says nothing, ever faster.
        """
        slope, least = _SLOPE, 1.1
        solved = [t for t in self.trials if t.rate is not None and t is not trial]
        if solved:
            before = solved[-1]
            moved = math.log(trial.price / before.price)
            slope = (self._excess(before) - self._excess(trial)) / moved
            if slope < _FLATTEST:
                least = min(max(3.0, math.exp(2.0 * abs(moved))), _FARTHEST)
            slope = min(max(slope, _FLATTEST), _STEEPEST)
        wanted = math.exp(min(abs(self._excess(trial)) / slope, math.log(largest)))
        return max(wanted, least)

    def _dearer(self) -> float | None:
        """All answers are too risky: on to a higher price, short of those that fail."""
        assert self.low is not None
        price = min(self.low.price * self._stride(self.low, _FARTHEST), self.largest)
        if self.failed is not None and self.failed > self.low.price:
            price = min(price, math.sqrt(self.low.price * self.failed))
        return price if price > _NARROW * self.low.price else None

    def _cheaper(self) -> float | None:
        """All answers are safer than asked: on to a lower price."""
        assert self.high is not None
        if self.high.price <= self.smallest:
            return None
        return max(self.high.price / self._stride(self.high, _DOWN), self.smallest)

    def _cheaper_than_failure(self) -> float | None:
        """No answer at all yet."""
        assert self.failed is not None
        return max(self.failed / 10.0, self.smallest) if self.failed > self.smallest else None

    def _between(self) -> float | None:
        """On the secant between the ends; halfway if it misleads, or around a failure."""
        assert self.low is not None
        assert self.high is not None
        a, b = math.log(self.low.price), math.log(self.high.price)
        if b - a < math.log(_NARROW):
            return None
        if self.failed is not None and self.low.price < self.failed < self.high.price:
            c = math.log(self.failed)
            return math.exp(0.5 * (a + c) if c - a > b - c else 0.5 * (c + b))
        last, self._width = self._width, b - a
        if self._width > 0.5 * last:  # a secant that does not halve the bracket misleads
            return math.exp(0.5 * (a + b))
        up, down = self._excess(self.low), self._excess(self.high)
        # Not next to the ends, where it would learn nothing.
        fraction = min(max(up / (up - down), 0.05), 0.95)
        return math.exp(a + fraction * (b - a))

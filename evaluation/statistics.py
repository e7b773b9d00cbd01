"""Intervals and errors: how far a Monte-Carlo number can be trusted (docs/comparison.md)."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from slipcar.planner.search.risk import CONFIDENCE, wilson_interval

__all__ = [
    "CONFIDENCE",
    "Leader",
    "bca_interval",
    "cvar",
    "episodes_for",
    "leader",
    "paired_difference",
    "quantile",
    "rate_interval",
    "standard_error",
    "student_interval",
    "welch",
    "wilson_interval",
]

#: Bootstrap replications.
RESAMPLES = 2000
#: Samples with more different values than this are sorted into as many groups of neighbours, and
#: so many values at either end stay by themselves.
GROUPS, EXTREMES = 4096, 1024
#: Up to so many values no groups are made.
UNGROUPED = 32_768


def standard_error(values: np.ndarray) -> float:
    """Standard error of the mean of (n,) values; nan for a single one."""
    if len(values) < 2:
        return float("nan")
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))


def rate_interval(values: np.ndarray) -> tuple[float, float]:
    """Wilson 95 % interval of the mean of (n,) values in [0, 1].

    Exact counts are 0 and 1; probabilities in between vary less, so for them the interval errs on
    the safe side.
    """
    return wilson_interval(float(np.sum(values)), len(values))


def quantile(values: np.ndarray, q: float) -> float:
    """The smallest of the (n,) values that a share q of them does not exceed.

    No interpolation: between infinities (no obstacles) there is nothing to interpolate.
    """
    return float(np.quantile(values, q, method="inverted_cdf"))


def cvar(values: np.ndarray, share: float) -> tuple[float, float]:
    """Conditional value at risk: the mean of the largest values, with its standard error.

    CVaR = VaR + E[(X − VaR)⁺] / share, VaR the (1 − share) quantile (Rockafellar and Uryasev
    2000); the error is that of the mean of what is in brackets, VaR held fixed, as it may be to
    first order.

    Args:
        values: (n,).
        share: of the values that are averaged, in (0, 1), such as 0.05.

    Returns:
        The mean, and its standard error (nan for a single value or infinite ones).
    """
    var = quantile(values, 1.0 - share)
    if not np.isfinite(var):
        return var, float("nan")
    excess = np.maximum(np.asarray(values, dtype=np.float64) - var, 0.0)
    return var + float(excess.mean()) / share, standard_error(excess) / share


class Interval(NamedTuple):
    """A mean and the ends of its 95 % interval."""

    mean: float
    low: float
    high: float


def paired_difference(
    values: np.ndarray, reference: np.ndarray, resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Mean of `values − reference` over common paths, with its BCa bootstrap 95 % interval.

    Episode i of both met the same Brownian path, so their difference is resampled, not they: what
    the path did to both cancels. See :func:`bca_interval`.

    Args:
        values: (n,) per-episode numbers (booleans count as 0 and 1).
        reference: (n,) the reference row's, same episodes.
        resamples: bootstrap replications.
        seed: of the resampling; the same seed gives the same interval.

    Returns:
        The mean difference, and the interval's ends (nan for a single episode).

    Raises:
        ValueError: if the two have not the same number of episodes.
    """
    if np.shape(values) != np.shape(reference) or np.ndim(values) != 1:
        raise ValueError(
            f"paired rows need the same episodes: shapes {np.shape(values)} and "
            f"{np.shape(reference)}"
        )
    difference = np.asarray(values, dtype=np.float64) - np.asarray(reference, dtype=np.float64)
    return bca_interval(difference, resamples, seed)


class Leader(NamedTuple):
    """Who has the least mean, and whom the intervals do not tell apart from it."""

    name: str
    tied: tuple[str, ...]

    @property
    def winner(self) -> str | None:
        """The name, where everybody else's difference has an interval that excludes zero."""
        return None if self.tied else self.name


def leader(means: Mapping[str, float], difference: Callable[[str, str], Interval]) -> Leader | None:
    """Who has the least of some means, if anybody has one and there is somebody to beat.

    Args:
        means: by name; those that are nan take no part.
        difference: of the first name's mean to the second's, with its 95 % interval.
    """
    known = {name: mean for name, mean in means.items() if mean == mean}
    if len(known) < 2:
        return None
    best = min(known, key=known.__getitem__)
    rivals = [name for name in known if name != best]
    return Leader(best, tuple(name for name in rivals if not difference(name, best).low > 0.0))


def bca_interval(
    values: np.ndarray, resamples: int = RESAMPLES, seed: int = 0, level: float = CONFIDENCE
) -> Interval:
    """Mean of (n,) values with its bias-corrected and accelerated bootstrap interval.

    Efron (1987). The acceleration needs a jackknife, which for a mean is known in closed form:
    a = Σ (x_i − x̄)³ / (6 (Σ (x_i − x̄)²)^{3/2}). A bootstrap sample of n values out of g different
    ones is a multinomial draw of counts, so what is drawn grows with g and not with n. Many
    different values are sorted into :data:`GROUPS` groups of neighbours, each standing for its
    mean, the extreme ones each for itself; what variance is lost within groups is put back by a
    factor on the deviations.

    Args:
        values: (n,), finite.
        resamples: bootstrap replications.
        seed: of the resampling.
        level: coverage, in (0, 1).

    Returns:
        The mean and the interval's ends (nan for a single value; the mean itself where all values
        are equal).
    """
    values = np.asarray(values, dtype=np.float64)
    n, mean = len(values), float(np.mean(values))
    if n < 2:
        return Interval(mean, float("nan"), float("nan"))
    centred = values - mean
    squares = float(centred @ centred)
    if squares <= n * (1e-14 * max(1.0, abs(mean))) ** 2:
        return Interval(mean, mean, mean)
    means = mean + _resampled_means(centred, resamples, np.random.default_rng(seed))
    acceleration = float(np.sum(centred**3)) / (6.0 * squares**1.5)
    normal = statistics.NormalDist()
    # Ties are shared between both sides: rates take few values.
    below = (np.sum(means < mean) + 0.5 * np.sum(means == mean)) / resamples
    bias = normal.inv_cdf(min(max(float(below), 0.5 / resamples), 1.0 - 0.5 / resamples))
    ends = []
    for tail in (0.5 - 0.5 * level, 0.5 + 0.5 * level):
        z = bias + normal.inv_cdf(tail)
        ends.append(normal.cdf(bias + z / (1.0 - acceleration * z)))
    low, high = np.quantile(means, ends)
    return Interval(mean, float(low), float(high))


def _resampled_means(values: np.ndarray, resamples: int, rng: np.random.Generator) -> np.ndarray:
    """Means of bootstrap samples of (n,) values, (resamples,)."""
    n = len(values)
    if n <= UNGROUPED:
        different, counts = np.unique(values, return_counts=True)
        if len(different) > GROUPS:
            return _by_index(values, resamples, rng)
    else:
        different, counts = _groups(values)
    kept = float(counts @ (different - counts @ different / n) ** 2)
    # What lies within groups is missing in their variance, and put back.
    scale = np.sqrt(n * np.var(values) / kept)
    # 16 MB of counts at a time, whatever the size.
    means = []
    for first in range(0, resamples, size := max(1, 2_000_000 // len(different))):
        drawn = rng.multinomial(n, counts / n, size=min(size, resamples - first))
        means.append(drawn @ different / n)
    return scale * np.concatenate(means)


def _by_index(values: np.ndarray, resamples: int, rng: np.random.Generator) -> np.ndarray:
    n = len(values)
    means = np.empty(resamples)
    for first in range(0, resamples, size := max(1, 500_000 // n)):
        rows = min(size, resamples - first)
        chosen = rng.integers(0, n, size=(rows, n), dtype=np.int32)
        means[first : first + rows] = values[chosen].mean(axis=1)
    return means


def _groups(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Different values and how often each comes, or groups of neighbours and their sizes."""
    ordered = np.sort(values)
    first = np.flatnonzero(np.diff(ordered, prepend=-np.inf))
    if len(first) > GROUPS:
        n = len(ordered)
        middle = EXTREMES + np.arange(GROUPS) * (n - 2 * EXTREMES) // GROUPS
        first = np.concatenate([np.arange(EXTREMES), middle, np.arange(n - EXTREMES, n)])
    counts = np.diff(first, append=len(ordered))
    return np.add.reduceat(ordered, first) / counts, counts


def student_interval(
    mean: float, error: float, freedom: float, level: float = CONFIDENCE
) -> Interval:
    """Interval of a mean from its standard error, by Student's t.

    For methods trained several times: an interval for the method, not just for these trainings.

    Args:
        mean: the mean.
        error: its standard error, of trainings and paths together.
        freedom: degrees of freedom, see :func:`welch`; inf takes the normal distribution.
        level: coverage, in (0, 1).
    """
    if math.isinf(freedom):
        factor = statistics.NormalDist().inv_cdf(0.5 + 0.5 * level)
    else:
        from scipy import stats  # here: half a second that `--help` need not wait

        factor = float(stats.t.ppf(0.5 + 0.5 * level, freedom))
    return Interval(mean, mean - factor * error, mean + factor * error)


def welch(*parts: tuple[float, int]) -> tuple[float, float]:
    """Standard error and degrees of freedom of a sum of independent parts (Welch, Satterthwaite).

    Args:
        *parts: standard errors, and the sizes of the samples they were estimated from (>= 2).

    Returns:
        √Σ s², and (Σ s²)² / Σ (s⁴ / (n − 1)); inf where all parts are zero.
    """
    total = sum(error**2 for error, _ in parts)
    spread = sum(error**4 / max(1, size - 1) for error, size in parts)
    return math.sqrt(total), (total**2 / spread if spread > 0.0 else float("inf"))


def half_width(rate: float, episodes: int) -> float:
    """Half the width of the Wilson 95 % interval of a rate over so many episodes."""
    low, high = wilson_interval(rate * episodes, episodes)
    return 0.5 * (high - low)


def episodes_for(resolution: float, rate: float) -> int:
    """The fewest episodes for which the rate's 95 % interval is at most ± `resolution`.

    Args:
        resolution: half width, in (0, 0.5).
        rate: what the rate is expected to be, in [0, 1].

    Raises:
        ValueError: for numbers out of range.
    """
    if not 0.0 < resolution < 0.5:
        raise ValueError(f"resolution must be between 0 and 0.5 (50 %), not {resolution:g}")
    if not 0.0 <= rate <= 1.0:
        raise ValueError(f"rate must be between 0 and 1, not {rate:g}")
    low, high = 1, 2
    while half_width(rate, high) > resolution:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if half_width(rate, middle) > resolution else (low, middle)
    return high

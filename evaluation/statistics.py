"""Intervals and errors: how far a Monte-Carlo number can be trusted."""

from __future__ import annotations

import numpy as np

from slipcar.planner.risk import CONFIDENCE, wilson_interval

__all__ = ["CONFIDENCE", "paired_difference", "standard_error", "wilson_interval"]


def standard_error(values: np.ndarray) -> float:
    """Standard error of the mean of (n,) values; nan for a single one."""
    if len(values) < 2:
        return float("nan")
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))


def paired_difference(
    values: np.ndarray, reference: np.ndarray, resamples: int = 1000, seed: int = 0
) -> tuple[float, float, float]:
    """Mean of `values − reference` over common paths, with its bootstrap 95 % interval.

    Episode i of both met the same Brownian path, so their difference is resampled, not they:
    what the path did to both cancels. Percentile bootstrap (bias correction costs n² here and
    changes nothing for a mean of thousands).

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
    mean = float(difference.mean())
    if len(difference) < 2:
        return mean, float("nan"), float("nan")
    from scipy import stats  # here: half a second that `--help` need not wait

    interval = stats.bootstrap(
        (difference,),
        np.mean,
        n_resamples=resamples,
        batch=max(1, 2_000_000 // len(difference)),  # 16 MB at a time, whatever the size
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=seed,
    ).confidence_interval
    return mean, float(interval.low), float(interval.high)

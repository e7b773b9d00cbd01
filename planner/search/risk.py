"""The risk of a plan: what was asked for, what the planner predicted, what paths show.

    at nodes     P( constraint(t_k, x_k) > 0 in any row at any node k = 1..N−1 ) of the discretised
                 chain, with steps of the plan's own integrator: the paper's definition
    on the path  P( constraint(t, x_t) > 0 in any row at any t in [0, T] ) of the SDE itself, the
                 controls held between nodes

`predicted` is Boole's bound on Gaussian marginals, `verified` a Monte-Carlo rate; between them
the *price of risk* ν, the cost per unit of probability that the planner minimises with, is
searched for (:mod:`slipcar.planner.search.price_search`).
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import statistics
from typing import Any

#: Coverage of every interval in this package.
CONFIDENCE = 0.95


#: What a promise may be about, and how it is called.
_WHERE = {"nodes": "at nodes", "path": "on the path"}
PROMISES = tuple(_WHERE)


@dataclasses.dataclass(frozen=True)
class PricedRate:
    """One price tried on the way."""

    price: float  #: ν, cost per unit of probability, ≥ 0
    #: Σ Φ(h/s) of the plan at that price, at most 1; None if the planner found none
    predicted: float | None
    #: share of the paths used for the search that violate; None if there was no plan
    rate: float | None


@dataclasses.dataclass(frozen=True)
class Risk:
    """Three answers to how often a path of the plan breaks a constraint."""

    requested: float  #: δ, the probability not to be exceeded
    #: Σ_{k,i} Φ(h_{k,i} / s_{k,i}), at most 1: h the constraint at the mean, s its standard
    #: deviation to first order, Φ the normal distribution function. Boole's bound, so for exactly
    #: Gaussian states at least the true probability.
    predicted: float
    verified: float  #: rate over `episodes` paths that the search for the price never saw
    interval: tuple[float, float]  #: Wilson 95 % interval of `verified`
    episodes: int  #: how many fresh paths
    price: float  #: ν of the plan, cost per unit of probability
    reached: bool  #: whether a price was found that keeps δ; if not, the plan is that of least risk
    tried: tuple[PricedRate, ...]  #: the prices tried, in order
    simulation_time: float  #: seconds spent on Monte Carlo, search and verification together
    #: what is promised and verified: `"nodes"` of the plan's own chain, or the `"path"` of the SDE
    at: str = "nodes"
    substeps: int = 1  #: of each interval, in verification
    #: rate at nodes over the same paths, of the SDE where the promise is about the path
    verified_at_nodes: float | None = None

    def __str__(self) -> str:
        low, high = self.interval
        return (
            f"risk {_WHERE[self.at]} {self.verified:.3%} [{low:.3%}, {high:.3%}] on "
            f"{self.episodes:,} fresh paths; "
            f"requested {self.requested:.3%}{'' if self.reached else ' (not reached)'}, "
            f"predicted {self.predicted:.3%}, price {self.price:.4g}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON; :meth:`from_dict` gives back an equal object."""
        return {**dataclasses.asdict(self), "reached": bool(self.reached)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Risk:
        """The object that :meth:`as_dict` described.

        Raises:
            ValueError: for missing or unknown entries.
        """
        try:
            low, high = data["interval"]
            tried = tuple(PricedRate(**row) for row in data["tried"])
            return cls(**{**data, "interval": (low, high), "tried": tried})
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"not the data of a Risk: {error!r}") from error


def check_risk(delta: Any) -> None:
    """Raise ValueError unless δ is a number in (0, 1)."""
    # Booleans are numbers to Python, but 0 or 1, which are no risks; NaN is in no interval.
    if not (isinstance(delta, numbers.Real) and 0.0 < float(delta) < 1.0):
        raise ValueError(f"risk must be a probability in (0, 1), e.g. 0.01 for 1 %, not {delta!r}")


def wilson_interval(
    successes: float, trials: int, level: float = CONFIDENCE
) -> tuple[float, float]:
    """Wilson score interval of a proportion: the p with |k/n − p| ≤ z √(p (1 − p) / n).

    Unlike the normal interval it stays in [0, 1] and says something when nothing was observed.

    Args:
        successes: k, 0 ≤ k ≤ n (a sum of probabilities need not be whole).
        trials: n ≥ 1.
        level: coverage, in (0, 1); z is the normal quantile of (1 + level) / 2.

    Raises:
        ValueError: for numbers out of range.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"needs 0 <= successes <= trials and trials >= 1: {successes}, {trials}")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be in (0, 1), not {level!r}")
    k, n = float(successes), float(trials)
    z = statistics.NormalDist().inv_cdf(0.5 + 0.5 * level)
    middle = (k + 0.5 * z * z) / (n + z * z)
    half = z * math.sqrt(k * (n - k) / n + 0.25 * z * z) / (n + z * z)
    # Exact where the formula is a difference of equal numbers.
    low = 0.0 if successes == 0 else max(0.0, middle - half)
    high = 1.0 if successes == trials else min(1.0, middle + half)
    return low, high

"""What a row c(x) costs when x is Gaussian: c̄ its expectation, s its standard deviation.

Two kinds, and the certain case:

* a penalty max(0, c)² costs its expectation, (c̄² + s²) Φ(c̄/s) + c̄ s φ(c̄/s) for linear c;
* a constraint c ≤ 0 costs the probability that it is violated, Φ(c̄/s). Summed over nodes and
  rows this is Boole's bound of the probability of any violation; minimised together with the
  rest, it allocates the risk. Beyond c̄ = −s, where Φ is about to lose its convexity, it goes on
  as a parabola: that is where nobody plans to be;
* where s = 0 the penalty is the hinge max(0, c)² itself.

Φ and φ are the normal distribution function and density. The functions take numbers or expressions
(:mod:`slipcar.planner.trace.elementwise`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from slipcar.planner.trace.elementwise import choose, erfc, larger, positive_part

Array = np.ndarray

DENSITY = 1.0 / math.sqrt(2.0 * math.pi)
#: Where the tail goes on as a parabola, in standard deviations, and Φ and φ there.
EDGE = -1.0
EDGE_VALUE = 0.15865525393145707
EDGE_DENSITY = DENSITY * math.exp(-0.5)
#: Standard deviations are taken to be at least this part of the row's largest.
FLOOR = 0.02
#: And at least this, so that a row that is certain everywhere has derivatives.
LEAST = 1e-9


class Loss(NamedTuple):
    """Loss of each row and its derivatives, arrays of one shape.

    Attributes:
        value: ℓ(c̄, s).
        slope: ∂ℓ/∂c̄.
        curvature: ∂²ℓ/∂c̄² ≥ 0.
        by_variance: ∂ℓ/∂(s²) ≥ 0.
    """

    value: Any
    slope: Any
    curvature: Any
    by_variance: Any

    def scaled(self, weight: Any) -> Loss:
        """Each row times its weight."""
        return Loss(*(weight * part for part in self))


def hinge_loss(c: Any) -> Loss:
    """max(0, c)² of certain rows."""
    push = positive_part(c)
    on = choose(c, 1.0, 0.0)
    return Loss(push * push, 2.0 * push, 2.0 * on, on)


def penalty_loss(c: Any, s: Any) -> Loss:
    """E max(0, c)² of Gaussian rows, s > 0."""
    t = c / s
    density, below = DENSITY * np.exp(-0.5 * (t * t)), 0.5 * erfc(-math.sqrt(0.5) * t)
    value = (c * c + s * s) * below + c * s * density
    return Loss(value, 2.0 * (c * below + s * density), 2.0 * below, below)


def tail_loss(c: Any, s: Any) -> Loss:
    """P(c > 0) of Gaussian rows, s > 0; beyond c̄ = −s a parabola."""
    t = c / s
    over = t - EDGE
    density, below = DENSITY * np.exp(-0.5 * (t * t)), 0.5 * erfc(-math.sqrt(0.5) * t)
    value = choose(over, EDGE_VALUE + EDGE_DENSITY * over * (1.0 + 0.5 * over), below)
    slope = choose(over, EDGE_DENSITY * (1.0 + over), density)
    curvature = choose(over, EDGE_DENSITY + 0.0 * t, -t * density)
    square = s * s
    by_variance = positive_part(-0.5 * t * slope) / square
    return Loss(value, slope / s, curvature / square, by_variance)


def floored(s: Any, largest: Any) -> Any:
    """Standard deviations (..., p), at least a part of the row's largest along the path (p,)."""
    return larger(s, FLOOR * largest + LEAST)


def loss(c: Array, s: Array, weight: Array, tail: Array) -> Loss:
    """Losses of rows of both kinds.

    Args:
        c: (..., p).
        s: > 0, (..., p).
        weight: (..., p).
        tail: which rows are charged by their tail, (p,).
    """
    with np.errstate(under="ignore", over="ignore", invalid="ignore"):
        kinds = zip(tail_loss(c, s), penalty_loss(c, s), strict=True)
        return Loss(*(weight * np.where(tail, a, b) for a, b in kinds))


def normal_cdf(t: Array) -> Array:
    """Φ, the normal distribution function."""
    with np.errstate(under="ignore"):
        return 0.5 * np.asarray(erfc(-math.sqrt(0.5) * t))


def deviations(C: Array, S: Array) -> Array:
    """Standard deviations of rows with Jacobians C (K, p, n) under Σ (K, n, n): (K, p)."""
    variance = np.einsum("kpi,kij,kpj->kp", C, S, C, optimize=True)
    s = np.sqrt(np.maximum(variance, 0.0))
    return floored(s, s.max(axis=0, initial=0.0))

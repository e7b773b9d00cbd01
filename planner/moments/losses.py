"""What a row c(x) costs when x is Gaussian: c̄ its value at the mean, s its standard deviation.

Two kinds:

* a penalty max(0, c)² costs its expectation, (c̄² + s²) Φ(c̄/s) + c̄ s φ(c̄/s) for linear c;
* a constraint c ≤ 0 costs the probability that it is violated, Φ(c̄/s). Summed over nodes and
  rows this is Boole's bound of the probability of any violation; minimised together with the
  rest, it allocates the risk. Beyond c̄ = −s, where Φ is about to lose its convexity, it goes on
  as a parabola: that is where nobody plans to be.

Φ and φ are the normal distribution function and density.
"""

from __future__ import annotations

import dataclasses

import numpy as np

Array = np.ndarray

DENSITY = 1.0 / np.sqrt(2.0 * np.pi)
#: Where the tail goes on as a parabola, in standard deviations, and Φ and φ there.
EDGE = -1.0
EDGE_VALUE = 0.15865525393145707
EDGE_DENSITY = DENSITY * np.exp(-0.5)
#: Standard deviations are taken to be at least this part of the row's largest.
FLOOR = 0.02


@dataclasses.dataclass(frozen=True)
class Loss:
    """Loss of each row, (..., p), and its derivatives.

    Attributes:
        value: ℓ(c̄, s).
        slope: ∂ℓ/∂c̄.
        curvature: ∂²ℓ/∂c̄² ≥ 0.
        by_variance: ∂ℓ/∂(s²) ≥ 0.
    """

    value: Array
    slope: Array
    curvature: Array
    by_variance: Array


def loss(c: Array, s: Array, weight: Array, tail: Array) -> Loss:
    """Losses of rows.

    Args:
        c: (..., p).
        s: > 0, (..., p).
        weight: (..., p).
        tail: which rows are charged by their tail, (p,).
    """
    from scipy.special import ndtr

    t = c / s
    density, below = DENSITY * np.exp(-0.5 * t * t), ndtr(t)
    inner, over = t <= EDGE, t - EDGE
    value = np.where(inner, below, EDGE_VALUE + EDGE_DENSITY * over * (1.0 + 0.5 * over))
    slope = np.where(inner, density, EDGE_DENSITY * (1.0 + over))
    curvature = np.where(inner, -t * density, EDGE_DENSITY)
    return Loss(
        weight * np.where(tail, value, (c * c + s * s) * below + c * s * density),
        weight * np.where(tail, slope / s, 2.0 * (c * below + s * density)),
        weight * np.where(tail, curvature / (s * s), 2.0 * below),
        weight * np.where(tail, np.maximum(-0.5 * t * slope, 0.0) / (s * s), below),
    )


def deviations(C: Array, S: Array) -> Array:
    """Standard deviations of rows with Jacobians C (K, p, n) under Σ (K, n, n): (K, p).

    At least a part of the row's largest, so that the certainty at the start has derivatives.
    """
    variance = np.einsum("kpi,kij,kpj->kp", C, S, C, optimize=True)
    s = np.sqrt(np.maximum(variance, 0.0))
    return np.maximum(s, FLOOR * s.max(axis=0, initial=0.0) + 1e-9)

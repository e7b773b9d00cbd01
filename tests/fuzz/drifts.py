"""Closed-form drifts b(t, x, u) of order one, by name, with random coefficients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline

Array = np.ndarray
Drift = Callable[[Array, Array, Array], Array]

#: Smooth everywhere; smooth where they are finite; and what the planner may refuse or not solve.
SMOOTH = ("linear", "chain", "trigonometric", "polynomial", "timed", "rational", "stiff")
HARD = ("cubic", "exponential", "domain", "kink", "uncontrolled")
HOPELESS = ("jump", "hole", "opaque", "huge", "bent")


def drift(kind: str, n: int, m: int, rng: np.random.Generator) -> Drift:
    """A drift of n states and m controls.

    Structure depends on the kind alone, so that all of one shape run through one machine code.
    """
    A, B, c = rng.normal(size=(n, n)) / n, rng.normal(size=(n, m)), 0.3 * rng.normal(size=n)
    W, S, phase = rng.normal(size=(n, n)), 0.5 * rng.normal(size=n), rng.normal(size=n)
    omega, level = rng.uniform(0.5, 5.0), rng.uniform(1.0, 3.0)
    Q = 0.2 * rng.normal(size=(n, n, n)) / n
    spline = CubicSpline(np.linspace(-5.0, 5.0, 11), 0.3 * rng.normal(size=11))
    rates = -(10.0 ** rng.uniform(0.0, 3.0, size=n))

    def linear(t, x, u):
        return x @ A.T + u @ B.T + c

    def chain(t, x, u):
        rows = [x[..., i + m] for i in range(n - m)]
        drag = [S[j] * x[..., -1] * x[..., n - 1 - j] for j in range(min(n, m))]
        rows += [u[..., j] - drag[j] for j in range(min(n, m))]
        return np.stack(rows, axis=-1)

    def trigonometric(t, x, u):
        gain = 1.0 + 0.5 * np.cos(x[..., :1])
        return x @ A.T + S * np.sin(x @ W.T + phase) + gain * (u @ B.T)

    def polynomial(t, x, u):
        return linear(t, x, u) + np.einsum("ijk,...j,...k->...i", Q, x, x)

    def timed(t, x, u):
        return linear(t, x, u) + S * np.cos(omega * np.asarray(t)[..., None] + phase)

    def rational(t, x, u):
        return linear(t, x, u) + S * x / (0.2 + x[..., :1] ** 2)

    def stiff(t, x, u):
        return rates * x + 0.3 * (x @ A.T) + u @ B.T

    def cubic(t, x, u):
        return linear(t, x, u) + np.abs(S) * x**3

    def exponential(t, x, u):
        return linear(t, x, u) + S * np.exp(x)

    def domain(t, x, u):
        return linear(t, x, u) + S * np.sqrt(level + x) + np.log(level - x[..., :1])

    def kink(t, x, u):
        return linear(t, x, u) + S * np.abs(x) - np.maximum(x - 0.5, 0.0)

    def uncontrolled(t, x, u):
        return x @ A.T + 0.0 * (u @ B.T) + c

    def jump(t, x, u):
        return linear(t, x, u) + S * np.sign(x - 0.2) + np.floor(x)

    def hole(t, x, u):
        return np.where(np.abs(x) > 10.0 * level, np.nan, linear(t, x, u))

    def opaque(t, x, u):
        return linear(t, x, u) + spline(x[..., :1])

    def huge(t, x, u):
        return 1e3 * (x**3) * np.exp(x) + u @ B.T

    def bent(t, x, u):
        return linear(t, x, u) + 0.1 * (u @ B.T) ** 2

    return locals()[kind]

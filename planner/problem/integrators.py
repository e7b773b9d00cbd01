"""One interval of the mean, dx/dt = b(t, x, u) with u constant, and its exact derivatives.

    euler:  x⁺ = x + dt b(t, x, u)                                                 order 1
    rk4:    x⁺ = x + dt/6 (k₁ + 2 k₂ + 2 k₃ + k₄),  the classical Runge–Kutta      order 4
            k₁ = b(t, x), k₂ = b(t + dt/2, x + dt/2 k₁), k₃ = b(t + dt/2, x + dt/2 k₂),
            k₄ = b(t + dt, x + dt k₃)
    midpoint:  x⁺ = x + dt b(t + dt/2, x + dt/2 b(t, x))                           order 2

Euler is the paper's scheme (§6.1) and that of its Monte Carlo; with rk4 the mean follows the
continuous-time system; midpoint is of simulated paths, in substeps. The noise of
an interval is dt σσᵀ at its beginning either way.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Array = np.ndarray
Drift = Callable[[Array, Array, Array], Array]
DriftJacobian = Callable[[Array, Array, Array], tuple[Array, Array]]

#: Integrators of a plan by name.
INTEGRATORS = ("euler", "rk4")


def change(integrator: str, drift: Drift, t: Array, dt: Array, x: Array, u: Array) -> Array:
    """x⁺ − x over an interval, (..., n).

    Args:
        integrator: one of :data:`INTEGRATORS`, or "midpoint".
        drift: b(t, x, u), batched over leading axes.
        t: beginnings, (...,) [s].
        dt: lengths, (...,) [s].
        x: states there, (..., n).
        u: controls, (..., m).
    """
    h = np.asarray(dt)[..., None]
    k1 = drift(t, x, u)
    if integrator == "euler":
        return h * k1
    middle = t + 0.5 * dt
    k2 = drift(middle, x + 0.5 * h * k1, u)
    if integrator == "midpoint":
        return h * k2
    k3 = drift(middle, x + 0.5 * h * k2, u)
    k4 = drift(t + dt, x + h * k3, u)
    return h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def jacobian(
    integrator: str,
    drift: Drift,
    drift_jacobian: DriftJacobian,
    t: Array,
    dt: Array,
    x: Array,
    u: Array,
) -> tuple[Array, Array]:
    """∂x⁺/∂x (..., n, n) and ∂x⁺/∂u (..., n, m); arguments as for :func:`change`."""
    h = np.asarray(dt)[..., None, None]
    eye = np.eye(x.shape[-1])
    A1, B1 = drift_jacobian(t, x, u)
    if integrator == "euler":
        return eye + h * A1, h * B1
    # Each stage depends on x and u directly and through the one before it.
    middle, half, g = t + 0.5 * dt, 0.5 * h, h[..., 0]
    k1 = drift(t, x, u)
    x2 = x + 0.5 * g * k1
    k2 = drift(middle, x2, u)
    x3 = x + 0.5 * g * k2
    k3 = drift(middle, x3, u)
    A, B = drift_jacobian(middle, x2, u)
    A2, B2 = A @ (eye + half * A1), B + A @ (half * B1)
    A, B = drift_jacobian(middle, x3, u)
    A3, B3 = A @ (eye + half * A2), B + A @ (half * B2)
    A, B = drift_jacobian(t + dt, x + g * k3, u)
    A4, B4 = A @ (eye + h * A3), B + A @ (h * B3)
    sixth = h / 6.0
    return (
        eye + sixth * (A1 + 2.0 * A2 + 2.0 * A3 + A4),
        sixth * (B1 + 2.0 * B2 + 2.0 * B3 + B4),
    )

"""The admissible controls U: a box, a ball about zero, or what both have in common.

U = { u : lower ≤ u ≤ upper,  ‖u‖₂ ≤ radius }
"""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray


def control_limits(given: Any, m: int) -> tuple[Array, Array]:
    """Lower and upper bounds, each (m,), from what `Problem.control_bounds` may be.

    Raises:
        ValueError: for another shape, NaN, or lower ≥ upper.
    """
    if given is None:
        return np.full(m, -np.inf), np.full(m, np.inf)
    try:
        bounds = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        bounds = np.full(0, np.nan)
    if bounds.shape == (m,):
        bounds = np.stack([-bounds, bounds])
    if bounds.shape != (2, m) or np.isnan(bounds).any() or not (bounds[0] < bounds[1]).all():
        raise ValueError(
            f"control_bounds must be None, ({m},) positive bounds on |u|, or (2, {m}) lower < "
            f"upper, not {given!r}"
        )
    return bounds[0], bounds[1]


def control_ball(given: Any, lower: Array, upper: Array) -> float:
    """Radius of the ball, inf where there is none, from what `Problem.control_radius` may be.

    Raises:
        ValueError: unless it is None or a number > 0; or if ball and box have no inner point
            in common.
    """
    if given is None:
        return float("inf")
    try:
        radius = float(given)
    except (TypeError, ValueError, OverflowError):
        radius = float("nan")
    if not radius > 0.0:
        raise ValueError(f"control_radius must be None or a number > 0, not {given!r}")
    nearest = float(np.linalg.norm(np.clip(0.0, lower, upper)))
    if nearest >= radius:
        raise ValueError(
            f"control_radius {radius:g} leaves no controls: the smallest within control_bounds "
            f"has norm {nearest:g}"
        )
    return radius


def project_controls(u: Array, lower: Array, upper: Array, radius: float = np.inf) -> Array:
    """The nearest admissible controls, (..., m).

    With the multiplier ν ≥ 0 of the ball the nearest point is clip(u / (1 + ν)), whose norm
    falls as ν grows: a bisection on 1 / (1 + ν) finds where it meets the radius.
    """
    inside = np.minimum(np.maximum(u, lower), upper)
    if radius == np.inf:
        return inside
    outside = np.linalg.norm(inside, axis=-1) > radius
    if not outside.any():
        return inside
    far = np.asarray(u)[outside]
    lower, upper = (np.broadcast_to(limit, u.shape)[outside] for limit in (lower, upper))
    low, high = np.zeros(len(far)), np.ones(len(far))
    for _ in range(60):
        middle = 0.5 * (low + high)
        long = np.linalg.norm(np.clip(middle[:, None] * far, lower, upper), axis=-1) > radius
        low, high = np.where(long, low, middle), np.where(long, middle, high)
    inside[outside] = np.clip(low[:, None] * far, lower, upper)
    return inside

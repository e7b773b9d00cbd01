"""Balls of controls ‖u_k‖ ≤ r in Newton's method: tangents, curvature, multipliers.

On the sphere, with direction t = u/‖u‖ and multiplier μ ≥ 0 of the last Newton point, the
constraint's terms in the next LQ problem are

    μ (tᵀu − r) + ½ κ (tᵀu − r)² + ½ (μ/r) uᵀ(I − t tᵀ)u

the tangent plane with the augmented Lagrangian's stiffness κ, and the sphere's curvature: Newton's
method on the optimality conditions, quadratic in the direction. The new multiplier is
μ + κ (tᵀu − r). (A plain penalty would need a stiffness that drowns the cost along the tangent
in rounding errors; with multipliers 10⁵ times that cost is enough.)
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.convex.solvers.lq_problem import Ray
from slipcar.planner.convex.subproblem import Subproblem

Array = np.ndarray

#: κ per unit of the control weight; and how far directions may still turn, and controls pass
#: the sphere (relative), when Newton's method has settled.
_STIFFNESS, _SETTLED = 1e5, 1e-9


@dataclasses.dataclass(frozen=True)
class Spheres:
    """At which intervals the control is held on the sphere.

    Attributes:
        on: (K,) bool.
        turn: unit vectors t, (K, m); zero where off.
        press: multipliers μ ≥ 0, (K,); zero where off.
        slack: how much μ may change once the pieces have settled.
    """

    on: Array
    turn: Array
    press: Array
    slack: float

    def same_as(self, other: Spheres) -> bool:
        """Whether Newton's method has settled between the two."""
        return (
            bool((self.on == other.on).all())
            and float(np.max(np.abs(self.turn - other.turn), initial=0.0)) <= _SETTLED
            and float(np.max(np.abs(self.press - other.press), initial=0.0)) <= self.slack
        )


def stiffness(sub: Subproblem) -> float:
    """κ of a sub-problem."""
    return _STIFFNESS * float(sub.R.diagonal(axis1=1, axis2=2).max())


def spheres(sub: Subproblem, on: Array, u: Array, press: Array) -> Spheres:
    """Spheres held where `on`, touched in the direction of u (K, m)."""
    size = np.linalg.norm(u, axis=1)
    turn = np.where(on[:, None], u / np.where(on, size, 1.0)[:, None], 0.0)
    slack = _SETTLED * stiffness(sub) * sub.radius
    return Spheres(on, turn, np.where(on, press, 0.0), slack)


def start(sub: Subproblem, before: Spheres | None) -> Spheres:
    """Those of the last solution where the iterate is near them."""
    u = -sub.center
    if before is None:
        none = np.zeros(len(u))
        return spheres(sub, none > 0.0, u, none)
    near = np.linalg.norm(u, axis=1) > 0.5 * sub.radius
    return spheres(sub, before.on & near, u, before.press)


def terms(sub: Subproblem, touched: Spheres) -> tuple[Array, Array, Ray]:
    """What they add to R, (K, m, m), and to r, (K, m); and the stiff ray."""
    t, press = touched.turn, touched.press
    across = np.where(touched.on[:, None, None], np.eye(t.shape[1]), 0.0)
    across -= t[:, :, None] * t[:, None, :]
    block = (press / sub.radius)[:, None, None] * across
    push = press[:, None] * t - np.matmul(block, sub.center[..., None])[..., 0]
    reach = sub.radius + np.sum(t * sub.center, axis=1)
    return block, push, Ray(t, stiffness(sub) * touched.on, reach)


def at(sub: Subproblem, e: Array, before: Spheres) -> Spheres:
    """Those that control deviations e (K, m), found with `before`, lie on or pass."""
    u = e - sub.center
    pressed = before.press + stiffness(sub) * (np.sum(before.turn * u, axis=1) - sub.radius)
    size = np.linalg.norm(u, axis=1)
    # A first guess of the multiplier: the projection's, were the controls all there is.
    weight = np.einsum("ki,kij,kj->k", u, sub.R, u) / np.maximum(size, 1e-300) ** 2
    on = np.where(before.on, pressed > 0.0, size > sub.radius)
    return spheres(sub, on, u, np.where(before.on, pressed, weight * (size - sub.radius)))


def near(sub: Subproblem, e: Array, press: Array) -> Spheres:
    """Those that hold an interior point's solution with multipliers `press`, (K,)."""
    u = e - sub.center
    scale = max(1.0, float(np.max(press, initial=0.0)))
    on = 1.0 - np.linalg.norm(u, axis=1) / sub.radius < press / scale
    return spheres(sub, on, u, press)

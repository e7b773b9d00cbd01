"""What a path costs and when it collides: the only definition (SPEC §2).

    effort   = Σ_{k=0}^{N-2} dt ‖u_k‖²
    obstacle = Σ_{k=1}^{N-1} dt λ Σ_o max(0, c_o(r_k))²,   c_o(r) = (δ_o + ε)² − ‖r − r_o‖²
    goal     = (x_N − x^f)ᵀ W (x_N − x^f)
    collision: ‖r_k − r_o‖ < δ_o at any node k = 1..N−1

The functions below are the summands, batched over leading axes, for NumPy and Torch.
Obstacles are rows (x, y, radius) [m].
"""

from __future__ import annotations

from typing import Any

from slipcar.envs.arrays import array_namespace


def control_power(u: Any) -> Any:
    """G(u) = ‖u‖², (..., m) -> (...,): the effort per second."""
    xp = array_namespace(u)
    return xp.sum(u * u, axis=-1)


def squared_distances(x: Any, obstacles: Any) -> Any:
    """‖r − r_o‖² to every obstacle centre, (..., 5) and (k, 3) -> (..., k) [m²]."""
    dx = x[..., 0, None] - obstacles[..., 0]
    dy = x[..., 1, None] - obstacles[..., 1]
    return dx * dx + dy * dy


def obstacle_constraints(x: Any, obstacles: Any, clearance: Any) -> Any:
    """c_o(r) = (δ_o + ε)² − ‖r − r_o‖², positive inside the clearance ring, (..., k) [m²]."""
    reach = obstacles[..., 2] + clearance
    return reach * reach - squared_distances(x, obstacles)


def obstacle_constraints_jacobian(x: Any, obstacles: Any) -> Any:
    """∂c_o/∂x, (..., k, n) for states (..., n)."""
    xp = array_namespace(x)
    jacobian = xp.zeros((*x.shape[:-1], obstacles.shape[-2], x.shape[-1]), dtype=x.dtype)
    jacobian[..., 0] = -2.0 * (x[..., 0, None] - obstacles[..., 0])
    jacobian[..., 1] = -2.0 * (x[..., 1, None] - obstacles[..., 1])
    return jacobian


def hinge_squared(c: Any) -> Any:
    """φ summed over obstacles: Σ_o max(0, c_o)², (..., k) -> (...,)."""
    xp = array_namespace(c)
    positive = xp.where(c > 0, c, 0.0 * c)
    return xp.sum(positive * positive, axis=-1)


def obstacle_power(x: Any, obstacles: Any, clearance: Any, weight: Any) -> Any:
    """L(x) = λ Σ_o max(0, c_o)²: the obstacle cost per second, (..., 5) -> (...,)."""
    return weight * hinge_squared(obstacle_constraints(x, obstacles, clearance))


def goal_cost(x: Any, goal: Any, weight: Any) -> Any:
    """(x − x^f)ᵀ diag(W) (x − x^f), (..., 5) -> (...,); `weight` is (5,)."""
    xp = array_namespace(x)
    error = x - goal
    return xp.sum(weight * error * error, axis=-1)


def obstacle_distances(x: Any, obstacles: Any) -> Any:
    """‖r − r_o‖ − δ_o to every obstacle [m], (..., 5) and (k, 3) -> (..., k)."""
    xp = array_namespace(x)
    return xp.sqrt(squared_distances(x, obstacles)) - obstacles[..., 2]


def signed_distance(x: Any, obstacles: Any) -> Any:
    """Smallest ‖r − r_o‖ − δ_o over the obstacles [m], (..., 5) -> (...,).

    Negative means collision (the bare radius, no clearance). Without obstacles: +inf.
    """
    xp = array_namespace(x)
    if obstacles.shape[-2] == 0:
        return xp.full(x.shape[:-1], float("inf"), dtype=x.dtype)
    return xp.min(obstacle_distances(x, obstacles), axis=-1)

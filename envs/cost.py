"""What a path costs and when it collides: the only definition (docs/method.md).

    effort   = Σ_{k=0}^{N-2} dt ‖u_k‖²
    obstacle = Σ_{k=1}^{N-1} dt λ Σ_o max(0, c_o(r_k))²,   c_o(r) = (δ_o + ε)² − ‖r − r_o‖²
    goal     = (x_N − x^f)ᵀ W (x_N − x^f)
    collision: ‖r_k − r_o‖ < δ_o at any node k = 1..N−1

`squared_norm`, `ring_depth`, `rim_distance`, `hinge_cost` and `weighted_square` are these formulas,
on components (:mod:`slipcar.envs.arrays`). The other functions put them into arrays, batched over
leading axes, for NumPy and Torch. Obstacles are rows (x, y, radius) [m].
"""

from __future__ import annotations

from typing import Any

from slipcar.envs.arrays import array_namespace, functions_of


def ring_depth(squared: Any, squared_reach: Any) -> Any:
    """c_o at squared distance ‖r − r_o‖² [m²], given (δ_o + ε)² [m²]: [m²]."""
    return squared_reach - squared


def rim_distance(squared: Any, radius: Any, sqrt: Any) -> Any:
    """‖r − r_o‖ − δ_o at squared distance ‖r − r_o‖² [m²], negative inside: [m]."""
    return sqrt(squared) - radius


def hinge_cost(c: Any, positive: Any) -> Any:
    """max(0, c)², given the function max(0, ·)."""
    depth = positive(c)
    return depth * depth


def weighted_square(errors: Any, weights: Any) -> Any:
    """Σ W_i e_i² over components."""
    total = weights[0] * errors[0] * errors[0]
    for weight, error in zip(weights[1:], errors[1:], strict=True):
        total = total + weight * error * error
    return total


def squared_norm(u: Any) -> Any:
    """‖u‖² of components."""
    total = u[0] * u[0]
    for component in u[1:]:
        total = total + component * component
    return total


def arrived(x: Any, goal: Any, tolerance: Any) -> Any:
    """Whether |x_i − x^f_i| ≤ tolerance_i for all components."""
    within: Any = True
    for state, target, most in zip(x, goal, tolerance, strict=True):
        within = within & (abs(state - target) <= most)
    return within


def control_power(u: Any) -> Any:
    """G(u) = ‖u‖², (..., m) -> (...,): the effort per second."""
    return squared_norm([u[..., i] for i in range(u.shape[-1])])


def squared_distances(x: Any, obstacles: Any) -> Any:
    """‖r − r_o‖² to every obstacle centre, (..., 5) and (k, 3) -> (..., k) [m²]."""
    dx = x[..., 0, None] - obstacles[..., 0]
    dy = x[..., 1, None] - obstacles[..., 1]
    return dx * dx + dy * dy


def obstacle_constraints(x: Any, obstacles: Any, clearance: Any) -> Any:
    """c_o(r) = (δ_o + ε)² − ‖r − r_o‖², positive inside the clearance ring, (..., k) [m²]."""
    reach = obstacles[..., 2] + clearance
    return ring_depth(squared_distances(x, obstacles), reach * reach)


def obstacle_constraints_jacobian(x: Any, obstacles: Any) -> Any:
    """∂c_o/∂x, (..., k, n) for states (..., n)."""
    xp = array_namespace(x)
    jacobian = xp.zeros((*x.shape[:-1], obstacles.shape[-2], x.shape[-1]), dtype=x.dtype)
    jacobian[..., 0] = -2.0 * (x[..., 0, None] - obstacles[..., 0])
    jacobian[..., 1] = -2.0 * (x[..., 1, None] - obstacles[..., 1])
    return jacobian


def hinge_squared(c: Any) -> Any:
    """φ summed over obstacles: Σ_o max(0, c_o)², (..., k) -> (...,)."""
    return array_namespace(c).sum(hinge_cost(c, functions_of(c).positive), axis=-1)


def obstacle_power(x: Any, obstacles: Any, clearance: Any, weight: Any) -> Any:
    """L(x) = λ Σ_o max(0, c_o)²: the obstacle cost per second, (..., 5) -> (...,)."""
    return weight * hinge_squared(obstacle_constraints(x, obstacles, clearance))


def goal_cost(x: Any, goal: Any, weight: Any) -> Any:
    """(x − x^f)ᵀ diag(W) (x − x^f), (..., 5) -> (...,); `weight` is (5,)."""
    error = x - goal
    components = range(error.shape[-1])
    return weighted_square(
        [error[..., i] for i in components], [weight[..., i] for i in components]
    )


def obstacle_distances(x: Any, obstacles: Any) -> Any:
    """‖r − r_o‖ − δ_o to every obstacle [m], (..., 5) and (k, 3) -> (..., k)."""
    sqrt = array_namespace(x).sqrt
    return rim_distance(squared_distances(x, obstacles), obstacles[..., 2], sqrt)


def signed_distance(x: Any, obstacles: Any) -> Any:
    """Smallest ‖r − r_o‖ − δ_o over the obstacles [m], (..., 5) -> (...,).

    Negative means collision (the bare radius, no clearance). Without obstacles: +inf.
    """
    xp = array_namespace(x)
    if obstacles.shape[-2] == 0:
        return xp.full(x.shape[:-1], float("inf"), dtype=x.dtype)
    return xp.min(obstacle_distances(x, obstacles), axis=-1)

"""The discrete maximum principle: what makes a trajectory an extremal (paper §2.2).

With ℓ_k the costs charged at node k (hinges, state costs, the variance penalty through σ(x_k)),
F_k(x, u) the step from node k to k + 1 and p⁰ = −1, a trajectory x_0..x_K, u_0..u_{K−1} is an
extremal with multiplier 𝔭 if

    x_{k+1} = F_k(x_k, u_k),   g(x_K) = 0                                     dynamics, terminal
    p_k = (∂F_k/∂x)ᵀ p_{k+1} + p⁰ ∇ℓ_k,   p_K = (∂g/∂x)ᵀ 𝔭 + p⁰ ∇ℓ_K         adjoint equation
    u_k = argmax_{v ∈ U} H_k(v),   H_k(v) = p_{k+1}ᵀ b(t_k, x_k, v) + p⁰ vᵀRv   maximality

Which variance is meant: w ∫ tr Σ dt = w Σ dt tr(Λ_{k+1} σ_k σ_kᵀ), and the adjoint equation
holds Λ (so ∂A/∂x is not differentiated), as every sub-problem does. This is the maximum principle
that accumulation points of the iteration satisfy; what is left out, the gradient
∂/∂A_k = 2 w Λ_{k+1} A_k Σ_k through A, is small.

All gradients are those of a sub-problem at zero deviation: costs are defined in one place.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.planner.convex.subproblem import Subproblem, convexify, variance_of
from slipcar.planner.moments import covariance as moments
from slipcar.planner.moments.propagation import gain, weight_step
from slipcar.planner.problem.feasibility import (
    LEAST_MOVE,
    TINY,
    control_size,
    end_sizes,
    states_moved,
)
from slipcar.planner.problem.linearization import Linearization, linearize
from slipcar.planner.problem.model import Model, model_of

Array = np.ndarray


def model_for(plan: Any) -> Model:
    """The completed problem of a :class:`slipcar.planner.Plan`, with its integrator.

    Raises:
        ValueError: if the plan does not know its problem.
    """
    if plan.problem is None:
        raise ValueError(
            "this plan does not know its problem (it was loaded from a file that could not keep "
            "it), and this needs its dynamics: plan.replace(problem=...) first"
        )
    model = model_of(plan.problem)
    return dataclasses.replace(model, integrator=plan.options.get("integrator", model.integrator))


@dataclasses.dataclass(frozen=True)
class FirstOrder:
    """First derivatives along a trajectory: those of costs are the sub-problem's."""

    lin: Linearization
    weights: Array | None  # Λ_1..Λ_K of the variance penalty, (K, n, n); None for w = 0
    sub: Subproblem  # without a trust region

    @property
    def push(self) -> Array:
        """Slope of the hinges' φ, h max(0, c), (K, p)."""
        return self.sub.h * np.maximum(self.sub.b, 0.0)

    @property
    def state_gradient(self) -> Array:
        """∇ℓ at nodes 1..K, (K, n)."""
        return self.sub.q + np.matmul(self.push[:, None], self.sub.a)[:, 0]


def first_order(
    model: Model, x: Array, u: Array, variance_weight: float, weights: Array | None = None
) -> FirstOrder:
    """Linearise along x (N, n), u (K, m); Λ is that of this trajectory unless `weights` hold it."""
    lin = linearize(model, x, u)
    if variance_weight > 0.0 and weights is None:
        weights = moments.adjoint_weights(lin.A, model.dt)
    variance = variance_of(model, lin, variance_weight, weights)
    return FirstOrder(lin, weights, convexify(model, lin, variance=variance))


def adjoint_of(model: Model, at: FirstOrder, terminal: Array, *, answered: bool = False) -> Array:
    """λ_1..λ_K by the adjoint recursion from ν = −𝔭 (q,): (K, n), gradients of the cost to go.

        λ_k = ∇ℓ_k + A_kᵀ λ_{k+1} + K_kᵀ γ_k,    γ_k = ∂H_k/∂u

    If `answered`, with a feedback K of the controls that are within their bounds. At an extremal,
    where their γ vanishes, that is the recursion without K, and it is bounded where that one is
    not, for unstable systems.
    """
    A, B, sub, u = at.lin.A, at.lin.B, at.sub, at.lin.u
    inside = (u > model.lower) & (u < model.upper)
    if model.radius < np.inf:
        inside &= (np.linalg.norm(u, axis=1) < (1.0 - 1e-9) * model.radius)[:, None]
    gains = _gains(at, model.dt) if answered else np.zeros((len(A), *B.shape[:0:-1]))
    adjoint = at.state_gradient
    adjoint[-1] += at.lin.G.T @ terminal
    for k in range(len(A) - 1, 0, -1):
        slope = sub.r[k] + B[k].T.dot(adjoint[k])
        adjoint[k - 1] += A[k].T.dot(adjoint[k]) + gains[k].T.dot(inside[k] * slope)
    return adjoint


def _gains(at: FirstOrder, dt: Array) -> Array:
    """Feedback that holds the states where they are, in their own sizes (Bryson's rule)."""
    A, B, R = at.lin.A, at.lin.B, at.sub.R
    weight = float(np.einsum("ki,kij,kj->", at.lin.u, R, at.lin.u)) / float(dt.sum()) + TINY
    D = np.diag(weight / np.square(states_moved(at.lin)))
    P, gains = D * dt[-1], np.empty((*B.shape[:1], *B.shape[:0:-1]))
    for k in range(len(A) - 1, -1, -1):
        gains[k] = gain(A[k], B[k], P, R[k])
        P = D * dt[k] + weight_step(A[k], B[k], P, gains[k], R[k], None, dt[k])
    return gains


def best_step(model: Model, at: FirstOrder, adjoint: Array) -> tuple[Array, Array]:
    """From u to argmax_U H for λ_1..λ_K (K, n), and what that gains in H: (K, m) and (K,).

    H is quadratic in u for dynamics affine in it; otherwise this is its quadratic model at u,
    whose argmax is u itself exactly when u is stationary for H.
    """
    slope = at.sub.slope(adjoint)
    e = minimize_over_controls(model, at.sub.R, slope, at.lin.u)
    bent = np.matmul(at.sub.R, e[..., None])[..., 0]
    return e, -np.einsum("ki,ki->k", e, slope + 0.5 * bent) / model.dt


def minimize_over_controls(model: Model, R: Array, r: Array, u: Array) -> Array:
    """The e (K, m) of least ½ eᵀRe + rᵀe over u + e ∈ U, for every row; R (K, m, m), r, u (K, m).

    A part θ of ½ ‖u + e‖² in the cost, 1 − θ of the rest, pulls into the ball: bisection on θ.
    """
    lower, upper = model.lower - u, model.upper - u
    e = _minimize_over_box(R, r, lower, upper)
    out = np.linalg.norm(u + e, axis=1) > model.radius
    if not out.any():
        return e
    R, r, u, lower, upper = R[out], r[out], u[out], lower[out], upper[out]
    scale, eye = np.einsum("kii->k", R), np.eye(u.shape[1])

    def pulled(theta: Array) -> Array:
        kept, pull = 1.0 - theta, theta * scale
        bent = kept[:, None, None] * R + pull[:, None, None] * eye
        return _minimize_over_box(bent, kept[:, None] * r + pull[:, None] * u, lower, upper)

    low, high = np.zeros(len(u)), np.ones(len(u))
    for _ in range(60):
        middle = 0.5 * (low + high)
        long = np.linalg.norm(u + pulled(middle), axis=1) > model.radius
        low, high = np.where(long, middle, low), np.where(long, high, middle)
    e[out] = pulled(high)
    return e


def _minimize_over_box(R: Array, r: Array, lower: Array, upper: Array) -> Array:
    """The same over lower ≤ e ≤ upper: coordinate by coordinate; a diagonal R takes one pass."""
    diagonal = np.einsum("kii->ki", R)
    coupled = bool((R - diagonal[..., None] * np.eye(R.shape[1])).any())
    e = np.clip(-r / diagonal, lower, upper)
    for _ in range(1000 if coupled else 0):
        before = e.copy()
        for i in range(e.shape[1]):
            slope = np.einsum("kj,kj->k", R[:, i], e) + r[:, i]
            e[:, i] = np.clip(e[:, i] - slope / diagonal[:, i], lower[:, i], upper[:, i])
        if np.max(np.abs(e - before)) <= 1e-15 * (1.0 + np.max(np.abs(e))):
            break
    return e


@dataclasses.dataclass(frozen=True)
class Scales:
    """What counts as one in each residual, in the problem's own units."""

    state: Array  # (n,), how far each state moves
    end: Array  # (q,), how far each terminal condition moves with them
    control: Array  # (m,), the controls' size, shared out by their weights
    adjoint: Array  # (n,), largest |λ| of each; at least a part of what the cost amounts to


def scales(model: Model, at: FirstOrder, adjoint: Array) -> Scales:
    """Natural scales at a trajectory and its adjoint λ (K, n)."""
    lin, weight = at.lin, np.diagonal(model.R)
    state = states_moved(lin)
    # From where the control's own cost is least; at least what moves a state a little.
    own = lin.u + (at.sub.r - 2.0 * model.dt[:, None] * (lin.u @ model.R)) / (
        2.0 * model.dt[:, None] * weight
    )
    rate = np.max(np.abs(lin.B).sum(axis=0) / state[:, None], axis=0)
    least = np.divide(LEAST_MOVE, rate, out=np.zeros_like(rate), where=rate > 0.0)
    most = float(control_size(own, lin.u, weight).max())
    size = np.sqrt(max(most, float(weight @ (least * least))) + TINY)
    costate = np.abs(adjoint).max(axis=0)
    answer = LEAST_MOVE * size * size * float(model.dt.sum()) / state
    end = np.asarray(end_sizes(lin.G, state))
    return Scales(state, end, size / np.sqrt(weight), np.maximum(costate, answer))


def time_slope(model: Model, at: FirstOrder, adjoint: Array, variance_weight: float) -> float:
    """∂/∂T of the Lagrangian, −max_U H(T) of the paper's transversality condition (Theorem 5.1).

    The time grid is stretched about its beginning, x, u and λ_1..λ_K (K, n) being held: by the
    envelope theorem this is how the optimal cost changes with the horizon. (A and Λ of the
    variance follow the grid: only their change with x is left out, as everywhere.)
    """
    begin, horizon = model.times[0], model.times[-1] - model.times[0]
    step = 1e-5

    def lagrangian(stretch: float) -> float:
        stretched = dataclasses.replace(
            model, times=begin + stretch * (model.times - begin), dt=stretch * model.dt
        )
        lin = linearize(stretched, at.lin.x, at.lin.u)
        value = lin.effort + lin.penalty + lin.running + float(np.vdot(adjoint, lin.defect))
        if variance_weight > 0.0:
            S = moments.covariance_of(stretched, lin)
            value += variance_weight * moments.trace_integral(S, stretched.dt)
        return value

    return (lagrangian(1.0 + step) - lagrangian(1.0 - step)) / (2.0 * step * horizon)

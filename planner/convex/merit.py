"""What steps are judged by, from the multipliers λ, ν of the sub-problem at hand.

The merit function that steps are judged by is

    Φ = effort + penalty + running cost + w ∫ tr Σ dt + Σ λᵀf + ½ max|λ| ‖f‖₁ + νᵀg + ½ max|ν| ‖g‖₁

with f the defects of the non-linear dynamics, g the terminal residual (beyond its tolerance) and
λ, ν their multipliers from the sub-problem. Pricing them by multipliers, with their signs, is
what keeps good steps from being rejected near the solution (Maratos): the defect that a step
leaves is of second order, and so is its gain. While something is lacking (ν at its limit ρ) the
last two terms are ρ ‖g‖₁.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.convex.convexify import Subproblem
from slipcar.planner.convex.solvers import Solution
from slipcar.planner.moments import covariance as moments
from slipcar.planner.problem.linearization import Linearization, linearize
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: Steps to where the model is not finite are rejected: no warning is needed on the way.
_quiet = np.errstate(over="ignore", invalid="ignore", divide="ignore")


@dataclasses.dataclass(frozen=True)
class Iterate:
    """A linearisation with the variance terms that belong to it.

    Attributes:
        lin: the linearisation.
        variance: w ∫ tr Σ dt as a quadratic, or None for w = 0.
    """

    lin: Linearization
    variance: moments.Variance | None

    def variance_value(self) -> float:
        """Return w ∫ tr Σ dt, but for what the start's covariance adds: steps hold that."""
        return 0.0 if self.variance is None else self.variance.value


@_quiet
def iterate_at(model: Model, variance_weight: float, x: Array, u: Array) -> Iterate:
    """Evaluate everything at states x (N, n) and controls u (N−1, m)."""
    lin = linearize(model, x, u)
    return Iterate(lin, variance_of(model, lin, variance_weight))


def variance_of(model: Model, lin: Linearization, weight: float) -> moments.Variance | None:
    """Return w ∫ tr Σ dt as a quadratic, or None for w = 0."""
    if weight == 0.0:
        return None
    d_sigma = np.asarray(model.diffusion_jacobian(model.times[:-1], lin.x[:-1]))
    Lambda = moments.adjoint_weights(lin.A, model.dt)
    start = moments.start_share(lin.A, Lambda, model.start_covariance)
    return moments.variance_penalty(weight, lin.sigma, d_sigma, Lambda, model.dt, start)


@_quiet
def merit(at: Iterate, found: Solution, tolerance: float, rho: float) -> float:
    """Φ with the multipliers of the sub-problem at hand; see the module's docstring."""
    lin = at.lin
    beyond = lin.g - np.clip(lin.g, -tolerance, tolerance)
    price = 0.5 * float(np.max(np.abs(found.adjoint)))
    nu, size = found.terminal, float(np.max(np.abs(found.terminal), initial=0.0))
    lacking = size > 0.5 * rho
    terminal = 0.0 if lacking else np.vdot(nu, beyond)
    terminal += (rho if lacking else 0.5 * size) * np.abs(beyond).sum()
    return (
        lin.effort
        + lin.penalty
        + lin.running
        + at.variance_value()
        + float(np.vdot(found.adjoint, lin.defect) + price * np.abs(lin.defect).sum())
        + float(terminal)
    )


@_quiet
def lagrangian(at: Iterate, found: Solution, tolerance: float) -> float:
    """The augmented Lagrangian with the multipliers of the sub-problem at hand.

    Near a solution defects are of second order in the step, as is its gain: the absolute values
    in the merit function would hide how the cost really curves, the squares here do not.
    """
    lin = at.lin
    beyond = lin.g - np.clip(lin.g, -tolerance, tolerance)
    size = 1.0 + float(np.max(np.abs(lin.x)))
    price = 100.0 * float(np.max(np.abs(found.adjoint))) / size
    return (
        lin.effort
        + lin.penalty
        + lin.running
        + at.variance_value()
        + float(np.vdot(found.adjoint, lin.defect) + np.vdot(found.terminal, beyond))
        + 0.5 * price * float(np.vdot(lin.defect, lin.defect) + np.vdot(beyond, beyond))
    )


@_quiet
def model_merit(
    model: Model, at: Iterate, sub: Subproblem, found: Solution, *, composite: bool
) -> float:
    """Merit of the step by the convex model: no defects, the trust region's term left out."""
    u = at.lin.u + found.e
    value = float(np.vdot(model.dt[:, None] * u, u @ model.R))
    value += sub.rho * sub.virtual_control(found.d) + at.lin.running
    if at.lin.q_running is not None:
        value += float(np.vdot(at.lin.q_running, found.d))
    if at.lin.Q_running is not None:
        value += 0.5 * float(np.einsum("ki,kij,kj", found.d, at.lin.Q_running, found.d))
    if at.lin.r_running is not None:
        value += float(np.vdot(at.lin.r_running, found.e))
    if at.variance is not None:
        d = found.d[:-1]
        value += at.variance.value + float(np.sum(at.variance.gradient[1:] * d))
        value += 0.5 * float(np.einsum("ki,kij,kj", d, at.variance.hessian[1:], d))
    if composite:
        c = np.maximum((sub.a @ found.d[..., None])[..., 0] + sub.b, 0.0)
        value += 0.5 * float(np.vdot(sub.h, c * c))
    else:
        value += at.lin.penalty
        slope = 2.0 * model.dt[:, None] * model.weight * np.maximum(at.lin.c, 0.0)
        value += float(np.einsum("kp,kpn,kn", slope, at.lin.C, found.d))
    return value

"""Everything known at an iterate: the model's values and first derivatives along (x, u)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.planner.problem.integrators import change, jacobian
from slipcar.planner.problem.model import Model

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Linearization:
    """Everything known at an iterate (x, u).

    Attributes:
        x: states, (N, n).
        u: controls, (K, m).
        A: ∂x⁺/∂x of a step of the integrator, I + dt ∂b/∂x for Euler's, (K, n, n).
        B: ∂x⁺/∂u, dt ∂b/∂u for Euler's, (K, n, m).
        defect: x⁺(x_k, u_k) − x_{k+1}, (K, n).
        sigma: diffusion at nodes 0..K−1, (K, n, d).
        c: penalty arguments at nodes 1..K, (K, p).
        C: their Jacobians, (K, p, n).
        g: terminal residual, (q,).
        G: its Jacobian, (q, n).
        effort: Σ dt uᵀRu.
        penalty: Σ dt Σ w max(0, c)².
        running: Σ dt (H + ℓᵀu); 0 where there are no such costs, and the rest is None.
        q_running: its gradient with respect to nodes 1..K, (K, n), or None.
        Q_running: dt times the Hessian of H there, positive semidefinite, (K, n, n), or None.
        r_running: its gradient with respect to the controls, dt ℓ, (K, m), or None.
    """

    x: Array
    u: Array
    A: Array
    B: Array
    defect: Array
    sigma: Array
    c: Array
    C: Array
    g: Array
    G: Array
    effort: float
    penalty: float
    running: float = 0.0
    q_running: Array | None = None
    Q_running: Array | None = None
    r_running: Array | None = None

    @property
    def finite(self) -> bool:
        """Whether the model functions returned finite numbers everywhere."""
        costs = (self.running, self.q_running, self.Q_running, self.r_running)
        return all(
            np.isfinite(a).all()
            for a in (self.A, self.B, self.defect, self.sigma, self.c, self.C, self.g, self.G)
        ) and all(np.isfinite(a).all() for a in costs if a is not None)


def linearize(model: Model, x: Array, u: Array) -> Linearization:
    """Evaluate the model and its first derivatives along x (N, n), u (N−1, m)."""
    t, dt = model.times, model.dt[:, None]
    moved = change(model.integrator, model.drift, t[:-1], model.dt, x[:-1], u)
    A, B = jacobian(
        model.integrator, model.drift, model.drift_jacobian, t[:-1], model.dt, x[:-1], u
    )
    c = model.penalty(t[1:], x[1:])
    return Linearization(
        x=x,
        u=u,
        A=A,
        B=B,
        defect=x[:-1] + moved - x[1:],
        sigma=np.asarray(model.diffusion(t[:-1], x[:-1])),
        c=c,
        C=np.asarray(model.penalty_jacobian(t[1:], x[1:])),
        g=np.asarray(model.terminal(x[-1])),
        G=np.asarray(model.terminal_jacobian(x[-1])),
        effort=float(np.vdot(dt * u, u @ model.R)),
        penalty=float(np.vdot(dt * model.weight, np.maximum(c, 0.0) ** 2)),
        **(_running(model, x, u) if model.state_cost or model.control_cost else {}),
    )


def _running(model: Model, x: Array, u: Array) -> dict[str, Any]:
    """∫ H + ℓᵀu dt and its derivatives: the last four fields of a `Linearization`."""
    t, dt = model.times, model.dt[:, None]
    found: dict[str, Any] = {"running": 0.0, "q_running": np.zeros((len(dt), x.shape[1]))}
    if model.state_cost is not None and model.state_cost_derivatives is not None:
        found["running"] += float(np.dot(model.dt, model.state_cost(t[1:], x[1:])))
        gradient, hessian = model.state_cost_derivatives(t[1:], x[1:])
        found["q_running"] += dt * gradient
        found["Q_running"] = dt[..., None] * nearest_semidefinite(np.asarray(hessian))
    if model.control_cost is not None and model.control_cost_jacobian is not None:
        r = dt * model.control_cost(t[:-1], x[:-1])
        slope = np.asarray(model.control_cost_jacobian(t[1:-1], x[1:-1]))
        found["running"] += float(np.vdot(r, u))
        found["q_running"][:-1] += dt[1:] * np.einsum("kmn,km->kn", slope, u[1:])
        found["r_running"] = r
    return found


def nearest_semidefinite(H: Array) -> Array:
    """The nearest positive semidefinite matrices to symmetric ones, (..., n, n)."""
    if not np.isfinite(H).all():
        return H  # the caller refuses it
    values, vectors = np.linalg.eigh(H)
    if (values >= 0.0).all():
        return H
    return (vectors * np.maximum(values, 0.0)[..., None, :]) @ vectors.swapaxes(-1, -2)

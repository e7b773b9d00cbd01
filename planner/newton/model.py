"""An iterate, its quadratic model and the LQ problem it poses: one iteration's mathematics.

See :mod:`.loop` for what is in the model when.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.moments import covariance as moments
from slipcar.planner.newton.functions import Functions
from slipcar.planner.newton.lq import LqSolution, LqSolver
from slipcar.planner.newton.settings import TUNING
from slipcar.planner.problem.linearization import Linearization, nearest_semidefinite
from slipcar.planner.problem.model import Model

Array = np.ndarray
#: Steps to where the model is not finite are rejected: no warning is needed on the way.
_quiet = np.errstate(over="ignore", invalid="ignore", divide="ignore")


@dataclasses.dataclass(frozen=True)
class Iterate:
    """Everything known at (x, u).

    Attributes:
        lin: values and first derivatives.
        d_ell: ∂ℓ/∂x at nodes 0..K−1, (K, m, n).
        H_xx: Hessian of H at nodes 1..K, (K, n, n).
        d_sigma: ∂σ/∂x at nodes 0..K−1, (K, n, d, n).
        variance: w ∫ tr Σ dt as a quadratic, or None for w = 0.
        weights: w dt Λ, what σσᵀ of each node is weighed by in it, (K, n, n), or None.
    """

    lin: Linearization
    d_ell: Array
    H_xx: Array
    d_sigma: Array
    variance: moments.Variance | None
    weights: Array | None

    @property
    def finite(self) -> bool:
        """Whether the problem's functions are finite everywhere."""
        lin = self.lin
        # A sum is finite only if every entry is.
        arrays = (lin.A, lin.B, lin.defect, lin.sigma, lin.c, lin.C, lin.g, lin.G)
        total = sum(a.sum() for a in (*arrays, self.d_ell, self.H_xx))
        return bool(np.isfinite(total + self.lin.running))

    @property
    def cost(self) -> float:
        """Effort, penalty, running cost and w ∫ tr Σ dt, what the start adds to it left out."""
        lin = self.lin
        variance = 0.0 if self.variance is None else self.variance.value
        return lin.effort + lin.penalty + lin.running + variance


@dataclasses.dataclass(frozen=True)
class Quadratic:
    """The model of the cost without its hinges; arguments of `LqSolver.solve`."""

    Q: Array
    q: Array
    R: Array
    r: Array
    S: Array | None  # None: zero


@_quiet
def evaluate(model: Model, functions: Functions, w: float, x: Array, u: Array) -> Iterate:
    """Values and first derivatives at x (N, n), u (K, m)."""
    (K, m), n = u.shape, x.shape[1]
    t, dt = model.times, model.dt
    stage = functions.stage(t=t[:-1], dt=dt, x=x[:-1], u=u)
    node = functions.node(t=t[1:], x=x[1:])
    terminal = functions.terminal(x=x[-1:])
    A, sigma = stage["A"].reshape(K, n, n), stage["sigma"].reshape(K, n, -1)
    ell, d_ell = stage["ell"], stage["d_ell"].reshape(K, m, n)
    H_x, H_xx = node["H_x"], node["H_xx"].reshape(K, n, n)
    c = node["c"]
    column = dt[:, None]
    q_running = column * H_x
    if model.control_cost is not None:
        q_running[:-1] += column[1:] * np.einsum("kmn,km->kn", d_ell[1:], u[1:])
    lin = Linearization(
        x=x,
        u=u,
        A=A,
        B=stage["B"].reshape(K, n, m),
        defect=stage["next"] - x[1:],
        sigma=sigma,
        c=c,
        C=node["C"].reshape(K, -1, n) if c.shape[1] else np.zeros((K, 0, n)),
        g=terminal["g"][0],
        G=terminal["G"].reshape(-1, n),
        effort=float(np.vdot(column * u, u @ model.R)),
        penalty=float(np.vdot(column * model.weight, np.maximum(c, 0.0) ** 2)),
        running=float(np.vdot(column * ell, u) + np.vdot(dt, node["H"][:, 0])),
        q_running=q_running,
        r_running=column * ell,
    )
    variance, weights = None, None
    d_sigma = stage["d_sigma"].reshape(*sigma.shape, n)
    if w > 0.0:
        Lambda = moments.adjoint_weights(A, dt)
        start = moments.start_share(A, Lambda, model.start_covariance)
        variance = moments.variance_penalty(w, sigma, d_sigma, Lambda, dt, start)
        weights = w * dt[:, None, None] * Lambda
    return Iterate(lin, d_ell, H_xx, d_sigma, variance, weights)


def quadratic_model(
    model: Model,
    functions: Functions,
    at: Iterate,
    adjoint: Array,
    terminal: Array,
    curved: bool,
) -> Quadratic:
    """The quadratic model at an iterate, hinges and shift left out."""
    lin, dt = at.lin, model.dt
    (K, m), n = lin.u.shape, lin.x.shape[1]
    assert lin.q_running is not None
    assert lin.r_running is not None
    q = lin.q_running.copy()
    Q = dt[:, None, None] * at.H_xx
    R = 2.0 * dt[:, None, None] * model.R
    r = times(R, lin.u) + lin.r_running
    S = None
    if curved:
        t = model.times
        second = functions.stage_hessian(t=t[:-1], dt=dt, x=lin.x[:-1], u=lin.u, adjoint=adjoint)
        Q[:-1] += second["xx"].reshape(K, n, n)[1:]
        S = second["ux"].reshape(K, m, n) if second["ux"].any() else None
        R += second["uu"].reshape(K, m, m)
        if lin.c.shape[1]:
            eta = 2.0 * dt[:, None] * model.weight * np.maximum(lin.c, 0.0)
            Q += functions.node_hessian(t=t[1:], x=lin.x[1:], weight=eta)["xx"].reshape(K, n, n)
        bent = functions.terminal_hessian(x=lin.x[-1:], multiplier=terminal[None])["xx"]
        Q[-1] += bent.reshape(n, n)
    elif at.H_xx.any():
        Q = nearest_semidefinite(Q)
    if at.variance is not None:
        # σ at the last node drives nothing; node 0 is fixed.
        q[:-1] += at.variance.gradient[1:]
        Q[:-1] += at.variance.hessian[1:]
    return Quadratic(Q, q, R, r, S)


def solve_model(
    model: Model,
    at: Iterate,
    quadratic: Quadratic,
    bounds: tuple[Array, Array],
    weight: Array,
    shift: float,
    solver: LqSolver,
    gramian: float,
    curved: bool,
) -> tuple[LqSolution | None, tuple[Array, Array], int]:
    """Solve the model with the hinges that are on; the active bounds; LQ problems solved."""
    lin, dt = at.lin, model.dt
    h = 2.0 * dt[:, None] * weight * (lin.c > 0.0)
    Q, q = quadratic.Q, quadratic.q
    if h.any():
        rows = lin.C.swapaxes(1, 2)
        Q = Q + rows @ (h[..., None] * lin.C)
        q = q + times(rows, h * lin.c)
    elif curved:
        Q, q = Q.copy(), q.copy()
    R = quadratic.R
    if shift > 0.0:
        level = 2.0 * shift * dt[:, None, None]
        Q, R = Q + level * np.eye(Q.shape[1]), R + level * np.eye(R.shape[1])
    if curved and gramian > 0.0:
        kappa = TUNING.terminal_curvature * len(lin.g) / gramian
        Q[-1] += kappa * lin.G.T @ lin.G
        q[-1] += kappa * lin.G.T @ lin.g
        gramian /= 1.0 + kappa * gramian  # what is left of it under this curvature
    bounded = model.bounded
    lower, upper = model.lower - lin.u, model.upper - lin.u
    stiffness = TUNING.bound_stiffness * 2.0 * float(np.max(dt) * np.max(np.diag(model.R)))
    diagonal = np.arange(R.shape[1])
    found = None
    for solves in range(1, TUNING.bound_rounds + 1):
        low, high = bounds
        Rb, rb = R, quadratic.r
        if bounded and (low.any() or high.any()):
            Rb, on = R.copy(), low | high
            Rb[:, diagonal, diagonal] += stiffness * on
            rb = rb - stiffness * np.where(high, upper, np.where(low, lower, 0.0))
        found = solver.solve(
            lin.A, lin.B, lin.defect, Q, q, Rb, rb, quadratic.S, lin.G, lin.g,
            gramian, convex=not curved,
        )  # fmt: skip
        if found is None or not bounded:
            return found, bounds, solves
        new = (found.e < lower, found.e > upper)
        if np.array_equal(new[0], low) and np.array_equal(new[1], high):
            return found, bounds, solves
        if solves < TUNING.bound_rounds:
            bounds = new
    # The set does not settle: clip the controls and let the states follow.
    assert found is not None
    e, d = np.clip(lin.u + found.e, model.lower, model.upper) - lin.u, np.empty_like(found.d)
    state = np.zeros(d.shape[1])
    for k in range(len(d)):
        state = d[k] = lin.A[k].dot(state) + lin.B[k].dot(e[k]) + lin.defect[k]
    return dataclasses.replace(found, d=d, e=e), bounds, solves


def times(M: Array, v: Array) -> Array:
    """Matrix times vector at every node: (K, i, j), (K, j) -> (K, i)."""
    return (M @ v[..., None])[..., 0]

"""The sub-problem in a page, for any cone solver: the readable reference and the tests' oracle."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
from scipy import linalg, sparse

from slipcar.planner.convex.solvers.interface import Solution, failed
from slipcar.planner.convex.subproblem import Subproblem

#: Solvers tried in order, with the settings that make them precise.
_SOLVERS = {
    "CLARABEL": {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10},
    "ECOS": {"abstol": 1e-10, "reltol": 1e-10, "feastol": 1e-10},
    "SCS": {"eps": 1e-9, "max_iters": 100_000},
}


class CvxpySolver:
    """Writes each sub-problem out anew; tens of milliseconds, nearly all of it modelling.

    `solver` is any conic solver that cvxpy has installed; None takes the first of Clarabel, ECOS,
    SCS. ImportError if there is none.
    """

    def __init__(self, solver: str | None = None) -> None:
        installed = cp.installed_solvers()
        chosen = solver or next((name for name in _SOLVERS if name in installed), None)
        if chosen is None:
            raise ImportError(f"cvxpy has none of {list(_SOLVERS)} installed: pip install clarabel")
        self.solver = chosen

    def solve(self, sub: Subproblem) -> Solution:
        """Solve one sub-problem."""
        (K, n), m = sub.f.shape, sub.r.shape[1]
        d, e = cp.Variable((K, n)), cp.Variable((K, m))
        slack = cp.Variable(len(sub.g))
        flat_d, flat_e = cp.vec(d, order="C"), cp.vec(e, order="C")

        cost = 0.5 * cp.sum_squares(_root(sub.R) @ flat_e) + cp.sum(cp.multiply(sub.r, e))
        cost += cp.sum(cp.multiply(sub.q, d)) + sub.rho * cp.norm1(slack)
        if np.any(sub.Q):
            cost += 0.5 * cp.sum_squares(_root(sub.Q) @ flat_d)
        for i in range(sub.b.shape[1]):
            argument = cp.sum(cp.multiply(sub.a[:, i], d), axis=1) + sub.b[:, i]
            cost += 0.5 * cp.sum_squares(cp.multiply(np.sqrt(sub.h[:, i]), cp.pos(argument)))

        before = [np.zeros(n)]  # A_0 d_0: the start is fixed
        if K > 1:
            before.append(sparse.block_diag(list(sub.A[1:])) @ flat_d[:-n])
        response = sparse.block_diag(list(sub.B)) @ flat_e + sub.f.ravel()
        dynamics = flat_d == cp.hstack(before) + response
        residual = sub.G @ d[K - 1] + sub.g - slack
        terminal = residual == 0 if sub.tolerance == 0.0 else cp.norm_inf(residual) <= sub.tolerance
        constraints = [dynamics, terminal]
        for bound, sign in ((sub.upper, 1.0), (-sub.lower, -1.0)):
            finite = np.isfinite(bound)
            if finite.any():
                constraints.append(sign * flat_e[finite.ravel()] <= bound[finite])
        if np.isfinite(sub.radius):
            constraints.append(cp.norm(e - sub.center, 2, axis=1) <= sub.radius)

        problem = cp.Problem(cp.Minimize(cost), constraints)
        try:
            problem.solve(solver=self.solver, **_SOLVERS.get(self.solver, {}))
        except cp.SolverError as error:
            return failed(sub, 0, f"{self.solver}: {error}")
        if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or d.value is None:
            return failed(sub, 0, f"{self.solver}: {problem.status}")
        adjoint = -np.asarray(dynamics.dual_value).reshape(K, n)
        states, controls = np.asarray(d.value), np.asarray(e.value)
        terminal = _terminal_multiplier(sub, adjoint, states)
        solved, objective = problem.status == cp.OPTIMAL, sub.objective(states, controls)
        iterations = int(problem.solver_stats.num_iters or 0)
        message = "" if solved else f"{self.solver}: inaccurate"
        return Solution(solved, states, controls, adjoint, terminal, objective, iterations, message)


def _root(blocks: np.ndarray) -> sparse.csr_array:
    """Block-diagonal S with SᵀS = the given positive semidefinite blocks."""
    roots = []
    for block in blocks:
        values, vectors = linalg.eigh(block)
        roots.append(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
    return sparse.csr_array(sparse.block_diag(roots))


def _terminal_multiplier(sub: Subproblem, adjoint: np.ndarray, d: np.ndarray) -> np.ndarray:
    """ν from stationarity at the last node: λ_K = Q d + q + hinges + Gᵀ ν."""
    hinge = sub.h[-1] * np.maximum(sub.a[-1] @ d[-1] + sub.b[-1], 0.0)
    force = adjoint[-1] - sub.Q[-1] @ d[-1] - sub.q[-1] - hinge @ sub.a[-1]
    return np.linalg.lstsq(sub.G.T, force, rcond=None)[0]

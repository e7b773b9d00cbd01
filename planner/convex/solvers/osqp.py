"""OSQP on the sub-problem, set up once and updated in place.

Variables (d, e, hinge slacks t ≥ 0 with t ≥ a·d + b, terminal slacks s⁺, s⁻ ≥ 0); the sparsity
pattern is full within every node's blocks and never changes, so that an update equals a fresh
set-up (values outside the pattern would be lost without a word). The terminal slacks are held
at zero first: their large linear cost spoils ADMM's scaling (a hundred times the iterations),
and it is rarely needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import osqp
from scipy import sparse

from slipcar.planner.convex.solvers.interface import Solution, failed
from slipcar.planner.convex.subproblem import Subproblem

Array = np.ndarray


#: What OSQP takes for infinity.
_INFINITY = 1e30
#: Polishing finds the last digits once the active set is right.
_SETTINGS: dict[str, Any] = {
    "eps_abs": 1e-6, "eps_rel": 1e-6, "polishing": True, "check_dualgap": False,
    "rho": 1.0, "max_iter": 20_000, "verbose": False,
}  # fmt: skip


class OsqpSolver:
    """Solver for sub-problems of one shape; keeps OSQP's workspace and its last point.

    Settings are passed to OSQP, over this module's defaults.
    """

    def __init__(self, **settings: object) -> None:
        self._settings = {**_SETTINGS, **settings}
        self._programme: _Programme | None = None
        self._workspace: osqp.OSQP | None = None

    def solve(self, sub: Subproblem) -> Solution:
        """Solve one sub-problem, from the last one's solution.

        Raises:
            ValueError: if the controls lie in a ball: that is no quadratic program.
        """
        if np.isfinite(sub.radius):
            raise ValueError("osqp cannot take control_radius; use structured or cvxpy")
        shape = (*sub.f.shape, sub.r.shape[1], sub.b.shape[1], len(sub.g))
        if self._programme is None or self._programme.shape != shape:
            self._programme, self._workspace = _Programme(*shape), None
        programme = self._programme
        if not max(np.abs(each).max(initial=0.0) for each in (sub.f, sub.g, sub.b)) < _INFINITY:
            return failed(sub, 0, f"OSQP: numbers beyond {_INFINITY:g}")
        result, spent = self._run(programme, sub, slack=False), 0
        price = np.max(np.abs(programme.multipliers(result.y)[1]), initial=0.0)
        if result.info.status_val != 1 or not price <= sub.rho:
            # The condition cannot be met, or only at a price above ρ: let the slacks open.
            spent = int(result.info.iter)
            result = self._run(programme, sub, slack=True)
        info, spent = result.info, spent + int(result.info.iter)
        if info.status_val not in (1, 2) or not np.isfinite(result.x).all():
            self._workspace = None  # nothing to start the next one from
            return failed(sub, spent, f"OSQP: {info.status}")
        d, e = result.x[programme.d], result.x[programme.e]
        solved, objective = info.status_val == 1, sub.objective(d, e)
        message = "" if solved else f"OSQP: {info.status}"
        adjoint, terminal = programme.multipliers(result.y)
        e = np.clip(e, sub.lower, sub.upper)
        return Solution(solved, d, e, adjoint, terminal, objective, spent, message)

    def _run(self, programme: _Programme, sub: Subproblem, *, slack: bool) -> Any:
        (P, A), (q, low, high) = programme.matrices(sub), programme.vectors(sub, slack=slack)
        if self._workspace is None:
            self._workspace = osqp.OSQP()
            self._workspace.setup(P, q, A, low, high, **self._settings)
        else:
            self._workspace.update(Px=P.data, q=q, Ax=A.data, l=low, u=high)
        return self._workspace.solve(raise_error=False)


class _Matrix:
    """A sparse matrix of blocks in given (rows, columns), which keeps the zeros among them."""

    def __init__(self, shape: tuple[int, int], *places: tuple[Array, Array]) -> None:
        pairs = [np.broadcast_arrays(*place) for place in places]
        rows, columns = (
            np.concatenate([part.ravel() for part in parts]) for parts in zip(*pairs, strict=True)
        )
        self._order = np.lexsort((rows, columns))
        self._matrix = sparse.csc_matrix((np.zeros(len(rows)), (rows, columns)), shape)

    def filled(self, *blocks: Array) -> sparse.csc_matrix:
        """The matrix with these blocks."""
        self._matrix.data = np.concatenate([block.ravel() for block in blocks])[self._order]
        return self._matrix


class _Programme:
    """½ zᵀPz + qᵀz over low ≤ A z ≤ high: where every number of a sub-problem goes."""

    def __init__(self, K: int, n: int, m: int, p: int, q: int) -> None:
        self.shape = (K, n, m, p, q)
        columns = _numbered((K, n), (K, m), (K, p), (q,), (q,))
        d, e, t, plus, minus = columns
        # All but d have limits, in a row each.
        limited = np.concatenate([column.ravel() for column in columns[1:]])
        rows = _numbered((K, n), (q,), (K, p), limited.shape)
        dynamics, terminal, hinges, limits = rows
        width, height = (sum(each.size for each in part) for part in (columns, rows))
        self.d, self.e, self.plus, self.minus, self.width = d, e, plus, minus, width
        self.dynamics, self.terminal = dynamics, terminal
        self.upper = np.triu_indices(n), np.triu_indices(m)
        triangles = [(z[:, i], z[:, j]) for z, (i, j) in zip((d, e), self.upper, strict=True)]
        self.P = _Matrix((width, width), *triangles, (t, t))
        self.A = _Matrix(
            (height, width),
            (dynamics, d),
            (dynamics[1:, :, None], d[:-1, None, :]),
            (dynamics[:, :, None], e[:, None, :]),
            (terminal[:, None], d[-1]),
            (terminal, plus),
            (terminal, minus),
            (hinges[:, :, None], d[:, None, :]),
            (hinges, t),
            (limits, limited),
        )

    def matrices(self, sub: Subproblem) -> tuple[sparse.csc_matrix, sparse.csc_matrix]:
        """P (its upper triangle) and A."""
        (rows, columns), (u_rows, u_columns) = self.upper
        one, ones = np.ones(len(sub.g)), np.ones(sub.b.shape)
        P = self.P.filled(sub.Q[:, rows, columns], sub.R[:, u_rows, u_columns], sub.h)
        limited = np.ones(self.width - sub.f.size)
        A = self.A.filled(
            np.ones(sub.f.shape), -sub.A[1:], -sub.B, sub.G, -one, one, sub.a, -ones, limited
        )
        return P, A

    def vectors(self, sub: Subproblem, *, slack: bool) -> tuple[Array, Array, Array]:
        """q, low and high; the terminal slacks open or held at zero."""
        linear = np.zeros(self.width)
        linear[self.d], linear[self.e] = sub.q, sub.r
        linear[self.plus] = linear[self.minus] = sub.rho if slack else 0.0
        f, b, infinite = sub.f.ravel(), sub.b.ravel(), np.full(sub.b.size, np.inf)
        zeros = np.zeros(sub.b.size + 2 * len(sub.g))
        ceiling = np.full(2 * len(sub.g), np.inf if slack else 0.0)
        tau = sub.tolerance
        low = [f, -sub.g - tau, -infinite, sub.lower.ravel(), zeros]
        high = [f, -sub.g + tau, -b, sub.upper.ravel(), infinite, ceiling]
        return linear, np.concatenate(low), np.concatenate(high)

    def multipliers(self, y: Array) -> tuple[Array, Array]:
        """λ (K, n) and ν (q,)."""
        return -y[self.dynamics], y[self.terminal]


def _numbered(*shapes: tuple[int, ...]) -> list[Array]:
    """Consecutive numbers in arrays of these shapes."""
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    parts = zip(np.split(np.arange(ends[-1]), ends[:-1]), shapes, strict=True)
    return [part.reshape(shape) for part, shape in parts]

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


class OsqpSolver:
    """Solver for sub-problems of one shape; keeps OSQP's workspace and its last point.

    Args:
        **settings: passed to OSQP, over this module's defaults.
    """

    def __init__(self, **settings: object) -> None:
        self._settings = {
            # Polishing finds the last digits once the active set is right.
            "eps_abs": 1e-6,
            "eps_rel": 1e-6,
            "polishing": True,
            "check_dualgap": False,
            "rho": 1.0,
            "max_iter": 20_000,
            "verbose": False,
            **settings,
        }
        self._pattern: _Pattern | None = None
        self._workspace: osqp.OSQP | None = None

    def solve(self, sub: Subproblem) -> Solution:
        """Solve one sub-problem, from the last one's solution.

        Raises:
            ValueError: if the controls lie in a ball: that is no quadratic program.
        """
        if np.isfinite(sub.radius):
            raise ValueError("osqp cannot take control_radius; use structured or cvxpy")
        shape = (*sub.f.shape, sub.r.shape[1], sub.b.shape[1], len(sub.g))
        if self._pattern is None or self._pattern.shape != shape:
            self._pattern, self._workspace = _Pattern(*shape), None
        result, spent = self._run(sub, slack=False), 0
        if not _usable(result, sub, self._pattern):
            # The condition cannot be met, or only at a price above ρ: let the slacks open.
            spent = int(result.info.iter)
            result = self._run(sub, slack=True)
        info, spent = result.info, spent + int(result.info.iter)
        pattern = self._pattern
        if info.status_val not in (1, 2) or not np.isfinite(result.x).all():
            self._workspace = None  # nothing to start the next one from
            return failed(sub, spent, f"OSQP: {info.status}")
        d, e = pattern.unpack(result.x)
        adjoint, terminal = pattern.multipliers(result.y)
        solved = info.status_val == 1
        return Solution(
            found=solved,
            d=d,
            e=np.clip(e, sub.lower, sub.upper),
            adjoint=adjoint,
            terminal=terminal,
            objective=sub.objective(d, e),
            iterations=spent,
            message="" if solved else f"OSQP: {info.status}",
        )

    def _run(self, sub: Subproblem, *, slack: bool) -> Any:
        assert self._pattern is not None
        P, q, A, low, high = self._pattern.fill(sub, slack=slack)
        if self._workspace is None:
            self._workspace = osqp.OSQP()
            patterns = self._pattern.P.with_data(P), self._pattern.A.with_data(A)
            self._workspace.setup(patterns[0], q, patterns[1], low, high, **self._settings)
        else:
            self._workspace.update(Px=P, q=q, Ax=A, l=low, u=high)
        return self._workspace.solve(raise_error=False)


def _usable(result: Any, sub: Subproblem, pattern: _Pattern) -> bool:
    """Whether the solution with a hard terminal condition is the exact penalty's, too."""
    if result.info.status_val != 1:
        return False
    return bool(np.max(np.abs(pattern.multipliers(result.y)[1]), initial=0.0) <= sub.rho)


class _Csc:
    """A fixed sparsity pattern that is filled from a list of blocks in a known order."""

    def __init__(self, shape: tuple[int, int], rows: Array, columns: Array) -> None:
        self.shape = shape
        self.order = np.lexsort((rows, columns))
        counts = np.bincount(columns, minlength=shape[1])
        self.indices = rows[self.order].astype(np.int32)
        self.indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)

    def data(self, values: Array) -> Array:
        return values[self.order]

    def with_data(self, data: Array) -> sparse.csc_matrix:
        return sparse.csc_matrix((data, self.indices, self.indptr), shape=self.shape)


class _Pattern:
    """Where every number of a sub-problem goes."""

    def __init__(self, K: int, n: int, m: int, p: int, q: int) -> None:
        self.shape = (K, n, m, p, q)
        # Variables.
        self.d = np.arange(K * n).reshape(K, n)
        self.e = K * n + np.arange(K * m).reshape(K, m)
        self.t = K * (n + m) + np.arange(K * p).reshape(K, p)
        begin = K * (n + m + p)
        self.plus, self.minus = begin + np.arange(q), begin + q + np.arange(q)
        self.variables = begin + 2 * q
        # P: upper triangles of Q and R, the diagonal of h.
        self.upper_n, self.upper_m = np.triu_indices(n), np.triu_indices(m)
        P = [
            (self.d[:, self.upper_n[0]], self.d[:, self.upper_n[1]]),
            (self.e[:, self.upper_m[0]], self.e[:, self.upper_m[1]]),
            (self.t, self.t),
        ]
        self.P = _Csc((self.variables, self.variables), *_stack(P))
        # Constraints: dynamics, terminal, hinge rows, bounds on e, t ≥ 0, slacks ≥ 0.
        rows = np.arange(K * n).reshape(K, n)
        terminal = K * n + np.arange(q)
        hinge = K * n + q + np.arange(K * p).reshape(K, p)
        bound = K * (n + p) + q
        boxed = np.concatenate([self.e.ravel(), self.t.ravel(), self.plus, self.minus])
        A = [
            (rows, self.d),
            (rows[1:, :, None], self.d[:-1, None, :]),
            (rows[:, :, None], self.e[:, None, :]),
            (terminal[:, None], self.d[-1][None, :]),
            (terminal, self.plus),
            (terminal, self.minus),
            (hinge[:, :, None], self.d[:, None, :]),
            (hinge, self.t),
            (bound + np.arange(len(boxed)), boxed),
        ]
        self.boxed = len(boxed)
        self.A = _Csc((bound + len(boxed), self.variables), *_stack(A))

    def fill(self, sub: Subproblem, *, slack: bool) -> tuple[Array, Array, Array, Array, Array]:
        """P and A data, q, lower and upper limits; the terminal slacks open or held at 0."""
        K, _, _, p, q = self.shape
        P = [
            sub.Q[:, self.upper_n[0], self.upper_n[1]],
            sub.R[:, self.upper_m[0], self.upper_m[1]],
            sub.h,
        ]
        linear = np.zeros(self.variables)
        linear[self.d], linear[self.e] = sub.q, sub.r
        linear[self.plus] = linear[self.minus] = sub.rho if slack else 0.0
        one_q, one_hinge = np.ones(q), np.ones((K, p))
        A = [
            np.ones(sub.f.shape),
            -sub.A[1:],
            -sub.B,
            sub.G,
            -one_q,
            one_q,
            sub.a,
            -one_hinge,
            np.ones(self.boxed),
        ]
        f, b, inf = sub.f.ravel(), sub.b.ravel(), np.inf
        zeros = np.zeros(K * p + 2 * q)
        ceiling = np.full(2 * q, inf if slack else 0.0)
        low = np.concatenate(
            [f, -sub.g - sub.tolerance, np.full(K * p, -inf), sub.lower.ravel(), zeros]
        )
        high = np.concatenate(
            [f, -sub.g + sub.tolerance, -b, sub.upper.ravel(), np.full(K * p, inf), ceiling]
        )
        return self.P.data(_flatten(P)), linear, self.A.data(_flatten(A)), low, high

    def unpack(self, x: Array) -> tuple[Array, Array]:
        return x[self.d], x[self.e]

    def multipliers(self, y: Array) -> tuple[Array, Array]:
        K, n, _, _, q = self.shape
        return -y[: K * n].reshape(K, n), y[K * n : K * n + q]


def _stack(entries: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    pairs = [np.broadcast_arrays(r, c) for r, c in entries]
    return (
        np.concatenate([r.ravel() for r, _ in pairs]),
        np.concatenate([c.ravel() for _, c in pairs]),
    )


def _flatten(parts: list[Array]) -> Array:
    return np.concatenate([part.ravel() for part in parts])

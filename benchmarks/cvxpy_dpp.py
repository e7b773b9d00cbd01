"""The sub-problem in cvxpy, built once with parameters (DPP): how convex modelling is done fast.

The `cvxpy` backend of slipcar writes every sub-problem out anew, to be read; most of its time is
modelling. This one is its fastest form, for deterministic SCP with an exact terminal condition:
what changes from one iteration to the next is a parameter, and cvxpy only fills in numbers. The
rest are constants of a programme; a plan may need several programmes (its sub-problems leave the
bounds of the controls out until they matter), each of which is built once and kept.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cvxpy as cp
import numpy as np
from contenders import Contender, UnavailableError
from ours import planner

from slipcar.envs import Scenario
from slipcar.planner.convex.solvers.interface import Solution, failed
from slipcar.planner.convex.subproblem import Subproblem


class DppSolver:
    """Clarabel on parametrised programmes, one for each set of constants met."""

    def __init__(self) -> None:
        self._programmes: dict[tuple[object, ...], _Programme] = {}

    def solve(self, sub: Subproblem) -> Solution:
        """Fill the parameters of its programme in and solve."""
        key = (sub.bounded, *(getattr(sub, name).tobytes() for name in ("R", "h", "G")))
        if key not in self._programmes:
            self._programmes[key] = _Programme(sub)
        return self._programmes[key].solve(sub)


class _Programme:
    """All sub-problems that share sizes, R, h, G, and whether controls are bounded."""

    def __init__(self, sub: Subproblem) -> None:
        if np.any(sub.Q) or np.any(sub.q):
            raise ValueError("DppSolver is for deterministic SCP: variance_weight=0")
        if sub.tolerance > 0.0 or np.isfinite(sub.radius):
            raise ValueError("DppSolver knows neither a terminal box nor balls of controls")
        (K, n), m, p = sub.f.shape, sub.r.shape[1], sub.b.shape[1]
        # Matrices go in column by column, all nodes at once: Σ_j A[:, :, j] ∘ (d[:, j] 1ᵀ). A few
        # large parameters are filled in much faster than one small one for every node.
        self._vectors = {
            name: cp.Parameter(getattr(sub, name).shape)
            for name in ("f", "r", "b", "g", *(("lower", "upper") if sub.bounded else ()))
        }
        self._columns = {
            name: [cp.Parameter((K, rows)) for _ in range(columns)]
            for name, rows, columns in (("A", n, n), ("B", n, m), ("a", p, n))
        }
        self._rho = cp.Parameter(nonneg=True)
        d, e, slack = cp.Variable((K, n)), cp.Variable((K, m)), cp.Variable(len(sub.g))
        before = cp.vstack([np.zeros((1, n)), d[:-1]])
        R = np.stack([np.linalg.cholesky(block).T for block in sub.R])
        root = [cp.multiply(R[:, :, j], _repeated(e, j, m)) for j in range(m)]
        arguments = self._product("a", d) + self._vectors["b"]
        cost = (
            0.5 * cp.sum_squares(sum(root))
            + cp.sum(cp.multiply(self._vectors["r"], e))
            + 0.5 * cp.sum_squares(cp.multiply(np.sqrt(sub.h), cp.pos(arguments)))
            + self._rho * cp.norm1(slack)
        )
        self._d, self._e = d, e
        self._dynamics = (
            d == self._product("A", before) + self._product("B", e) + self._vectors["f"]
        )
        self._terminal = sub.G @ d[K - 1] + self._vectors["g"] == slack
        constraints = [self._dynamics, self._terminal]
        if sub.bounded:
            constraints += [e >= self._vectors["lower"], e <= self._vectors["upper"]]
        self._problem = cp.Problem(cp.Minimize(cost), constraints)

    def solve(self, sub: Subproblem) -> Solution:
        for name, parameter in self._vectors.items():
            parameter.value = getattr(sub, name)
        for name, columns in self._columns.items():
            for j, column in enumerate(columns):
                column.value = getattr(sub, name)[:, :, j]
        self._rho.value = sub.rho
        self._problem.solve(solver=cp.CLARABEL)
        if self._problem.status != cp.OPTIMAL:
            return failed(sub, 0, f"Clarabel: {self._problem.status}")
        d, e = self._d.value, self._e.value
        return Solution(
            found=True,
            d=d,
            e=e,
            adjoint=-self._dynamics.dual_value,
            terminal=self._terminal.dual_value,
            objective=sub.objective(d, e),
            iterations=int(self._problem.solver_stats.num_iters),
        )

    def _product(self, name: str, x: cp.Expression) -> cp.Expression:
        """Row k: the parameter matrix of node k times row k of x."""
        columns = self._columns[name]
        rows = columns[0].shape[1]
        return sum(cp.multiply(M, _repeated(x, j, rows)) for j, M in enumerate(columns))


def _repeated(x: cp.Expression, j: int, times: int) -> cp.Expression:
    """Column j of x, so many times over."""
    return x[:, j : j + 1] @ np.ones((1, times))


def cvxpy_dpp(scenario: Scenario) -> Contender:
    """SCP with the programme built once, as a contender."""
    if "CLARABEL" not in cp.installed_solvers():
        raise UnavailableError("Clarabel is not installed")
    solver, name = DppSolver(), "slipcar, convex scheme, cvxpy + Clarabel built once"
    contender = planner(name, scenario, method="convex", solver=solver)
    first, again = contender.solve()[0], contender.solve()[0]
    return dataclasses.replace(contender, build_seconds=max(first - again, 0.0))


def makers(scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    """By name."""
    return {"slipcar, cvxpy + Clarabel, built once": lambda: cvxpy_dpp(scenario)}

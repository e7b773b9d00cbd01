"""Sub-problem solvers behind one small interface: `solve(subproblem, warm) -> Solution`.

* `structured` (default): semismooth Newton on banded KKT systems, exact, no QP package.
* `osqp`: first-order method for any sparse QP, updated in place.
* `cvxpy`: the sub-problem in a page, any cone solver; slow, readable, the tests' oracle.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np

from slipcar.planner.convex.convexify import Subproblem

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Solution:
    """A sub-problem's solution, or the typed failure to find one.

    Attributes:
        found: whether the arrays below solve the sub-problem to the solver's tolerance.
        d: deviations of nodes 1..K, (K, n).
        e: control deviations, (K, m).
        adjoint: λ_1..λ_K, multipliers of the dynamics, (K, n): gradient of the cost to go.
        terminal: ν, multiplier of the terminal condition, (q,), |ν| ≤ ρ.
        objective: value of the sub-problem.
        iterations: LQ solves (structured) or iterations of the package.
        message: the package's own words when not found.
    """

    found: bool
    d: Array
    e: Array
    adjoint: Array
    terminal: Array
    objective: float
    iterations: int
    message: str = ""


class Solver(Protocol):
    """Solves a sequence of sub-problems of one shape."""

    def solve(self, sub: Subproblem) -> Solution:
        """Solve one; a solver may start from what it found last."""
        ...


def failed(sub: Subproblem, iterations: int, message: str) -> Solution:
    """A `Solution` that was not found: zero deviations, infinite objective."""
    K, n = sub.f.shape
    return Solution(
        found=False,
        d=np.zeros((K, n)),
        e=np.zeros(sub.r.shape),
        adjoint=np.zeros((K, n)),
        terminal=np.zeros(sub.g.shape),
        objective=np.inf,
        iterations=iterations,
        message=message,
    )


def _structured() -> Solver:
    from slipcar.planner.convex.solvers.structured import StructuredSolver

    return StructuredSolver()


def _osqp() -> Solver:
    from slipcar.planner.convex.solvers.osqp import OsqpSolver

    return OsqpSolver()


def _cvxpy() -> Solver:
    from slipcar.planner.convex.solvers.cvxpy import CvxpySolver

    return CvxpySolver()


#: Constructors by name; packages are imported when first used.
BACKENDS: dict[str, Callable[[], Solver]] = {
    "structured": _structured,
    "osqp": _osqp,
    "cvxpy": _cvxpy,
}


def make_solver(name: str) -> Solver:
    """A fresh solver.

    Raises:
        ValueError: for an unknown name, listing the known ones.
        ImportError: if the package behind it is not installed, with what to type.
    """
    if name not in BACKENDS:
        raise ValueError(f"unknown solver {name!r}; the solvers are {list(BACKENDS)}")
    try:
        return BACKENDS[name]()
    except ModuleNotFoundError as error:
        raise ImportError(
            f'solver={name!r} needs the package {error.name}: pip install "slipcar[qp]"; '
            f"solver='structured' needs none"
        ) from error

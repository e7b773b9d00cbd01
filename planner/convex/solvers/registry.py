"""Solvers by name; the packages behind them are imported when first used."""

from __future__ import annotations

from collections.abc import Callable

from slipcar.planner.convex.solvers.interface import Solver
from slipcar.planner.convex.solvers.structured import StructuredSolver


def _osqp() -> Solver:
    from slipcar.planner.convex.solvers.osqp import OsqpSolver

    return OsqpSolver()


def _cvxpy() -> Solver:
    from slipcar.planner.convex.solvers.cvxpy import CvxpySolver

    return CvxpySolver()


#: Constructors by name.
BACKENDS: dict[str, Callable[[], Solver]] = {
    "structured": StructuredSolver,
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
            f"solver={name!r} needs the package {error.name}: pip install {error.name}; "
            f"solver='structured' needs none"
        ) from error

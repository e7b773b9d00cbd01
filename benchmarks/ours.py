"""slipcar's own planners as contenders, called as a user calls them: one `plan` each time.

Nothing is kept between two plans: model checks, workspaces and the solver's set-up are in the
time.
"""

from __future__ import annotations

from collections.abc import Callable

from contenders import EXACT, Answer, Contender, UnavailableError, stopwatch

from slipcar.envs import Scenario
from slipcar.planner import Plan, Status, plan
from slipcar.planner.backends import Solver, make_solver
from slipcar.planner.backends.structured import StructuredSolver

#: `plan`'s default, and one for answers as exact as those of the whole-problem solvers.
DEFAULT_TOLERANCE, FINE_TOLERANCE = 1e-3, 1e-6


def numba(
    scenario: Scenario, weight: float = 0.0, tolerance: float = DEFAULT_TOLERANCE
) -> Contender:
    """The structured solver, compiled."""
    return ours("numba", lambda: StructuredSolver(True), scenario, weight, tolerance)


def numpy(
    scenario: Scenario, weight: float = 0.0, tolerance: float = DEFAULT_TOLERANCE
) -> Contender:
    """The structured solver on NumPy and SciPy alone."""
    return ours("NumPy/SciPy", lambda: StructuredSolver(False), scenario, weight, tolerance)


def osqp(scenario: Scenario) -> Contender:
    """OSQP, its matrices updated in place."""
    return ours("OSQP in place", lambda: make_solver("osqp"), scenario)


def cvxpy(scenario: Scenario) -> Contender:
    """cvxpy and Clarabel, the sub-problem written out each time: the convex-modelling way."""
    from slipcar.planner.backends.cvxpy import CvxpySolver

    solver = CvxpySolver().solver
    if solver != "CLARABEL":
        raise UnavailableError(f"cvxpy would use {solver}: Clarabel is not installed")
    return ours("cvxpy + Clarabel SCP", lambda: make_solver("cvxpy"), scenario)


def makers(scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    """All of them on one scenario, by name."""
    return {
        "slipcar, numba": lambda: numba(scenario),
        "slipcar, numba, fine": lambda: numba(scenario, tolerance=FINE_TOLERANCE),
        "slipcar, numba, w = 1": lambda: numba(scenario, 1.0),
        "slipcar, NumPy/SciPy": lambda: numpy(scenario),
        "slipcar, NumPy/SciPy, fine": lambda: numpy(scenario, tolerance=FINE_TOLERANCE),
        "slipcar, NumPy/SciPy, w = 1": lambda: numpy(scenario, 1.0),
        "slipcar, OSQP in place": lambda: osqp(scenario),
        "slipcar, cvxpy + Clarabel SCP": lambda: cvxpy(scenario),
    }


def ours(
    backend: str,
    make: Callable[[], Solver],
    scenario: Scenario,
    weight: float = 0.0,
    tolerance: float = DEFAULT_TOLERANCE,
) -> Contender:
    """`plan` with the solver that `make` gives, as a contender."""
    make()  # what is not installed is noticed here
    return Contender(
        name=f"slipcar, {backend}, w = {weight:g}",
        tolerance=f"step {tolerance:.0e}",
        solve=stopwatch(
            lambda: plan(scenario, solver=make(), variance_weight=weight, tolerance=tolerance),
            _answer,
        ),
        solves=EXACT if weight == 0.0 else f"with {weight:g} ∫ tr Σ dt in the cost",
    )


def _answer(found: Plan) -> Answer:
    return Answer(found.controls, found.iterations, found.status is Status.CONVERGED)

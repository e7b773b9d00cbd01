"""slipcar's own planners as contenders, called as a user calls them: one `plan` each time.

Guess, iterations and the `Plan` itself are in the time. The planner remembers the problems it met
last, checked and traced, as the other rows keep the programme they have built; a row of its own
plans for one that it has not met, each time.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from typing import Any

from contenders import EXACT, Answer, Contender, UnavailableError, stopwatch

from slipcar.envs import Scenario
from slipcar.planner import Plan, Status, plan
from slipcar.planner.convex.solvers.registry import make_solver

#: `plan`'s default, and one for answers as exact as those of the whole-problem solvers.
DEFAULT_TOLERANCE, FINE_TOLERANCE = 1e-3, 1e-6


def numba(
    scenario: Scenario, weight: float = 0.0, tolerance: float = DEFAULT_TOLERANCE
) -> Contender:
    """The default: Newton's method, compiled with the dynamics."""
    importlib.import_module("numba")  # its absence is noticed here
    return planner("slipcar, numba", scenario, weight, tolerance, compiled=True)


def numpy(
    scenario: Scenario, weight: float = 0.0, tolerance: float = DEFAULT_TOLERANCE
) -> Contender:
    """The same steps on NumPy and SciPy alone."""
    return planner("slipcar, NumPy/SciPy", scenario, weight, tolerance, compiled=False)


def unseen(scenario: Scenario) -> Contender:
    """The default for an equal scenario that the planner has never met, each time."""
    importlib.import_module("numba")
    text = scenario.to_json()

    def solve() -> tuple[float, Answer]:
        fresh = Scenario.from_json(text)
        return stopwatch(lambda: plan(fresh, variance_weight=0.0, compiled=True), _answer)()

    seen = numba(scenario)
    return dataclasses.replace(
        seen, name="slipcar, numba, a new scenario each time, w = 0", solve=solve
    )


def convex(
    scenario: Scenario, weight: float = 0.0, tolerance: float = DEFAULT_TOLERANCE
) -> Contender:
    """The paper's scheme, exact convex sub-problems, by the structured solver."""
    return planner("slipcar, convex scheme", scenario, weight, tolerance, method="convex")


def osqp(scenario: Scenario) -> Contender:
    """The paper's scheme by OSQP, its matrices updated in place."""
    make_solver("osqp")  # its absence is noticed here
    return planner(
        "slipcar, convex scheme, OSQP in place", scenario, method="convex", solver="osqp"
    )


def cvxpy(scenario: Scenario) -> Contender:
    """The paper's scheme by cvxpy and Clarabel, each sub-problem written out anew."""
    from slipcar.planner.convex.solvers.cvxpy import CvxpySolver

    solver = CvxpySolver().solver
    if solver != "CLARABEL":
        raise UnavailableError(f"cvxpy would use {solver}: Clarabel is not installed")
    name = "slipcar, convex scheme, cvxpy + Clarabel"
    return planner(name, scenario, method="convex", solver="cvxpy")


def makers(scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    """All of them on one scenario, by name."""
    return {
        "slipcar, numba": lambda: numba(scenario),
        "slipcar, numba, fine": lambda: numba(scenario, tolerance=FINE_TOLERANCE),
        "slipcar, numba, w = 1": lambda: numba(scenario, 1.0),
        "slipcar, numba, new scenario": lambda: unseen(scenario),
        "slipcar, NumPy/SciPy": lambda: numpy(scenario),
        "slipcar, NumPy/SciPy, fine": lambda: numpy(scenario, tolerance=FINE_TOLERANCE),
        "slipcar, NumPy/SciPy, w = 1": lambda: numpy(scenario, 1.0),
        "slipcar, convex scheme": lambda: convex(scenario),
        "slipcar, convex scheme, w = 1": lambda: convex(scenario, 1.0),
        "slipcar, OSQP in place": lambda: osqp(scenario),
        "slipcar, cvxpy + Clarabel": lambda: cvxpy(scenario),
    }


def planner(
    name: str,
    scenario: Scenario,
    weight: float = 0.0,
    tolerance: float = DEFAULT_TOLERANCE,
    **options: Any,
) -> Contender:
    """`plan` with these options, as a contender."""
    options |= {"variance_weight": weight, "tolerance": tolerance}
    return Contender(
        name=f"{name}, w = {weight:g}",
        tolerance=f"step {tolerance:.0e}",
        solve=stopwatch(lambda: plan(scenario, **options), _answer),
        solves=EXACT if weight == 0.0 else f"with {weight:g} ∫ tr Σ dt in the cost",
    )


def _answer(found: Plan) -> Answer:
    return Answer(found.controls, found.iterations, found.status is Status.CONVERGED)

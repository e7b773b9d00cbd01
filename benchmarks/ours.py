"""slipcar's own planners as contenders, called as a user calls them: one `plan` each time.

Guess, iterations and the `Plan` itself are in the time. A problem that the planner has met is
remembered, its numbers checked, as the other rows keep the programme they have built; rows of their
own plan for one that it has not met, each time.
"""

from __future__ import annotations

import dataclasses
import importlib
import itertools
from collections.abc import Callable
from typing import Any

from contenders import EXACT, Answer, Contender, UnavailableError, stopwatch
from own_problems import OwnCar

from slipcar.envs import Scenario
from slipcar.planner import Plan, Status, plan
from slipcar.planner.convex.solvers.registry import make_solver

#: `plan`'s default, and one for answers as exact as those of the whole-problem solvers.
DEFAULT_TOLERANCE, FINE_TOLERANCE = 1e-4, 1e-8
#: Names of rows that plan for a problem never met before, each time, and what some of them solve.
UNMET = ("slipcar, a new", "slipcar, another", "slipcar, plan_batch of new")
RANDOM_WORLDS = "random worlds"
#: Seeds of the random worlds: beyond those of all other benchmarks.
FIRST_SEED = 1_000_000


def compiled(
    scenario: Scenario, weight: float = 0.0, tolerance: float = DEFAULT_TOLERANCE
) -> Contender:
    """The default: Newton's method as machine code."""
    importlib.import_module("llvmlite")  # its absence is noticed here
    return planner("slipcar", scenario, weight, tolerance, compiled=True)


def numpy(
    scenario: Scenario, weight: float = 0.0, tolerance: float = DEFAULT_TOLERANCE
) -> Contender:
    """The same steps in NumPy."""
    return planner("slipcar, NumPy", scenario, weight, tolerance, compiled=False)


def unseen(scenario: Scenario) -> Contender:
    """The default for an equal scenario that the planner has never met, each time."""
    text = scenario.to_json()
    return _of_unmet(
        scenario, "slipcar, a new scenario each time, w = 0", lambda: Scenario.from_json(text)
    )


def own_class(scenario: Scenario) -> Contender:
    """The same problem, as another object of a user's plain class each time."""
    name = "slipcar, another object of an own class each time, w = 0"
    return _of_unmet(scenario, name, lambda: OwnCar(scenario))


def random_worlds(scenario: Scenario) -> Contender:
    """Another random world each time, of one to eight obstacles; `plan`'s own options."""
    for obstacles in range(1, 9):  # each kind once: what is compiled is in the cold starts
        plan(Scenario.random(FIRST_SEED, obstacles))
    seeds, converged = itertools.count(FIRST_SEED + 1), [True]

    def answer(found: Plan) -> Answer:
        converged.append(found.status is Status.CONVERGED)
        return Answer(found.controls, found.iterations, all(converged))

    def solve() -> tuple[float, Answer]:
        world = Scenario.random(next(seeds))
        return stopwatch(lambda: plan(world), answer)()

    return dataclasses.replace(
        compiled(scenario, 1.0),
        name="slipcar, a new random world each time, w = 1",
        solve=solve,
        solves=RANDOM_WORLDS,
    )


def _of_unmet(scenario: Scenario, name: str, make: Callable[[], Any]) -> Contender:
    """The default for a problem made anew before each call."""

    def solve() -> tuple[float, Answer]:
        fresh = make()
        return stopwatch(lambda: plan(fresh, variance_weight=0.0, compiled=True), _answer)()

    return dataclasses.replace(compiled(scenario), name=name, solve=solve)


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
        "slipcar": lambda: compiled(scenario),
        "slipcar, fine": lambda: compiled(scenario, tolerance=FINE_TOLERANCE),
        "slipcar, w = 1": lambda: compiled(scenario, 1.0),
        "slipcar, new scenario": lambda: unseen(scenario),
        "slipcar, own class": lambda: own_class(scenario),
        "slipcar, random worlds": lambda: random_worlds(scenario),
        "slipcar, NumPy": lambda: numpy(scenario),
        "slipcar, NumPy, fine": lambda: numpy(scenario, tolerance=FINE_TOLERANCE),
        "slipcar, NumPy, w = 1": lambda: numpy(scenario, 1.0),
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
        tolerance=f"residual² {tolerance:.0e}",
        solve=stopwatch(lambda: plan(scenario, **options), _answer),
        solves=EXACT if weight == 0.0 else f"with {weight:g} ∫ tr Σ dt in the cost",
    )


def _answer(found: Plan) -> Answer:
    return Answer(found.controls, found.iterations, found.status is Status.CONVERGED)

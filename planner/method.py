"""One guess, one outcome: which iteration runs, and what follows where it fails.

* `newton` (:mod:`.newton`): one LQ problem per iteration, Newton's method at the end; compiled
  where numba is installed and the problem's functions can be traced. The default.
* `convex` (:mod:`.scp`): the paper's scheme, exact convex sub-problems by any backend under a
  trust region. It takes over what the first cannot pose (balls of controls, a terminal box, other
  backends and trust regions), and where it does not converge: it is the one that can tell a
  terminal condition that is out of reach.
"""

from __future__ import annotations

import dataclasses
import functools
from types import ModuleType

import numpy as np

from slipcar.planner import scp
from slipcar.planner.backends import Solver, make_solver
from slipcar.planner.history import Iteration
from slipcar.planner.newton import loop
from slipcar.planner.newton.functions import Functions, functions_of
from slipcar.planner.newton.settings import TUNING
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem import Model
from slipcar.planner.status import Status
from slipcar.planner.trust_region import TRUST_REGIONS

Array = np.ndarray


def solve(model: Model, options: Options, x: Array, u: Array, *, free_first: bool) -> Outcome:
    """Plan from one guess, states (N, n) and controls (K, m); penalties left out first or not.

    Raises:
        ValueError: if a function of the problem is not finite along the guess.
    """
    if not uses_newton(model, options):
        return _convex(model, options, x, u, free_first)
    functions = compiled_functions(model, options, x, u)
    if functions is not None:
        fast = driver()
        assert fast is not None
        first = fast.solve_one(model, functions, options, x, u, free_first=free_first)
    else:
        functions = functions_of(model, x, u, native=False)
        first = loop.iterate(model, functions, options, x, u, free_first=free_first)
    return second_chance(model, options, x, u, first)


def uses_newton(model: Model, options: Options) -> bool:
    """Whether Newton's method is asked for, or nothing speaks against it.

    Raises:
        ValueError: if it is asked for and cannot pose the problem.
    """
    if options.method == "newton" and model.radius < np.inf:
        raise ValueError("method='newton' knows no control_radius: leave method out")
    return options.method != "convex" and not options.only_convex and model.radius == np.inf


def second_chance(model: Model, options: Options, x: Array, u: Array, first: Outcome) -> Outcome:
    """What the convex iteration makes of a guess that Newton's method failed at."""
    left = options.max_iterations - first.iterations
    if first.status in (Status.CONVERGED, Status.STOPPED) or left <= 0:
        return first
    second = _convex(model, dataclasses.replace(options, max_iterations=left), x, u, False)
    say = f"Newton's method ended {first.status} after {first.iterations} iterations"
    history = (*first.history, *second.history)
    iterations = first.iterations + second.iterations
    return dataclasses.replace(second, iterations=iterations, history=history).said(say)


@functools.cache
def driver() -> ModuleType | None:
    """The compiled iteration, if numba is installed."""
    try:
        from slipcar.planner.newton import run
    except ImportError:
        return None
    return run


def compiled_functions(model: Model, options: Options, x: Array, u: Array) -> Functions | None:
    """Functions for the compiled iteration; None where it cannot, or shall not, run.

    Raises:
        ImportError: if it is asked for and numba is missing.
        ValueError: if it is asked for and the problem's functions cannot be traced.
    """
    if options.compiled is False or options.callback is not None:
        return None
    if driver() is None:
        if options.compiled:
            raise ImportError('compiled=True needs numba: pip install "slipcar[fast]"')
        return None
    functions = functions_of(model, x, u, native=True)
    if functions.kernels is None and options.compiled:
        raise ValueError(
            f"compiled=True, but the functions of {type(model.problem).__name__} cannot be "
            f"compiled: {functions.reason}"
        )
    return functions if functions.kernels else None


def _convex(model: Model, options: Options, x: Array, u: Array, free_first: bool) -> Outcome:
    given = options.solver
    trust = TRUST_REGIONS[options.trust_region or "adaptive"]
    before: tuple[Iteration, ...] = ()
    if free_first and model.weight.any():
        free = dataclasses.replace(model, weight=np.zeros_like(model.weight))
        few = min(TUNING.released_steps, options.max_iterations)
        hasty = dataclasses.replace(options, max_iterations=few, callback=_short_step)
        found = scp.iterate(free, _solver(given), trust(), hasty, x, u)
        x, u, before = found.x, found.u, tuple(found.history)
        left = max(1, options.max_iterations - len(before))
        options = dataclasses.replace(options, max_iterations=left)
    found = scp.iterate(model, _solver(given), trust(), options, x, u)
    history = (*before, *found.history)
    return dataclasses.replace(found, iterations=len(history), history=history)


def _solver(given: str | Solver) -> Solver:
    return make_solver(given) if isinstance(given, str) else given


def _short_step(iteration: Iteration) -> bool:
    return iteration.step <= TUNING.released * iteration.effort

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

from slipcar.planner.convex import scp
from slipcar.planner.convex.solvers import Solver, make_solver
from slipcar.planner.convex.trust_region import TRUST_REGIONS
from slipcar.planner.history import Iteration
from slipcar.planner.newton import loop
from slipcar.planner.newton.functions import Functions, functions_of
from slipcar.planner.newton.settings import TUNING
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.feasibility import FEASIBILITY, inconsistency
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import Model
from slipcar.planner.status import Status

Array = np.ndarray

#: Known kernels, new ones, and the problem's own functions, which are never stale.
_TRACES = 3
#: Newton's method has so many iterations to itself, and this part of those beyond; the rest is
#: for the convex one. (On 1500 random worlds it took 65 at most; where it takes more, it goes
#: round in circles, as a rule because the end cannot be reached, and only the other can tell.)
_OWN, _SHARED = 60, 0.25


def solve(model: Model, options: Options, x: Array, u: Array, *, free_first: bool) -> Outcome:
    """Plan from one guess, states (N, n) and controls (K, m); penalties left out first or not.

    Raises:
        ValueError: if a function of the problem is not finite along the guess.
    """
    if not uses_newton(model, options):
        return _convex(model, options, x, u, free_first)
    functions = compiled_functions(model, options, x, u)
    native = functions is not None
    functions = functions or functions_of(model, x, u, native=False)
    limited = newton_options(options)
    for _ in range(_TRACES):
        fast = driver() if native else None
        iterate = loop.iterate if fast is None else fast.solve_one
        first = iterate(model, functions, limited, x, u, free_first=free_first)
        if is_faithful(model, functions, first, native=native):
            break
        # The trace was right along the guess only: the problem changed since, elsewhere.
        functions = functions_of(model, first.x, first.u, native=native)
        native = native and functions.kernels is not None
    return second_chance(model, options, x, u, first)


def is_faithful(model: Model, functions: Functions, found: Outcome, *, native: bool) -> bool:
    """Whether traced functions agree with the problem's own near the answer too."""
    there = functions_of(model, found.x, found.u, native=native)
    return functions.kernels is None or there.kernels is functions.kernels


def uses_newton(model: Model, options: Options) -> bool:
    """Whether Newton's method is asked for, or nothing speaks against it.

    Raises:
        ValueError: if it is asked for and cannot pose the problem.
    """
    if options.method == "newton" and model.radius < np.inf:
        raise ValueError("method='newton' knows no control_radius: leave method out")
    if options.compiled and model.radius < np.inf:
        raise ValueError("compiled=True is of Newton's method, which knows no control_radius")
    return options.method != "convex" and not options.only_convex and model.radius == np.inf


def newton_options(options: Options) -> Options:
    """The options, with fewer iterations where some are left to :func:`second_chance`."""
    own = min(options.max_iterations, _OWN)
    limit = own + int(_SHARED * (options.max_iterations - own))
    return dataclasses.replace(options, max_iterations=limit)


def second_chance(model: Model, options: Options, x: Array, u: Array, first: Outcome) -> Outcome:
    """What the convex iteration makes of a guess that Newton's method failed at."""
    left = options.max_iterations - first.iterations
    if first.status in (Status.CONVERGED, Status.STOPPED):
        return first
    if left <= 0:
        return _explained(model, options, first)
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
        stopped = False

        def settled(iteration: Iteration) -> bool:
            nonlocal stopped
            stopped = bool(options.callback is not None and options.callback(iteration))
            return stopped or iteration.step <= TUNING.released * iteration.effort

        hasty = dataclasses.replace(options, max_iterations=few, callback=settled)
        found = scp.iterate(free, _solver(given), trust(), hasty, x, u)
        if stopped:
            penalty = linearize(model, found.x, found.u).penalty  # which it did without
            objective = found.objective + penalty
            return dataclasses.replace(
                found, status=Status.STOPPED, penalty=penalty, objective=objective
            )
        x, u, before = found.x, found.u, tuple(found.history)
        left = max(1, options.max_iterations - len(before))
        options = dataclasses.replace(options, max_iterations=left)
    found = scp.iterate(model, _solver(given), trust(), options, x, u)
    history = (*before, *found.history)
    found = dataclasses.replace(found, iterations=len(history), history=history)
    return _explained(model, options, found)


def _explained(model: Model, options: Options, found: Outcome) -> Outcome:
    """With words on what a converged plan has and this one has not, if it says nothing itself."""
    if found.status in (Status.CONVERGED, Status.STOPPED) or found.message:
        return found
    at = linearize(model, found.x, found.u)
    allowed = FEASIBILITY * (1.0 + float(np.abs(found.x).max())) + options.terminal_tolerance
    order = np.argsort(-np.abs(at.g))
    far = [f"g[{j}] = {at.g[j]:.4g}" for j in order if abs(at.g[j]) > allowed]
    if far:
        return found.said(f"the terminal condition is not met: {', '.join(far)}")
    off = inconsistency(at, np.inf)
    return found.said(f"steps are not short yet; the mean is {off:.2g} off the controls' path")


def _solver(given: str | Solver) -> Solver:
    return make_solver(given) if isinstance(given, str) else given

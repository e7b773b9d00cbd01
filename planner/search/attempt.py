"""One guess, one outcome: which iteration runs, and what follows where it fails.

* `newton` (:mod:`slipcar.planner.newton`): one LQ problem per iteration, Newton's method at the
  end. The default.
* `convex` (:mod:`slipcar.planner.convex`): the paper's scheme, exact convex sub-problems by any
  backend under a trust region. It takes over what the first cannot pose (balls of controls, a
  terminal box, other backends and trust regions), and where it does not converge: it is the one
  that can tell a terminal condition that is out of reach.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.convex import iteration
from slipcar.planner.convex.solvers.interface import Solver
from slipcar.planner.convex.solvers.registry import make_solver
from slipcar.planner.convex.trust_region import TRUST_REGIONS
from slipcar.planner.history import Iteration
from slipcar.planner.newton.posing import Posed
from slipcar.planner.newton.running import solve_mean
from slipcar.planner.newton.tuning import MEAN
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.feasibility import FEASIBILITY, inconsistency
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import Model
from slipcar.planner.status import Status

Array = np.ndarray

#: Newton's method has so many iterations to itself, and this part of those beyond; the rest is
#: for the convex one. (On 1500 random worlds it took 65 at most; where it takes more, it goes
#: round in circles, as a rule because the end cannot be reached, and only the other can tell.)
_OWN, _SHARED = 60, 0.25


def attempt(
    model: Model,
    posed: Posed | None,
    options: Options,
    x: Array,
    u: Array,
    *,
    free_first: bool,
    history: bool = True,
) -> Outcome:
    """Plan from one guess.

    Args:
        model: the problem.
        posed: the same for Newton's method; None runs the convex scheme.
        options: of the iteration.
        x: states, (N, n).
        u: controls, (K, m).
        free_first: leave the penalties out at first.
        history: keep every step.

    Raises:
        ValueError: if a function of the problem is not finite along the guess.
    """
    if posed is None:
        return _convex(model, options, x, u, free_first)
    if posed.model is not model:
        posed = posed.of(model)
    limited = _newton_options(options)
    outcome = solve_mean(posed, limited, x, u, free_first=free_first, history=history)
    if outcome.status in (Status.CONVERGED, Status.STOPPED):
        return outcome
    return _second_chance(model, options, x, u, outcome)


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


def _newton_options(options: Options) -> Options:
    """The options, with fewer iterations where some are left to the convex scheme."""
    if options.max_iterations <= _OWN:
        return options
    limit = _OWN + int(_SHARED * (options.max_iterations - _OWN))
    return options.with_iterations(limit)


def _second_chance(model: Model, options: Options, x: Array, u: Array, newton: Outcome) -> Outcome:
    """What the convex iteration makes of a guess that Newton's method failed at."""
    left = options.max_iterations - newton.iterations
    if left <= 0:
        return _explained(model, options, newton)
    convex = _convex(model, options.with_iterations(left), x, u, False)
    say = f"Newton's method ended {newton.status} after {newton.iterations} iterations"
    history = (*newton.history, *convex.history)
    iterations = newton.iterations + convex.iterations
    return dataclasses.replace(convex, iterations=iterations, history=history).said(say)


def _convex(model: Model, options: Options, x: Array, u: Array, free_first: bool) -> Outcome:
    before: tuple[Iteration, ...] = ()
    if free_first and model.weight.any():
        free = _without_penalties(model, options, x, u)
        if free.status is Status.STOPPED:
            penalty = linearize(model, free.x, free.u).penalty  # which it did without
            return dataclasses.replace(free, penalty=penalty, objective=free.objective + penalty)
        x, u, before = free.x, free.u, tuple(free.history)
        options = options.with_iterations(max(1, options.max_iterations - len(before)))
    trust = TRUST_REGIONS[options.trust_region or "adaptive"]()
    outcome = iteration.iterate(model, _solver(options.solver), trust, options, x, u)
    history = (*before, *outcome.history)
    outcome = dataclasses.replace(outcome, iterations=len(history), history=history)
    return _explained(model, options, outcome)


def _without_penalties(model: Model, options: Options, x: Array, u: Array) -> Outcome:
    """A few steps as if penalties weighed nothing; STOPPED if the callback says so."""
    stopped = False

    def settled(step: Iteration) -> bool:
        nonlocal stopped
        stopped = bool(options.callback is not None and options.callback(step))
        return stopped or step.step <= MEAN.released * step.effort

    free = dataclasses.replace(model, weight=np.zeros_like(model.weight))
    few = min(MEAN.released_steps, options.max_iterations)
    hasty = dataclasses.replace(options, max_iterations=few, callback=settled)
    trust = TRUST_REGIONS[options.trust_region or "adaptive"]()
    outcome = iteration.iterate(free, _solver(options.solver), trust, hasty, x, u)
    status = Status.STOPPED if stopped else Status.MAX_ITERATIONS
    return dataclasses.replace(outcome, status=status)


def _explained(model: Model, options: Options, outcome: Outcome) -> Outcome:
    """With words on what a converged plan has and this one has not, if it says nothing itself."""
    if outcome.status in (Status.CONVERGED, Status.STOPPED) or outcome.message:
        return outcome
    at = linearize(model, outcome.x, outcome.u)
    allowed = FEASIBILITY * (1.0 + float(np.abs(outcome.x).max())) + options.terminal_tolerance
    order = np.argsort(-np.abs(at.g))
    far = [f"g[{j}] = {at.g[j]:.4g}" for j in order if abs(at.g[j]) > allowed]
    if far:
        return outcome.said(f"the terminal condition is not met: {', '.join(far)}")
    off = inconsistency(at, np.inf)
    return outcome.said(f"steps are not short yet; the mean is {off:.2g} off the controls' path")


def _solver(given: str | Solver) -> Solver:
    return make_solver(given) if isinstance(given, str) else given

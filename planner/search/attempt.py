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
from slipcar.planner.convex.solvers.registry import make_solver
from slipcar.planner.convex.trust_region import TRUST_REGIONS
from slipcar.planner.newton.posing import Posed, check_assumptions, pose
from slipcar.planner.newton.running import solve_mean
from slipcar.planner.newton.tuning import MEAN
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem import checks
from slipcar.planner.problem.feasibility import FEASIBILITY, inconsistency
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import Model, model_of
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.records import Iteration
from slipcar.planner.status import Status

Array = np.ndarray

#: Newton's method has so many iterations to itself, and this part of those beyond; the rest is
#: for the convex one. (On 1500 random worlds it took 65 at most; where it takes more, it goes
#: round in circles, as a rule because the end cannot be reached, and only the other can tell.)
_OWN, _SHARED = 60, 0.8


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """A problem and where to start."""

    model: Model
    posed: Posed | None  #: the same for Newton's method; None runs the convex scheme
    x: Array  #: guess, (N, n)
    u: Array  #: guess, (K, m)
    free_first: bool = False  #: whether to leave penalties out at first
    label: str = ""  #: for people


def completed(problem: Problem, options: Options) -> Model:
    """The problem, checked, with the integrator asked for."""
    model = model_of(problem)
    if options.integrator == model.integrator:
        return model
    return dataclasses.replace(model, integrator=options.integrator)


def posed_for(model: Model, options: Options, x: Array, u: Array, *, charged: bool) -> Posed | None:
    """The problem for Newton's method, or None for the convex one; assumptions hold near x, u.

    Raises:
        ValueError: for an assumption that does not, or if Newton's method is asked for and cannot
            pose the problem.
    """
    ball = model.radius < np.inf
    if ball and options.method == "newton":
        raise ValueError("method='newton' knows no control_radius: leave method out")
    if ball and options.compiled:
        raise ValueError("compiled=True is of Newton's method, which knows no control_radius")
    if ball or options.convex:
        checks.check(model, x, u, None, charged=charged)
        return None
    posed = pose(model, compiled=options.compiled)
    check_assumptions(posed, x, u, charged=charged)
    return posed


def attempt(task: Task, options: Options, *, history: bool = True) -> Outcome:
    """Plan from one guess; `history` keeps every step.

    Raises:
        ValueError: if a function of the problem is not finite along the guess.
    """
    if task.posed is None:
        return _convex(task, options)
    posed = task.posed if task.posed.model is task.model else task.posed.of(task.model)
    limit = options.max_iterations
    if limit > _OWN:
        limit = _OWN + int(_SHARED * (limit - _OWN))
    outcome = solve_mean(
        posed, options.with_iterations(limit), task.x, task.u, free_first=task.free_first,
        history=history,
    )  # fmt: skip
    if outcome.status in (Status.CONVERGED, Status.STOPPED):
        return outcome
    left = options.max_iterations - outcome.iterations
    if left <= 0:
        return _explained(task.model, options, outcome)
    second = dataclasses.replace(task, free_first=False)
    convex = _convex(second, options.with_iterations(left))
    return dataclasses.replace(
        convex,
        iterations=outcome.iterations + convex.iterations,
        history=(*outcome.history, *convex.history),
    ).said(f"Newton's method ended {outcome.status} after {outcome.iterations} iterations")


def _convex(task: Task, options: Options) -> Outcome:
    model, x, u = task.model, task.x, task.u
    before: tuple[Iteration, ...] = ()
    if task.free_first and model.weight.any():
        free = _without_penalties(model, options, x, u)
        if free.status is Status.STOPPED:
            penalty = linearize(model, free.x, free.u).penalty  # which it did without
            return dataclasses.replace(free, penalty=penalty, objective=free.objective + penalty)
        x, u, before = free.x, free.u, tuple(free.history)
        options = options.with_iterations(max(1, options.max_iterations - len(before)))
    outcome = _iterate(model, options, x, u)
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
    outcome = _iterate(free, hasty, x, u)
    status = Status.STOPPED if stopped else Status.MAX_ITERATIONS
    return dataclasses.replace(outcome, status=status)


def _iterate(model: Model, options: Options, x: Array, u: Array) -> Outcome:
    solver = make_solver(options.solver) if isinstance(options.solver, str) else options.solver
    trust = TRUST_REGIONS[options.trust_region or "adaptive"]()
    return iteration.iterate(model, solver, trust, options, x, u)


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

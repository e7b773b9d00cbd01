"""One guess, one outcome: which iteration runs, and what follows where it fails.

* `newton` (:mod:`slipcar.planner.newton`): one LQ problem per iteration, Newton's method at the
  end. The default. Its first steps are bold; where they lead nowhere, it goes from the guess once
  more, every step judged.
* `convex` (:mod:`slipcar.planner.convex`): the paper's scheme, exact convex sub-problems by any
  backend under a trust region. It takes over what the first cannot pose (balls of controls, a
  terminal box, other backends and trust regions), and where the end is not met: it is the one
  that can tell a terminal condition that is out of reach.

The best of what they end with is the outcome; CONVERGED is certified by the maximum principle.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from slipcar.planner.convex import iteration
from slipcar.planner.convex.solvers.registry import make_solver
from slipcar.planner.convex.trust_region import TRUST_REGIONS, AdaptiveTrustRegion
from slipcar.planner.extremal.certificate import violations
from slipcar.planner.newton.posing import Posed, check_assumptions, pose
from slipcar.planner.newton.running import solve_mean
from slipcar.planner.newton.tuning import JUDGED, MEAN
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem import checks
from slipcar.planner.problem.feasibility import inconsistency, lacks, not_finite, what_lacks
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import Model, model_of
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.records import Iteration
from slipcar.planner.status import Status

Array = np.ndarray

#: Newton's method has so many iterations to itself, and this part of those beyond; each way that
#: follows has this part of what is left.
_OWN, _SHARED = 60, 0.4
#: The convex scheme stops on its steps: times that it goes on with smaller ones, each a hundredth,
#: until the maximum principle holds.
_REFINED = 3
#: Nearly feasible, relative to how far the states move.
_NEARLY = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """A problem and where to start."""

    model: Model
    posed: Posed | None  #: the same for Newton's method; None runs the convex scheme
    x: Array  #: guess, (N, n)
    u: Array  #: guess, (K, m)
    free_first: bool = False  #: whether to leave penalties out at first
    label: str = ""  #: for people
    judged: bool = False  #: whether steps are judged from the first


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
    limit = options.max_iterations
    if limit > _OWN:
        limit = _OWN + int(_SHARED * (limit - _OWN))
    ended: list[Outcome] = []
    for judged in (True,) if task.judged else (False, True):
        outcome = _newton(task, options.with_iterations(limit), judged=judged, history=history)
        if outcome.answered:  # what explodes may have lost the digits that would prove it
            outcome = _certified(task, options, outcome)
        if outcome.status in (Status.CONVERGED, Status.STOPPED):
            return _joined([*ended, outcome])
        ended.append(outcome)
        left = options.max_iterations - sum(each.iterations for each in ended)
        limit = int(_SHARED * left)
        if limit <= 0:
            break
    best = _best(task.model, options, ended)
    if left > 0 and not _feasible(task.model, options, best):
        second = dataclasses.replace(task, x=best.x, u=best.u, free_first=False, judged=True)
        ended.append(_convex(second, options.with_iterations(left)))
        if ended[-1].status in (Status.CONVERGED, Status.STOPPED, Status.INFEASIBLE):
            return _joined(ended)
    best = _explained(task.model, options, _best(task.model, options, ended))
    return _joined([*ended, best], count=len(ended))


def _newton(task: Task, options: Options, *, judged: bool, history: bool) -> Outcome:
    assert task.posed is not None
    posed = task.posed if task.posed.model is task.model else task.posed.of(task.model)
    return solve_mean(
        posed, options, task.x, task.u, free_first=task.free_first and not judged,
        tuning=JUDGED if judged else MEAN, history=history,
    )  # fmt: skip


def _joined(ended: list[Outcome], count: int | None = None) -> Outcome:
    """The last of several outcomes, with the iterations and the history of the first `count`."""
    tried = ended[:count]
    if len(tried) == 1:
        return ended[-1]
    ways = [f"{each.status} after {each.iterations} iterations" for each in tried[:-1]]
    history = tuple(step for each in tried for step in each.history)
    iterations = sum(each.iterations for each in tried)
    joined = dataclasses.replace(ended[-1], iterations=iterations, history=history)
    return joined.said(f"Newton's method ended {', then '.join(ways)}")


def _off(model: Model, options: Options, outcome: Outcome) -> float:
    """How far an outcome is from feasible, relative to how far its states move."""
    at = linearize(model, outcome.x, outcome.u)
    off = max(inconsistency(at), float(lacks(at, options.terminal_tolerance).max(initial=0.0)))
    return off if np.isfinite(off) and np.isfinite(outcome.objective) else np.inf


def _feasible(model: Model, options: Options, outcome: Outcome) -> bool:
    return _off(model, options, outcome) <= _NEARLY


def _best(model: Model, options: Options, ended: list[Outcome]) -> Outcome:
    """Of outcomes that did not converge, the cheapest that is nearly feasible, or the nearest."""

    def rank(outcome: Outcome) -> tuple[float, float]:
        off = _off(model, options, outcome)
        return (0.0, outcome.objective) if off <= _NEARLY else (off, 0.0)

    return min(ended, key=rank)


def _convex(task: Task, options: Options) -> Outcome:
    """The convex scheme, with smaller steps until the maximum principle holds."""
    outcome = _convex_once(task, options)
    for power in range(1, _REFINED + 1):
        proven = _certified(task, options, outcome)
        left = options.max_iterations - outcome.iterations
        if proven.status is outcome.status or left <= 0:
            return _explained(task.model, options, proven)
        smaller = dataclasses.replace(
            options, tolerance=options.tolerance * 1e-2**power, max_iterations=left
        )
        onwards = dataclasses.replace(task, x=outcome.x, u=outcome.u, free_first=False)
        again = _convex_once(onwards, smaller)
        history = (*outcome.history, *again.history)
        outcome = dataclasses.replace(again, iterations=len(history), history=history)
    return _explained(task.model, options, _certified(task, options, outcome))


def _certified(task: Task, options: Options, outcome: Outcome) -> Outcome:
    """A converged outcome with the adjoint that proves it; STALLED where none does."""
    if outcome.status is not Status.CONVERGED:
        return outcome
    off = violations(
        task.model, outcome.x, outcome.u, outcome.terminal,
        variance_weight=options.variance_weight, terminal_tolerance=options.terminal_tolerance,
    )  # fmt: skip
    if off.maximality <= math.sqrt(options.tolerance):
        return dataclasses.replace(outcome, adjoint=off.adjoint)
    stalled = dataclasses.replace(outcome, status=Status.STALLED)
    return stalled.said(
        f"steps are short, but the maximum principle holds to {off.maximality:.2g} only, not "
        f"{math.sqrt(options.tolerance):.2g}"
    )


def _convex_once(task: Task, options: Options) -> Outcome:
    model, x, u = task.model, task.x, task.u
    before: tuple[Iteration, ...] = ()
    if task.free_first and model.weight.any():
        free = _without_penalties(model, options, x, u)
        if free.status is Status.STOPPED:
            penalty = linearize(model, free.x, free.u).penalty  # which it did without
            return dataclasses.replace(free, penalty=penalty, objective=free.objective + penalty)
        x, u, before = free.x, free.u, tuple(free.history)
        options = options.with_iterations(max(1, options.max_iterations - len(before)))
    outcome = _iterate(model, options, x, u, judged=task.judged)
    history = (*before, *outcome.history)
    return dataclasses.replace(outcome, iterations=len(history), history=history)


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


def _iterate(
    model: Model, options: Options, x: Array, u: Array, *, judged: bool = False
) -> Outcome:
    solver = make_solver(options.solver) if isinstance(options.solver, str) else options.solver
    trust = TRUST_REGIONS[options.trust_region or "adaptive"]()
    if judged and isinstance(trust, AdaptiveTrustRegion):
        trust = AdaptiveTrustRegion(free=0)
    return iteration.iterate(model, solver, trust, options, x, u)


def _explained(model: Model, options: Options, outcome: Outcome) -> Outcome:
    """With words on what a converged plan has and this one has not, if it says nothing itself."""
    if outcome.status in (Status.CONVERGED, Status.STOPPED) or outcome.message:
        return outcome
    at = linearize(model, outcome.x, outcome.u)
    if not at.finite:
        return outcome.said(not_finite(model, outcome.x, outcome.u, "where the iteration ended"))
    if far := what_lacks(at, options.terminal_tolerance):
        return outcome.said(f"the terminal condition is not met: {far}")
    why = {
        Status.SOLVER_FAILED: "no step could be computed: its equations are singular or overflow",
        Status.STALLED: "no step lowers the merit function any more",
    }.get(outcome.status, "steps are not short yet")
    off = inconsistency(at)
    if off <= _NEARLY:
        return outcome.said(why)
    far = f"{off:.2g} of how far it moves" if np.isfinite(off) else "farther than numbers go"
    return outcome.said(f"{why}; the mean is {far} off the path of the controls")

"""`plan_batch`: many problems, or many starts of one, at once."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from slipcar.planner.newton.posing import Posed, check_assumptions, pose
from slipcar.planner.options import Options, check_count
from slipcar.planner.plan import Plan, plan_of
from slipcar.planner.problem import checks
from slipcar.planner.problem.model import Model, model_of
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.problem.reposed import reposed
from slipcar.planner.search.attempt import uses_newton
from slipcar.planner.search.tasks import Task, naming, solve_tasks
from slipcar.planner.search.warm_start import given_guess

Array = np.ndarray

#: How errors name a problem.
_LABEL = "problem {} of the batch"


def plan_batch(
    problems: Sequence[Problem] | Problem,
    *,
    initial_states: Any = None,
    guesses: Sequence[Any] | None = None,
    workers: int = 0,
    history: bool = False,
    **options: Any,
) -> list[Plan]:
    """Plan many problems at once; each plan is the one that `plan` would give.

    Args:
        problems: a sequence of problems, or one problem with `initial_states`.
        initial_states: states to start one problem from, (P, n).
        guesses: where to begin for each: a `Plan`, (states, controls), or None for its own; a
            guess is trusted, as `plan(..., cold_start="never")` does.
        workers: threads; 0 takes one for each processor. The plans do not depend on it.
        history: keep the trajectories of every iteration, as `plan` does; large.
        **options: `variance_weight`, `method`, `solver`, `tolerance`, `max_iterations`,
            `trust_region`, `linearization`, `terminal_tolerance`, `integrator`, `compiled`,
            `free_first` of :func:`plan`.

    Returns:
        One plan for each, in order. Look at every `status`; `solve_time` is the batch's, shared
        out equally.

    Raises:
        TypeError: if a problem lacks a required member, naming its index in the batch, or for an
            unknown option.
        ValueError: for a wrong option, shape or value, naming its index in the batch.
    """
    began = time.perf_counter()
    free_first = options.pop("free_first", None)
    known = {field.name for field in dataclasses.fields(Options)} - {"callback"}
    if unknown := sorted(set(options) - known):
        raise TypeError(f"plan_batch knows no option {unknown}; it knows {sorted(known)}")
    chosen = Options(**options)
    if workers != 0:
        check_count("workers", workers)
    if guesses is not None and not isinstance(guesses, Sequence):
        raise TypeError(f"guesses must be a sequence, not {type(guesses).__name__}")
    with np.errstate(all="ignore"):
        models, posed = _models(problems, initial_states, chosen)
        if guesses is not None and len(guesses) != len(models):
            raise ValueError(f"guesses must be one for each of {len(models)}, not {len(guesses)}")
        tasks = _tasks(models, guesses, chosen, free_first, one=initial_states is not None)
        outcomes = solve_tasks(tasks, chosen, workers=workers, history=history, label=_LABEL)
    record = {**chosen.as_dict(), "free_first": free_first}
    share = (time.perf_counter() - began) / max(len(tasks), 1)
    return [
        plan_of(outcome, task.model, problem, guess=task.x, options=record, seconds=share)
        for task, problem, outcome in zip(tasks, posed, outcomes, strict=True)
    ]


def _tasks(
    models: list[Model],
    guesses: Sequence[Any] | None,
    options: Options,
    free_first: bool | None,
    *,
    one: bool,
) -> list[Task]:
    """What to solve for each model; `one`: they are one problem from several states."""
    tasks: list[Task] = []
    posed: Posed | None = None
    convex = options.method == "convex" or bool(options.only_convex)
    for i, model in enumerate(models):
        given = None if guesses is None else guesses[i]
        with naming(_LABEL, i):
            x, u = model.guess() if given is None else given_guess(model, given)
            if i == 0 or not one:
                charged = options.variance_weight > 0
                posed = None
                if uses_newton(model, options):
                    posed = pose(model, compiled=options.compiled)
                    check_assumptions(posed, x, u, charged=charged)
                else:
                    checks.check(model, x, u, None, charged=charged)
        own = given is None and not convex if free_first is None else bool(free_first)
        tasks.append(Task(model, posed, x, u, own))
    return tasks


def _models(
    problems: Any, initial_states: Any, options: Options
) -> tuple[list[Model], list[Problem]]:
    """Completed problems, and the problems that their plans belong to, in order."""
    if initial_states is None:
        if not isinstance(problems, Sequence) or isinstance(problems, str):
            raise TypeError(
                f"problems must be a sequence of problems, or one problem with initial_states, "
                f"not {type(problems).__name__}"
            )
        models = []
        for i, problem in enumerate(problems):
            with naming(_LABEL, i):
                models.append(_completed(problem, options))
        return models, list(problems)
    if isinstance(problems, Sequence):
        raise ValueError("initial_states go with one problem, not with a sequence of problems")
    model = _completed(problems, options)
    states = _states(initial_states, model.state_dim)
    posed = [reposed(problems, start=start) for start in states]
    # Their own guesses, but the functions of one model: they are looked at once.
    return [
        model.started(start, getattr(problem, "initial_guess", None))
        for start, problem in zip(states, posed, strict=True)
    ], posed


def _states(given: Any, n: int) -> Array:
    """Initial states, (P, n), checked and read-only."""
    try:
        states = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"initial_states must be numbers, one row for each: {error}") from error
    if states.ndim != 2 or states.shape[1] != n:
        raise ValueError(f"initial_states must have shape (any, {n}), not {states.shape}")
    if not np.isfinite(states).all():
        i = int(np.argwhere(~np.isfinite(states))[0, 0])
        raise ValueError(f"initial_states[{i}] must be finite, not {states[i]}")
    states.setflags(write=False)
    return states


def _completed(problem: Problem, options: Options) -> Model:
    model = model_of(problem)
    if options.integrator != model.integrator:
        model = dataclasses.replace(model, integrator=options.integrator)
    return model

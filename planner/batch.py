"""`plan_batch`: many problems, or many starts of one, at once."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np

from slipcar.planner.newton.posing import Posed
from slipcar.planner.options import BatchOptions, Options, check_count, plain
from slipcar.planner.outcome import Outcome
from slipcar.planner.plan import Plan, plan_of
from slipcar.planner.problem.model import Model
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.problem.reposed import reposed
from slipcar.planner.search.attempt import Task, attempt, completed, posed_for
from slipcar.planner.search.tasks import in_threads, naming
from slipcar.planner.search.warm_start import given_guess

Array = np.ndarray


def plan_batch(
    problems: Sequence[Problem] | Problem,
    *,
    initial_states: Any = None,
    guesses: Sequence[Any] | None = None,
    workers: int = 0,
    history: bool = False,
    **options: Unpack[BatchOptions],
) -> list[Plan]:
    """Plan many problems at once; each plan is the one that `plan` would give.

    Args:
        problems: a sequence of problems, or one problem with `initial_states`.
        initial_states: states to start one problem from, (P, n).
        guesses: where to begin for each: a `Plan`, (states, controls), or None for its own; a
            guess is trusted, as `plan(..., cold_start="never")` does.
        workers: threads; 0 takes one for each processor, or one alone where plans are so short that
            threads would wait for each other. The plans do not depend on it.
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
    given = {name: plain(value) for name, value in options.items()}
    free_first: Any = given.pop("free_first", None)
    known = {field.name for field in dataclasses.fields(Options)} - {"callback"}
    if unknown := sorted(set(given) - known):
        raise TypeError(f"plan_batch knows no option {unknown}; it knows {sorted(known)}")
    chosen = Options(**given)
    if workers != 0:
        check_count("workers", workers)
    if guesses is not None and not isinstance(guesses, Sequence):
        raise TypeError(f"guesses must be a sequence, not {type(guesses).__name__}")
    one = initial_states is not None
    with np.errstate(all="ignore"):
        if one:
            models, posed = _started(problems, initial_states, chosen)
        else:
            models, posed = _completed(problems, chosen)
        if guesses is not None and len(guesses) != len(models):
            raise ValueError(f"guesses must be one for each of {len(models)}, not {len(guesses)}")
        tasks = _tasks(models, guesses or [None] * len(models), chosen, free_first, one=one)

        def solve(task: Task) -> Outcome:
            with naming(task.label):
                return attempt(task, chosen, history=history)

        alone = workers == 0 and all(task.posed is not None and task.posed.brief for task in tasks)
        outcomes = in_threads(solve, tasks, 1 if alone else workers)
    record = {**chosen.as_dict(), "free_first": free_first}
    share = (time.perf_counter() - began) / max(len(tasks), 1)
    return [
        plan_of(outcome, task.model, problem, options=record, guess=task.x, solve_time=share)
        for task, problem, outcome in zip(tasks, posed, outcomes, strict=True)
    ]


def _tasks(
    models: list[Model], guesses: Sequence[Any], options: Options, free_first: Any, *, one: bool
) -> list[Task]:
    """What to solve for each model; `one`: they are one problem from several states."""
    tasks: list[Task] = []
    posed: Posed | None = None
    for i, (model, given) in enumerate(zip(models, guesses, strict=True)):
        with naming(name := f"problem {i} of the batch"):
            x, u = given_guess(model, given)
            if i == 0 or not one:
                charged = options.variance_weight > 0
                posed = posed_for(model, options, x, u, charged=charged)
        own = given is None and not options.convex
        tasks.append(Task(model, posed, x, u, own if free_first is None else free_first, name))
    return tasks


def _completed(problems: Any, options: Options) -> tuple[list[Model], list[Problem]]:
    """Models of several problems, and the problems."""
    if not isinstance(problems, Sequence) or isinstance(problems, str):
        raise TypeError(
            f"problems must be a sequence of problems, or one problem with initial_states, "
            f"not {type(problems).__name__}"
        )
    models = []
    for i, problem in enumerate(problems):
        with naming(f"problem {i} of the batch"):
            models.append(completed(problem, options))
    return models, list(problems)


def _started(problem: Any, given: Any, options: Options) -> tuple[list[Model], list[Problem]]:
    """Models of one problem from several states, and the problems that their plans belong to."""
    if isinstance(problem, Sequence):
        raise ValueError("initial_states go with one problem, not with a sequence of problems")
    model = completed(problem, options)
    try:
        states = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"initial_states must be numbers, one row for each: {error}") from error
    if states.ndim != 2 or states.shape[1] != model.state_dim:
        raise ValueError(
            f"initial_states must have shape (any, {model.state_dim}), not {states.shape}"
        )
    if not (finite := np.isfinite(states).all(axis=1)).all():
        i = int(np.argmin(finite))
        raise ValueError(f"initial_states[{i}] must be finite, not {states[i]}")
    states.setflags(write=False)
    problems = [reposed(problem, start=start) for start in states]
    # Their own guesses, but the functions of one model: they are looked at once.
    guesses = [getattr(each, "initial_guess", None) for each in problems]
    return list(map(model.started, states, guesses)), problems

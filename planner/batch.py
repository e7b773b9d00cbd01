"""`plan_batch`: many problems, or many starts of one, at once.

Problems of one kind on grids of one size go to the compiled iteration together, dynamics and all,
in parallel threads. What cannot be compiled, or does not converge there, is planned one by one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from slipcar.planner.build import build
from slipcar.planner.newton.functions import Functions
from slipcar.planner.options import Options, check_count
from slipcar.planner.outcome import Outcome
from slipcar.planner.plan import Plan
from slipcar.planner.problem import checks
from slipcar.planner.problem.model import Model, Problem, model_of
from slipcar.planner.problem.reposed import reposed
from slipcar.planner.search.method import (
    compiled_functions,
    driver,
    is_faithful,
    newton_options,
    second_chance,
    solve,
    uses_newton,
)
from slipcar.planner.search.warm_start import given_guess

Array = np.ndarray

#: How errors name a problem.
_LABEL = "problem {} of the batch"


@dataclasses.dataclass(frozen=True)
class Task:
    """A model and where to start.

    Attributes:
        model: the completed problem.
        x: guess, (N, n).
        u: guess, (K, m).
        free_first: whether to leave penalties out at first.
    """

    model: Model
    x: Array
    u: Array
    free_first: bool


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
    models, posed = _models(problems, initial_states, chosen)
    if guesses is not None and not isinstance(guesses, Sequence):
        raise TypeError(f"guesses must be a sequence, not {type(guesses).__name__}")
    if guesses is not None and len(guesses) != len(models):
        raise ValueError(f"guesses must be one for each of {len(models)}, not {len(guesses)}")
    tasks = []
    for i, model in enumerate(models):
        given = None if guesses is None else guesses[i]
        with _naming(_LABEL, i):
            x, u = model.guess() if given is None else given_guess(model, given)
            if initial_states is None or i == 0:
                checks.check_once(model, x, u, charged=chosen.variance_weight > 0)
        own = given is None and chosen.method != "convex" and not chosen.only_convex
        first = own if free_first is None else bool(free_first)
        tasks.append(Task(model, x, u, first))
    outcomes = solve_tasks(tasks, chosen, workers=workers, history=history)
    record = {**chosen.as_dict(), "free_first": free_first}
    share = (time.perf_counter() - began) / max(len(tasks), 1)
    return [
        build(outcome, task.model, problem, guess=task.x, options=record, seconds=share)
        for task, problem, outcome in zip(tasks, posed, outcomes, strict=True)
    ]


def solve_tasks(
    tasks: Sequence[Task],
    options: Options,
    *,
    workers: int = 0,
    history: bool = True,
    label: str = _LABEL,
) -> list[Outcome]:
    """Outcomes of all, in order: together where they can be compiled, else one by one.

    Raises:
        ValueError: as `method.solve`, naming the task by its index in the `label`.
    """
    found: list[Outcome | None] = [None] * len(tasks)
    if driver() is not None or options.compiled:
        groups: dict[Any, list[tuple[int, Functions]]] = {}
        for i, task in enumerate(tasks):
            with _naming(label, i):
                if not uses_newton(task.model, options):
                    continue
                functions = compiled_functions(task.model, options, task.x, task.u)
            if functions is not None:
                key = (id(functions.kernels), task.x.shape, len(task.model.weight))
                groups.setdefault(key, []).append((i, functions))
        for group in groups.values():
            for (i, _), outcome in zip(
                group, _together(tasks, group, options, workers, history), strict=True
            ):
                found[i] = outcome
    outcomes = []
    for i, (task, outcome) in enumerate(zip(tasks, found, strict=True)):
        with _naming(label, i):
            outcomes.append(
                outcome or solve(task.model, options, task.x, task.u, free_first=task.free_first)
            )
    return outcomes


@contextlib.contextmanager
def _naming(label: str, i: int) -> Iterator[None]:
    """Errors that say which problem they are about."""
    try:
        yield
    except (TypeError, ValueError) as error:
        kind = ValueError if isinstance(error, ValueError) else TypeError
        raise kind(f"{label.format(i)}: {error}") from error


def _together(
    tasks: Sequence[Task],
    group: list[tuple[int, Functions]],
    options: Options,
    workers: int,
    history: bool,
) -> list[Outcome | None]:
    """One call of the compiled iteration; None where a problem is better looked at by itself.

    That is where a function is not finite along the guess, or the trace differs at the answer.
    """
    fast = driver()
    assert fast is not None
    members = [tasks[i] for i, _ in group]
    limit = newton_options(options).max_iterations
    kernels = group[0][1].kernels
    models = [task.model for task in members]
    if all(
        getattr(model, name) is getattr(models[0], name)
        for model in models
        for name in ("times", "R", "lower", "upper", "weight", "start_covariance")
    ):
        models = models[:1]
    answers = fast.run(
        kernels,
        models,
        np.stack([functions.parameters for _, functions in group]),
        np.stack([task.x for task in members]),
        np.stack([task.u for task in members]),
        variance_weight=options.variance_weight,
        tolerance=options.tolerance,
        max_iterations=limit,
        keep=limit if history else 0,
        free_first=np.array([task.free_first for task in members]),
        workers=workers,
    )
    seconds = answers.seconds / len(members)
    outcomes: list[Outcome | None] = []
    for i, task in enumerate(members):
        outcome = None
        if answers.finite(i):
            outcome = answers.outcome(i, options.variance_weight, seconds)
            if is_faithful(task.model, group[i][1], outcome, native=True):
                outcome = second_chance(task.model, options, task.x, task.u, outcome)
            else:
                outcome = None
        outcomes.append(outcome)
    return outcomes


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
            with _naming(_LABEL, i):
                models.append(_completed(problem, options))
        return models, list(problems)
    if isinstance(problems, Sequence):
        raise ValueError("initial_states go with one problem, not with a sequence of problems")
    model = _completed(problems, options)
    try:
        states = np.array(initial_states, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"initial_states must be numbers, one row for each: {error}") from error
    if states.ndim != 2 or states.shape[1] != model.state_dim:
        raise ValueError(
            f"initial_states must have shape (any, {model.state_dim}), not {states.shape}"
        )
    if not np.isfinite(states).all():
        i = int(np.argwhere(~np.isfinite(states))[0, 0])
        raise ValueError(f"initial_states[{i}] must be finite, not {states[i]}")
    states.setflags(write=False)
    posed = [reposed(problems, start=start) for start in states]
    # Their own guesses, but the functions of one model: they are compiled and compared once.
    guess = [getattr(problem, "initial_guess", None) for problem in posed]
    return [
        dataclasses.replace(model, start=start, own_guess=own)
        for start, own in zip(states, guess, strict=True)
    ], posed


def _completed(problem: Problem, options: Options) -> Model:
    model = model_of(problem)
    if options.integrator != model.integrator:
        model = dataclasses.replace(model, integrator=options.integrator)
    return model

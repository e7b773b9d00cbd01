"""Many attempts, in order: one after the other, or shared out over threads."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from slipcar.planner.newton.posing import Posed
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.model import Model
from slipcar.planner.search.attempt import attempt

Array = np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """A problem and where to start.

    Attributes:
        model: the completed problem.
        posed: the same for Newton's method; None runs the convex scheme.
        x: guess, (N, n).
        u: guess, (K, m).
        free_first: whether to leave penalties out at first.
    """

    model: Model
    posed: Posed | None
    x: Array
    u: Array
    free_first: bool


def solve_tasks(
    tasks: Sequence[Task],
    options: Options,
    *,
    workers: int = 1,
    history: bool = True,
    label: str = "problem {} of the batch",
) -> list[Outcome]:
    """Outcomes of all, in order; they do not depend on the number of threads.

    Args:
        tasks: what to plan.
        options: of the iterations.
        workers: threads; 0 takes one for each processor.
        history: keep the steps of every iteration.
        label: how errors name a task, by its index.

    Raises:
        ValueError: as `attempt`, naming the task.
    """

    def one(i: int) -> Outcome:
        task = tasks[i]
        with naming(label, i):
            return attempt(
                task.model, task.posed, options, task.x, task.u, free_first=task.free_first,
                history=history,
            )  # fmt: skip

    workers = min(workers or os.cpu_count() or 1, len(tasks))
    if workers <= 1 or options.callback is not None:
        return [one(i) for i in range(len(tasks))]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, range(len(tasks))))


@contextlib.contextmanager
def naming(label: str, i: int) -> Iterator[None]:
    """Errors that say which problem they are about."""
    try:
        yield
    except (TypeError, ValueError) as error:
        kind = ValueError if isinstance(error, ValueError) else TypeError
        raise kind(f"{label.format(i)}: {error}") from error

"""SCP with shooting: iterate until an extremal is near, then solve for it (paper §3.3)."""

from __future__ import annotations

import dataclasses

from slipcar.planner.extremal.shooting import START_WITHIN, Shot, retry_within, shoot
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.records import Iteration
from slipcar.planner.search.attempt import Task, attempt
from slipcar.planner.status import Status

#: Attempts that got to take a step.
_ATTEMPTS = 4


def solve_shooting(task: Task, options: Options) -> tuple[Outcome, Shot | None]:
    """`attempt`, cut short by the first shot that converges; and the last shot that was tried."""
    limit, attempts = START_WITHIN, 0
    last: Shot | None = None

    def shooting(iteration: Iteration) -> bool | None:
        nonlocal limit, attempts, last
        stop = options.callback is not None and options.callback(iteration)
        if stop or not iteration.accepted or attempts == _ATTEMPTS:
            return stop
        shot = shoot(
            task.model, iteration.mean, iteration.controls, iteration.terminal_multiplier,
            variance_weight=options.variance_weight,
            terminal_tolerance=options.terminal_tolerance, start_within=limit,
        )  # fmt: skip
        if shot.attempted:
            attempts, last = attempts + 1, shot
        limit = retry_within(shot, limit)
        return shot.converged

    outcome = attempt(task, dataclasses.replace(options, callback=shooting))
    if last is None or not last.converged:
        return outcome, last
    extremal = Outcome.at(
        last.at, task.model, options.variance_weight, status=Status.CONVERGED,
        adjoint=last.adjoint, terminal=last.terminal, history=outcome.history,
    )  # fmt: skip
    return extremal, last

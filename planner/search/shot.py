"""SCP with shooting: iterate until an extremal is near, then solve for it (paper §3.3)."""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.extremal.shooting import START_WITHIN, Shot, retry_within, shoot
from slipcar.planner.history import Iteration
from slipcar.planner.newton.posing import Posed
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.model import Model
from slipcar.planner.search.attempt import attempt
from slipcar.planner.status import Status

Array = np.ndarray

#: Attempts that got to take a step.
_ATTEMPTS = 4


def solve_shooting(
    model: Model, posed: Posed | None, options: Options, x: Array, u: Array, *, free_first: bool
) -> tuple[Outcome, Shot | None]:
    """`attempt`, cut short by the first shot that converges.

    Returns:
        The outcome, and the last shot; None if no iterate came near enough to try.
    """
    limit, attempts = START_WITHIN, 0
    last: Shot | None = None

    def shooting(iteration: Iteration) -> bool | None:
        nonlocal limit, attempts, last
        stop = options.callback is not None and options.callback(iteration)
        if stop or not iteration.accepted or attempts == _ATTEMPTS:
            return stop
        shot = shoot(
            model,
            iteration.mean,
            iteration.controls,
            iteration.terminal_multiplier,
            variance_weight=options.variance_weight,
            terminal_tolerance=options.terminal_tolerance,
            start_within=limit,
        )
        if shot.attempted:
            attempts, last = attempts + 1, shot
        limit = retry_within(shot, limit)
        return shot.converged

    found = attempt(
        model, posed, dataclasses.replace(options, callback=shooting), x, u, free_first=free_first
    )
    if last is None or not last.converged:
        return found, last
    hit = Outcome.at(
        last.at, model, options.variance_weight, status=Status.CONVERGED,
        adjoint=last.adjoint, terminal=last.terminal, history=found.history,
    )  # fmt: skip
    return hit, last

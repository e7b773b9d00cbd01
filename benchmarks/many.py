"""`plan_batch` of 1000 start states, and of 200 new worlds: ms per plan, and per plan and core.

The starts are the paper's and 999 round it: position ± 0.1 m, heading ± 0.2 rad, uniform, seeded.
The worlds are random ones that the planner has never met. A time is that of the whole call,
Python's share included: checks and traces, guesses, iterations, and the `Plan` objects with their
covariances and multipliers.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from contenders import Answer, Contender, UnavailableError, stopwatch
from ours import DEFAULT_TOLERANCE, FINE_TOLERANCE, FIRST_SEED, RANDOM_WORLDS
from turns import Timing

from slipcar.envs import Scenario
from slipcar.planner import Plan, plan_batch

STARTS, WORLDS = 1000, 200
_NAME = "slipcar, plan_batch"


def start_states(scenario: Scenario, count: int = STARTS, seed: int = 0) -> np.ndarray:
    """The scenario's own start and others round it, (count, 5)."""
    rng = np.random.default_rng(seed)
    reach = np.array([0.1, 0.1, 0.2, 0.0, 0.0])
    offsets = reach * rng.uniform(-1.0, 1.0, (count, 5))
    offsets[0] = 0.0
    return scenario.start + offsets


def batch(
    scenario: Scenario, workers: int, tolerance: float = DEFAULT_TOLERANCE, count: int = STARTS
) -> Contender:
    """The call with so many threads, as a contender; its answer is that for the own start."""
    if workers > (os.cpu_count() or 1):
        raise UnavailableError(f"{workers} threads need as many processors")
    states = start_states(scenario, count)

    def call() -> list[Plan]:
        return plan_batch(
            scenario,
            initial_states=states,
            workers=workers,
            variance_weight=0.0,
            tolerance=tolerance,
        )

    return Contender(
        name=f"{_NAME}, {workers} thread{'s' if workers > 1 else ''}",
        tolerance=f"residual² {tolerance:.0e}",
        solve=stopwatch(call, _answer),
        plans=count,
        threads=workers,
    )


def new_worlds(count: int = WORLDS) -> Contender:
    """The call for so many random worlds, others each time, with `plan_batch`'s own options."""
    for obstacles in range(1, 9):  # each kind once: what is compiled is in the cold starts
        plan_batch([Scenario.random(FIRST_SEED, obstacles)], workers=1)
    seeds = itertools.count(2 * FIRST_SEED)

    def solve() -> tuple[float, Answer]:
        worlds = [Scenario.random(seed) for seed in itertools.islice(seeds, count)]
        return stopwatch(lambda: plan_batch(worlds, workers=1), _answer)()

    return Contender(
        name=f"{_NAME} of new random worlds, 1 thread, w = 1",
        tolerance=f"residual² {DEFAULT_TOLERANCE:.0e}",
        solve=solve,
        solves=RANDOM_WORLDS,
        plans=count,
    )


def makers(scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    """One thread, to the planner's own tolerance and to a finer one, two threads; new worlds."""
    return {
        f"{_NAME}, 1 thread": lambda: batch(scenario, 1),
        f"{_NAME}, 1 thread, fine": lambda: batch(scenario, 1, FINE_TOLERANCE),
        f"{_NAME}, 2 threads": lambda: batch(scenario, 2),
        f"{_NAME} of new worlds": new_worlds,
    }


def rows(timings: Sequence[Timing]) -> list[dict[str, Any]]:
    """One row a contender, per plan and per plan and core."""
    return [
        {
            "planner": timing.contender.name,
            "tolerance": timing.contender.tolerance,
            "plans": timing.contender.plans,
            **timing.columns(),
            "ms per plan and core": timing.ms[1] * timing.contender.threads,
            "whole call [s]": float(np.median(timing.seconds)),
            "status": "all converged" if timing.answer.found else "not all converged",
            "runs": len(timing.seconds),
        }
        for timing in timings
        if timing.contender.plans > 1
    ]


def _answer(plans: list[Plan]) -> Answer:
    own = plans[0]
    return Answer(own.controls, own.iterations, all(p.status.ok for p in plans))

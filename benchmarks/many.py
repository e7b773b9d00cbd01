"""`plan_batch` of 1000 start states: ms per plan, and per plan and core.

The starts are the paper's and 999 round it: position ± 0.1 m, heading ± 0.2 rad, uniform, seeded.
A time is that of the whole call, Python's share included: guesses, the compiled iterations, and
1000 `Plan` objects with their covariances and multipliers.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from contenders import Answer, Contender, UnavailableError, stopwatch
from ours import DEFAULT_TOLERANCE, FINE_TOLERANCE
from turns import Timing

from slipcar.envs import Scenario
from slipcar.planner import Plan, plan_batch

STARTS = 1000
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
        tolerance=f"step {tolerance:.0e}",
        solve=stopwatch(call, _answer),
        plans=count,
        threads=workers,
    )


def makers(scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    """One thread, to the planner's own tolerance and to a finer one, and two threads."""
    return {
        f"{_NAME}, 1 thread": lambda: batch(scenario, 1),
        f"{_NAME}, 1 thread, fine": lambda: batch(scenario, 1, FINE_TOLERANCE),
        f"{_NAME}, 2 threads": lambda: batch(scenario, 2),
    }


def rows(timings: Sequence[Timing]) -> list[dict[str, Any]]:
    """One row a contender, per plan and per plan and core."""
    return [
        {
            "planner": timing.contender.name,
            "tolerance": timing.contender.tolerance,
            "starts": timing.contender.plans,
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

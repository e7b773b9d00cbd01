"""From an outcome to a `Plan`."""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.planner.moments import trace_integral
from slipcar.planner.multipliers import Multipliers
from slipcar.planner.outcome import Outcome
from slipcar.planner.plan import Plan
from slipcar.planner.problem import Model, Problem

Array = np.ndarray


def build(
    outcome: Outcome,
    model: Model,
    problem: Problem,
    *,
    guess: Array,
    options: dict[str, Any],
    seconds: float,
    **more: Any,
) -> Plan:
    """A plan: what `outcome` found for `model`, which completes `problem`, from states `guess`."""
    return Plan(
        status=outcome.status,
        times=model.times,
        mean=outcome.x,
        controls=outcome.u,
        covariance=outcome.covariance,
        effort=outcome.effort,
        obstacle_cost=outcome.penalty,
        running_cost=outcome.running,
        variance=trace_integral(outcome.covariance, model.dt),
        iterations=outcome.iterations,
        history=outcome.history,
        guess=guess,
        multipliers=Multipliers.of(
            outcome.adjoint, outcome.terminal, outcome.trust_multiplier, outcome.A
        ),
        A=outcome.A,
        B=outcome.B,
        gains=None,
        solve_time=seconds,
        options=options,
        problem=problem,
        message=outcome.message,
        **more,
    )

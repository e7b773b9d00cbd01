"""From an outcome to a `Plan`."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.planner.moments.covariance import trace_integral
from slipcar.planner.multipliers import Multipliers
from slipcar.planner.outcome import Outcome
from slipcar.planner.plan import Plan
from slipcar.planner.problem.model import Model, Problem, penalty_cost
from slipcar.planner.search.steering import Steering

Array = np.ndarray


def build_steered(
    steered: Steering,
    nominal: Outcome,
    model: Model,
    problem: Problem,
    *,
    guess: Array,
    options: dict[str, Any],
    seconds: float,
    **more: Any,
) -> Plan:
    """A plan of an expected cost, which started from the plan of the mean `nominal`."""
    found = steered.found
    outcome = dataclasses.replace(
        nominal,
        status=steered.status,
        x=found.x,
        u=found.u,
        A=found.A,
        B=found.B,
        covariance=found.covariance,
        effort=found.effort,
        penalty=penalty_cost(model, found.x),
        running=found.running,
        adjoint=found.adjoint,
        terminal=found.terminal,
        trust_multiplier=0.0,
        iterations=nominal.iterations + steered.iterations,
        message=steered.message,
    )
    return build(
        outcome,
        model,
        problem,
        guess=guess,
        options=options,
        seconds=seconds,
        gains=found.gains if options["feedback"] else None,
        expected=steered.cost,
        risk=steered.risk,
        **more,
    )


def build(
    outcome: Outcome,
    model: Model,
    problem: Problem,
    *,
    guess: Array,
    options: dict[str, Any],
    seconds: float,
    gains: Array | None = None,
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
        gains=gains,
        solve_time=seconds,
        options=options,
        problem=problem,
        message=outcome.message,
        **more,
    )

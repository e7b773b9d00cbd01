"""What a receding horizon is made of: what it charges, how far it replans, with which functions."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from slipcar.planner.expected.engine import engine
from slipcar.planner.expected.guarded import posed
from slipcar.planner.expected.loop import Steered
from slipcar.planner.moments.covariance import trace_integral
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.multipliers import Multipliers
from slipcar.planner.plan import Plan
from slipcar.planner.problem.model import Model, penalty_cost
from slipcar.planner.search.field import priced
from slipcar.planner.search.horizon_batch import Replanner
from slipcar.planner.search.steering import Request

Array = np.ndarray


def stakes_of(problem: Any, risk_price: float, saturation: float) -> Stakes:
    """What every replan is charged: what a plan with feedback is."""
    ready = posed(problem)
    if risk_price > 0.0 and getattr(problem, "constraint", None) is None:
        raise ValueError(
            f"risk_price={risk_price:g} needs a problem with constraint(t, x) -> (..., p), "
            f"violated where > 0, which {type(problem).__name__} has not"
        )
    q = np.shape(problem.terminal(np.asarray(problem.start, dtype=np.float64)))[-1]
    stakes = priced(Request(feedback=True).stakes(ready, q, 0.0), risk_price)
    return dataclasses.replace(stakes, saturation=saturation)


def handover_of(model: Model, stakes: Stakes, given: Any) -> int:
    """How many intervals at least a replan has."""
    K, m, q = len(model.dt), model.control_dim, len(stakes.terminal)
    least = 0 if stakes.soft else math.ceil(q / m)
    if least > K:
        raise ValueError(
            f"a horizon of N - 1 = {K} intervals is too short for q = {q} terminal conditions "
            f"with m = {m} controls: it takes at least {least}"
        )
    if given is None:
        return 0 if stakes.soft else min(2 * least + 2, K)
    whole = isinstance(given, (int, np.integer)) and not isinstance(given, bool)
    if not whole or not least <= given <= K:
        raise ValueError(f"handover must be None or an integer in [{least}, {K}], not {given!r}")
    return int(given)


def replanner(
    problem: Any,
    stakes: Stakes,
    iterations: int,
    tolerance: float,
    workers: int,
    compiled: bool | None,
    *,
    guess: tuple[Array, Array],
) -> Replanner:
    """With compiled functions where they can be had."""
    ready = posed(problem)
    functions, run = engine(ready, *guess, compiled=compiled)
    return Replanner(ready.model, functions, stakes, iterations, tolerance, workers, run)


def as_plan(first: Plan, found: Steered, model: Model, seconds: float) -> Plan:
    """The plan that the expected cost makes of a plan of the mean."""
    return first.replace(
        status=found.status,
        mean=found.x,
        controls=found.u,
        covariance=found.covariance,
        effort=found.effort,
        obstacle_cost=penalty_cost(model, found.x),
        running_cost=found.running,
        variance=trace_integral(found.covariance, model.dt),
        iterations=first.iterations + found.iterations,
        multipliers=Multipliers.of(found.adjoint, found.terminal, 0.0, found.A),
        A=found.A,
        B=found.B,
        gains=found.gains,
        solve_time=seconds,
        message="",
    )

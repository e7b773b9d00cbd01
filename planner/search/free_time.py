"""Free final time: the horizon that is worth its cost (paper §5, SPEC §1).

    minimise over T:  V(T) + c T,      V(T) = least cost when the time grid is dilated to T

The controls' and states' problem at given T is solved as ever; how its cost changes with T comes
with it, from the multipliers alone (envelope theorem), and is the residual of the paper's
transversality condition, max_U H(T) = c, in discrete time:

    V′(T) + c = ∂/∂T of the Lagrangian + c = 0

So this is a search for the root of one number. A secant model of V′ is trusted within |ΔT| ≤ Δ; Δ
shrinks when a step does not lower V + c T (or cannot be planned), and grows when it does. Dilation
keeps bounds of the controls and terminal conditions exact, which a joint model linear in T does
not; and each plan starts from the one before, so that it takes a few Newton steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from slipcar.planner.extremal.maximum_principle import first_order, time_slope
from slipcar.planner.history import Iteration
from slipcar.planner.newton.posing import Posed
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.model import Model
from slipcar.planner.records import TimeStep
from slipcar.planner.search.attempt import attempt
from slipcar.planner.status import Status

Array = np.ndarray

#: The first Δ and its largest value, relative to T; how it shrinks and grows.
_FIRST_RADIUS, _LARGEST_RADIUS, _SHRINK, _GROW = 0.2, 0.5, 0.25, 2.0
#: Stop when a step is this short relative to T, or the transversality residual this small
#: relative to the mean cost per time; give up after so many plans.
_SHORTEST, _TRANSVERSALITY, _PLANS = 1e-9, 1e-9, 40
#: Tolerance of the plans.
_PRECISE = 1e-12
#: Relative accuracy of V + c T: below it the slope decides.
_NOISE = 1e-7


@dataclasses.dataclass(frozen=True)
class _Point:
    model: Model
    outcome: Outcome
    T: float
    objective: float
    slope: float


def dilated(model: Model, final_time: float) -> Model:
    """The model on a time grid stretched to last `final_time` seconds."""
    begin, horizon = model.times[0], model.times[-1] - model.times[0]
    times = begin + (model.times - begin) * (final_time / horizon)
    return dataclasses.replace(model, times=times, dt=np.diff(times))


def checked_bounds(model: Model, given: Any) -> tuple[float, float]:
    """Least and largest final time [s]; None stands for a tenth and ten times the problem's.

    Raises:
        ValueError: unless 0 < least < largest, both finite.
    """
    horizon = float(model.times[-1] - model.times[0])
    if given is None:
        return 0.1 * horizon, 10.0 * horizon
    try:
        low, high = (float(bound) for bound in given)
    except (TypeError, ValueError):
        low = high = np.nan
    if not 0.0 < low < high < np.inf:
        raise ValueError(
            f"final_time_bounds must be two finite times [s], 0 < least < largest, not {given!r}"
        )
    return low, high


def free_final_time(
    model: Model,
    posed: Posed | None,
    options: Options,
    found: Outcome,
    *,
    time_weight: float,
    bounds: tuple[float, float],
) -> tuple[Model, Outcome, tuple[TimeStep, ...]]:
    """Search for the final time.

    Args:
        model: the problem; its horizon is the first that was tried.
        posed: the same for Newton's method, or None.
        options: of the iteration.
        found: the plan there.
        time_weight: c, cost per second.
        bounds: least and largest T [s].

    Returns:
        The model at the best horizon, its outcome (MAX_ITERATIONS if the search did not settle at
        a root of the slope or against a bound, STOPPED by the callback), and every horizon tried.
    """
    if found.status is Status.STOPPED:
        return model, found, ()
    model, best, steps, settled = _search(model, posed, options, found, time_weight, bounds)
    # Horizons that were not taken are told of in `steps` alone.
    history = tuple(row for step, rows in steps if step.accepted for row in rows)
    tried = sum(step.iterations for step, _ in steps)
    best = dataclasses.replace(best, iterations=tried, history=history)
    horizon = model.times[-1] - model.times[0]
    if best.status is Status.STOPPED:
        return model, best, tuple(step[0] for step in steps)
    if not best.status.ok:
        best = best.said(f"none of the horizons tried, up to {horizon:g} s, gave a plan")
    elif not settled:
        best = dataclasses.replace(best, status=Status.MAX_ITERATIONS).said(
            f"the final time did not settle within {len(steps)} plans"
        )
    elif np.isclose(horizon, bounds, rtol=_SHORTEST, atol=0.0).any():
        best = best.said("the final time is at its bound")
    return model, best, tuple(step[0] for step in steps)


def _search(
    model: Model,
    posed: Posed | None,
    options: Options,
    found: Outcome,
    time_weight: float,
    bounds: tuple[float, float],
) -> tuple[Model, Outcome, list[tuple[TimeStep, Sequence[Iteration]]], bool]:
    variance_weight = options.variance_weight
    # The slope is only as good as the plan it is taken at.
    precise = dataclasses.replace(options, tolerance=min(options.tolerance, _PRECISE))

    def at(T: float, x: Array, u: Array) -> _Point:
        there = dilated(model, T)
        outcome = attempt(there, posed, precise, x, model.admissible(u), free_first=False)
        slope, objective = np.nan, np.inf
        if outcome.status.ok:
            first = first_order(there, outcome.x, outcome.u, variance_weight)
            slope = time_slope(there, first, outcome.adjoint, variance_weight) + time_weight
            objective = outcome.objective + time_weight * T
        return _Point(there, outcome, T, objective, slope)

    low, high = bounds
    T = float(np.clip(model.times[-1] - model.times[0], low, high))
    best = at(T, found.x, found.u)
    radius = _FIRST_RADIUS * T
    steps = [_step(best, radius, True)]
    # Effort falls with the third power of the horizon where the way is long: a first curvature.
    curvature = 12.0 * max(best.objective - time_weight * T, 0.0) / T**2
    for _ in range(_PLANS):
        if best.outcome.status is Status.STOPPED:
            return best.model, best.outcome, steps, False
        if not best.outcome.status.ok:
            if high <= best.T:
                return best.model, best.outcome, steps, False
            # Too short a horizon is the usual reason.
            best = at(min(best.T * 1.5, high), found.x, found.u)
            steps.append(_step(best, radius, True))
            curvature = 12.0 * max(best.objective - time_weight * best.T, 0.0) / best.T**2
            continue
        if abs(best.slope) <= _TRANSVERSALITY * best.objective / best.T:
            return best.model, best.outcome, steps, True
        wish = -best.slope / curvature if curvature > 0.0 else -np.sign(best.slope) * np.inf
        T = float(np.clip(best.T + np.clip(wish, -radius, radius), low, high))
        if abs(T - best.T) <= _SHORTEST * best.T:
            settled = T in bounds or abs(wish) <= radius
            return best.model, best.outcome, steps, settled
        new = at(T, best.outcome.x, best.outcome.u * (best.T / T))
        if new.outcome.status is Status.STOPPED:
            steps.append(_step(new, radius, False))
            stopped = dataclasses.replace(best.outcome, status=Status.STOPPED)
            return best.model, stopped, steps, False
        noise = _NOISE * abs(best.objective)
        better = new.objective < best.objective - noise or (
            new.objective < best.objective + noise and abs(new.slope) < abs(best.slope)
        )
        if np.isfinite(new.slope):
            curvature = (new.slope - best.slope) / (new.T - best.T)
        steps.append(_step(new, radius, better))
        if better:
            radius = min(_GROW * radius, _LARGEST_RADIUS * new.T)
            best = new
        else:
            radius = _SHRINK * abs(new.T - best.T)
    return best.model, best.outcome, steps, False


def _step(point: _Point, radius: float, accepted: bool) -> tuple[TimeStep, Sequence[Iteration]]:
    row = TimeStep(
        final_time=point.T,
        objective=point.objective,
        slope=float(point.slope),
        radius=radius,
        accepted=bool(accepted),
        iterations=point.outcome.iterations,
    )
    return row, point.outcome.history

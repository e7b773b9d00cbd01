"""Free final time: the horizon that is worth its cost (paper §5).

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
from typing import Any, NamedTuple

import numpy as np

from slipcar.planner.extremal.maximum_principle import first_order, time_slope
from slipcar.planner.newton.posing import Posed
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.model import Model
from slipcar.planner.records import Iteration, TimeStep
from slipcar.planner.search.attempt import Task, attempt
from slipcar.planner.status import Status

Array = np.ndarray

#: The first Δ and its largest value, relative to T; how it shrinks and grows.
_FIRST_RADIUS, _LARGEST_RADIUS, _SHRINK, _GROW = 0.2, 0.5, 0.25, 2.0
#: Stop when a step is this short relative to T, or the transversality residual this small
#: relative to the mean cost per time; give up after so many plans, or where none was found in so
#: many times the iterations that one may take.
_SHORTEST, _TRANSVERSALITY, _PLANS, _IN_VAIN = 1e-9, 1e-9, 40, 1.5
#: Tolerance of the plans (the slope is only as good as the plan it is taken at), by Newton's
#: method and by the convex scheme, which converges linearly.
_PRECISE, _PRECISE_CONVEX = 1e-16, 1e-12
#: Relative accuracy of V + c T: below it the slope decides.
_NOISE = 1e-7
#: How much longer the horizon becomes where none was planned yet.
_LONGER = 1.5


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
    nominal: Outcome,
    *,
    time_weight: float,
    bounds: tuple[float, float],
) -> tuple[Model, Outcome, tuple[TimeStep, ...]]:
    """Search for the final time within bounds [s], from the plan `nominal` at the model's own.

    `time_weight` is c, the cost of a second.

    Returns:
        The model at the best horizon, its outcome (MAX_ITERATIONS if the search did not settle at
        a root of the slope or against a bound, STOPPED by the callback), and every horizon tried.
    """
    if nominal.status is Status.STOPPED:
        return model, nominal, ()
    finest = _PRECISE_CONVEX if posed is None else _PRECISE
    precise = dataclasses.replace(options, tolerance=min(options.tolerance, finest))
    search = _Search(model, posed, precise, time_weight, bounds)
    best, settled = search.planned(nominal), False
    if best.outcome.status.ok:
        best, settled = search.settled(best)
    steps = tuple(search.steps)
    tried = sum(step.iterations for step in steps)
    outcome = dataclasses.replace(best.outcome, iterations=tried, history=tuple(search.history))
    if outcome.status is Status.STOPPED:
        return best.model, outcome, steps
    horizon = best.model.times[-1] - best.model.times[0]
    if not outcome.status.ok:
        outcome = outcome.said(f"none of the horizons tried, up to {horizon:g} s, gave a plan")
    elif not settled:
        outcome = dataclasses.replace(outcome, status=Status.MAX_ITERATIONS).said(
            f"the final time did not settle within {len(steps)} plans"
        )
    elif np.isclose(horizon, bounds, rtol=_SHORTEST, atol=0.0).any():
        outcome = outcome.said("the final time is at its bound")
    return best.model, outcome, steps


class _Point(NamedTuple):
    """A horizon T, what came of it, V + c T and its slope."""

    model: Model
    outcome: Outcome
    T: float
    objective: float
    slope: float


@dataclasses.dataclass(eq=False)
class _Search:
    """Horizons tried so far, and the iterations of those that were taken."""

    model: Model
    posed: Posed | None
    options: Options
    time_weight: float
    bounds: tuple[float, float]
    radius: float = 0.0
    steps: list[TimeStep] = dataclasses.field(default_factory=list)
    history: list[Iteration] = dataclasses.field(default_factory=list)

    def planned(self, nominal: Outcome) -> _Point:
        """The first horizon that can be planned for; too short a one is the usual reason not to."""
        own = self.model.times[-1] - self.model.times[0]
        T, most = float(np.clip(own, *self.bounds)), self.options.max_iterations
        left = int(_IN_VAIN * most)
        if not nominal.status.ok and own == T:
            T, left = min(_LONGER * T, self.bounds[1]), left - nominal.iterations
        self.radius = _FIRST_RADIUS * T
        while True:
            point = self._at(T, nominal.x, nominal.u, max(1, min(left, most)))
            self._add(point, True)
            ended = point.outcome.status.ok or point.outcome.status is Status.STOPPED
            left -= point.outcome.iterations
            if ended or self.bounds[1] <= T or left <= 0:
                return point
            T = min(_LONGER * T, self.bounds[1])

    def settled(self, best: _Point) -> tuple[_Point, bool]:
        """The best horizon from one that was planned for, and whether it is where it should be."""
        # Effort falls with the third power of the horizon where the way is long.
        curvature = 12.0 * max(best.objective - self.time_weight * best.T, 0.0) / best.T**2
        while len(self.steps) <= _PLANS:
            if abs(best.slope) <= _TRANSVERSALITY * best.objective / best.T:
                return best, True
            wish = -best.slope / curvature if curvature > 0.0 else -np.sign(best.slope) * np.inf
            step = np.clip(wish, -self.radius, self.radius)
            T = float(np.clip(best.T + step, *self.bounds))
            if abs(T - best.T) <= _SHORTEST * best.T:
                return best, T in self.bounds or abs(wish) <= self.radius
            new = self._at(T, best.outcome.x, best.outcome.u * (best.T / T))
            noise = _NOISE * abs(best.objective)
            better = new.objective < best.objective - noise or (
                new.objective < best.objective + noise and abs(new.slope) < abs(best.slope)
            )
            self._add(new, better)
            if new.outcome.status is Status.STOPPED:
                stopped = dataclasses.replace(best.outcome, status=Status.STOPPED)
                return best._replace(outcome=stopped), False
            if np.isfinite(new.slope):
                curvature = (new.slope - best.slope) / (new.T - best.T)
            self.radius = _SHRINK * abs(new.T - best.T)
            if better:
                self.radius = min(_GROW * self.steps[-1].radius, _LARGEST_RADIUS * new.T)
                best = new
        return best, False

    def _at(self, T: float, x: Array, u: Array, iterations: int | None = None) -> _Point:
        """The plan at a horizon of T seconds, a dilation of the time grid."""
        most = self.options.max_iterations if iterations is None else iterations
        weight, begin = self.options.variance_weight, self.model.times[0]
        times = begin + (self.model.times - begin) * (T / (self.model.times[-1] - begin))
        model = dataclasses.replace(self.model, times=times, dt=np.diff(times))
        outcome = attempt(
            Task(model, self.posed, x, model.admissible(u)), self.options.with_iterations(most)
        )
        if not outcome.status.ok:
            return _Point(model, outcome, T, np.inf, np.nan)
        at = first_order(model, outcome.x, outcome.u, weight)
        slope = time_slope(model, at, outcome.adjoint, weight) + self.time_weight
        return _Point(model, outcome, T, outcome.objective + self.time_weight * T, float(slope))

    def _add(self, point: _Point, accepted: bool) -> None:
        iterations = point.outcome.iterations
        row = (point.T, point.objective, point.slope, self.radius, bool(accepted), iterations)
        self.steps.append(TimeStep(*row))
        if accepted:
            self.history += point.outcome.history

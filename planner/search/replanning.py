"""Replanning for many episodes that are at the same interval, from what each observes.

A replan begins where the episode's last plan leads from the observed state by its own feedback,

    x_0 = observed,   e_k = x_k − μ_k,   u_k = ū_k + K_k e_k,   e_{k+1} = (A + BK)_k e_k

which is, to first order, already the answer, and takes over gains, the weights of the rows and
the multipliers. A few steps of :mod:`slipcar.planner.newton.loop` remain to be made.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from typing import Any

import numpy as np

from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.posing import Posed, pose
from slipcar.planner.newton.running import advance
from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.model import Model, model_of
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.search.steering import Request
from slipcar.planner.search.tasks import in_threads
from slipcar.planner.status import Status

Array = np.ndarray

#: Plans of P episodes, K intervals before the end: x (P, K + 1, n), u (P, K, m), gains
#: (P, K, m, n), eta (P, K, p), adjoint (P, K, n), terminal (P, q), A (P, K, n, n), B (P, K, n, m),
#: as in :class:`slipcar.planner.newton.running.Steered`.
Plans = dict[str, Array]
FIELDS = ("x", "u", "gains", "eta", "adjoint", "terminal", "A", "B")

#: Largest difference between a replan's mean and the path of its controls, per unit of the state.
CONSISTENCY = 1e-2
#: How a replan may end: with few iterations, seldom converged to the tolerance.
_USABLE = (Status.CONVERGED, Status.MAX_ITERATIONS)


@dataclasses.dataclass(frozen=True, eq=False)
class Replanner:
    """Makes new plans from observed states; options as in `RecedingHorizon`."""

    problem: Problem
    stakes: Stakes
    iterations: int
    tolerance: float
    workers: int
    compiled: bool | None

    @functools.cached_property
    def posed(self) -> Posed:
        """The problem, with compiled kernels where they can be had."""
        model = model_of(self.problem)
        return pose(model, constraints=self.stakes.priced, compiled=self.compiled)

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions do not travel to other processes; they are found again there.
        return {name: value for name, value in vars(self).items() if name != "posed"}

    def replan(self, plans: Plans, x: Array, interval: int) -> Array:
        """Renew plans from `interval` on, in place, from observed states x (P, n).

        Returns:
            Which of them can be used, (P,): finite, consistent with their own controls, and not
            where the iteration gave up.
        """
        whole, P = self.posed.model, len(x)
        times, known = whole.times[interval:], np.zeros_like(whole.start_covariance)
        model = dataclasses.replace(whole, times=times, dt=np.diff(times), start_covariance=known)
        _steer_from(plans, x)
        np.clip(plans["u"], model.lower, model.upper, out=plans["u"])
        posed = self.posed.of(model)
        usable = np.zeros(P, dtype=bool)

        def part(rows: slice) -> None:
            some = {name: array[rows] for name, array in plans.items()}
            endings = advance(
                posed, self.stakes, some, tolerance=self.tolerance, max_iterations=self.iterations
            )
            usable[rows] = [status in _USABLE for status in endings]

        workers = min(self.workers or os.cpu_count() or 1, P)
        edges = np.linspace(0, P, (min(P, 4 * workers) if workers > 1 else 1) + 1).astype(int)
        in_threads(part, list(map(slice, edges[:-1], edges[1:])), workers)
        return usable & _sound(model, plans)


def applied(gains: Array, error: Array) -> Array:
    """K e, (..., m), for gains (..., m, n) and errors (..., n)."""
    # A sum rather than a matrix product: the same bits for batches of any size.
    return np.add.reduce(gains * error[..., None, :], axis=-1)


def _steer_from(plans: Plans, x: Array) -> None:
    """Move means and controls to where the plans' feedback leads from x (P, n), to first order."""
    closed = plans["A"] + plans["B"] @ plans["gains"]
    errors = np.empty_like(plans["x"])
    errors[:, 0] = x - plans["x"][:, 0]
    for k in range(closed.shape[1]):
        errors[:, k + 1] = applied(closed[:, k], errors[:, k])
    plans["u"] += applied(plans["gains"], errors[:, :-1])
    plans["x"] += errors
    plans["x"][:, 0] = x


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _sound(model: Model, plans: Plans) -> Array:
    """Whether plans are finite and their means follow their controls, (P,)."""
    # A sum is finite only if every entry is.
    total = sum(array.sum(axis=tuple(range(1, array.ndim))) for array in plans.values())
    x, u = plans["x"], plans["u"]
    t, dt = np.broadcast_to(model.times[:-1], u.shape[:2]), np.broadcast_to(model.dt, u.shape[:2])
    moved = change(model.integrator, model.drift, t, dt, x[:, :-1], u)
    gap = np.abs(x[:, :-1] + moved - x[:, 1:]).max(axis=(1, 2))
    return np.isfinite(total) & (gap <= CONSISTENCY * (1.0 + np.abs(x).max(axis=(1, 2))))


def stakes_of(model: Model, risk_price: float, saturation: float) -> Stakes:
    """What every replan is charged: what a plan with feedback is."""
    if risk_price > 0.0 and not model.has("constraint"):
        raise ValueError(
            f"risk_price={risk_price:g} needs a problem with constraint(t, x) -> (..., p), "
            f"violated where > 0, which {type(model.problem).__name__} has not"
        )
    stakes = Request(feedback=True).stakes(model, 0.0)
    return dataclasses.replace(stakes, price=risk_price, saturation=saturation)


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

"""Replanning for many episodes that are at the same interval, from what each observes.

A replan begins where the episode's last plan leads from the observed state by its own feedback,

    x_0 = observed,   e_k = x_k − μ_k,   u_k = ū_k + K_k e_k,   e_{k+1} = (A + BK)_k e_k

which is, to first order, already the answer, and takes over gains, the weights of the rows and
the multipliers. A few steps of :mod:`slipcar.planner.newton.loop` remain to be made.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.posing import Posed, pose
from slipcar.planner.newton.running import Steered, advance, solve_noise
from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.model import Model
from slipcar.planner.search.steering import Request
from slipcar.planner.status import Status

Array = np.ndarray

#: Largest difference between a replan's mean and the path of its controls, per unit of the state.
CONSISTENCY = 1e-2
#: How a replan may end: with few iterations, seldom converged to the tolerance.
_USABLE = (Status.CONVERGED, Status.MAX_ITERATIONS)


@dataclasses.dataclass(frozen=True, eq=False)
class Tails:
    """Plans of P episodes from a node on, K intervals before the end; never written to.

    Attributes:
        x: means, (P, K + 1, n).
        u: controls, (P, K, m).
        gains: (P, K, m, n).
        eta: what the rows' variances are charged, (P, K, p).
        adjoint: (P, K, n).
        terminal: (P, q).
        A: ∂x⁺/∂x along the plan, (P, K, n, n).
        B: ∂x⁺/∂u, (P, K, n, m).
    """

    x: Array
    u: Array
    gains: Array
    eta: Array
    adjoint: Array
    terminal: Array
    A: Array
    B: Array

    @classmethod
    def of(cls, plan: Steered) -> Tails:
        """One plan, P = 1."""
        return cls(**{name: getattr(plan, name)[None] for name in FIELDS})

    def __len__(self) -> int:
        return len(self.x)

    def later(self, intervals: int) -> Tails:
        """The same plans so many intervals later: a view."""
        if intervals == 0:
            return self
        return self._each(lambda name, a: a if name == "terminal" else a[:, intervals:])

    def take(self, rows: Any) -> Tails:
        """Those of some episodes, (P',)."""
        return self._each(lambda name, a: a[rows])

    def repeat(self, count: int) -> Tails:
        """The one plan for so many episodes: a view."""
        return self._each(lambda name, a: np.broadcast_to(a, (count, *a.shape[1:])))

    def choose(self, here: Array, other: Tails) -> Tails:
        """These plans where `here` (P,), the others elsewhere."""
        if here.all():
            return self

        def chosen(name: str, a: Array) -> Array:
            mask = here.reshape(-1, *[1] * (a.ndim - 1))
            return np.where(mask, a, getattr(other, name))

        return self._each(chosen)

    @classmethod
    def join(cls, parts: list[tuple[Array, Tails]], count: int) -> Tails:
        """Episodes from several places: rows (P_i,) of each part, together 0..count − 1."""
        if len(parts) == 1:
            rows, tails = parts[0]
            return tails if np.array_equal(rows, np.arange(count)) else tails.take(np.argsort(rows))
        joined = {}
        for name in FIELDS:
            shape = getattr(parts[0][1], name).shape[1:]
            joined[name] = np.empty((count, *shape))
            for rows, tails in parts:
                joined[name][rows] = getattr(tails, name)
        return cls(**joined)

    def law(self, x: Array) -> Array:
        """ū + K (x − μ) at the first node, for states (P, n): (P, m)."""
        # A sum rather than a matrix product: the same bits for any number of episodes.
        error = x - self.x[:, 0]
        return self.u[:, 0] + (self.gains[:, 0] * error[:, None, :]).sum(axis=-1)

    def steered_from(self, x: Array) -> tuple[Array, Array]:
        """Where the plans' feedback leads from states x (P, n), to first order.

        Returns:
            States (P, K + 1, n) and controls (P, K, m).
        """
        states, controls = np.array(self.x), np.array(self.u)
        closed = self.A + self.B @ self.gains
        errors = np.empty_like(controls, shape=(*controls.shape[:2], x.shape[1]))
        error = x - states[:, 0]
        for k in range(controls.shape[1]):
            errors[:, k] = error
            # A sum rather than a matrix product: the same bits for any number of episodes.
            error = np.add.reduce(closed[:, k] * error[:, None, :], axis=-1)
        states[:, :-1] += errors
        states[:, -1] += error
        states[:, 0] = x
        controls += np.add.reduce(self.gains * errors[:, :, None, :], axis=-1)
        return states, controls

    def _each(self, f: Callable[[str, Array], Array]) -> Tails:
        return Tails(**{name: f(name, getattr(self, name)) for name in FIELDS})


FIELDS = tuple(field.name for field in dataclasses.fields(Tails))


@dataclasses.dataclass(frozen=True, eq=False)
class Replanner:
    """Makes new plans from observed states.

    Attributes:
        posed: the problem over the whole horizon.
        stakes: what is charged.
        iterations: steps of the iteration, at most.
        tolerance: of the iteration.
        workers: threads.
    """

    posed: Posed
    stakes: Stakes
    iterations: int
    tolerance: float
    workers: int

    @property
    def model(self) -> Model:
        """Of the whole horizon."""
        return self.posed.model

    def replan(self, tails: Tails, x: Array, interval: int) -> tuple[Tails, Array]:
        """New plans for the intervals from `interval` on, from states x (P, n).

        Args:
            tails: the plans up to now, of that horizon.
            x: observed states, (P, n).
            interval: which one begins now.

        Returns:
            Plans, and which of them can be used, (P,): finite, consistent with their own
            controls, and not where the iteration gave up.
        """
        model, P = self._remaining(interval), len(x)
        states, controls = tails.steered_from(x)
        np.clip(controls, model.lower, model.upper, out=controls)
        batch = {name: np.array(getattr(tails, name)) for name in FIELDS if name not in ("x", "u")}
        batch |= {"x": states, "u": controls}
        posed = self.posed.of(model)
        usable = np.zeros(P, dtype=bool)

        def part(rows: slice) -> None:
            some = {name: array[rows] for name, array in batch.items()}
            endings = advance(
                posed, self.stakes, some, tolerance=self.tolerance, max_iterations=self.iterations
            )
            usable[rows] = [status in _USABLE for status in endings]

        workers = min(self.workers or os.cpu_count() or 1, P)
        if workers <= 1:
            part(slice(None))
        else:
            edges = np.linspace(0, P, min(P, 4 * workers) + 1).astype(int).tolist()
            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(part, map(slice, edges[:-1], edges[1:])))
        new = Tails(**batch)
        return new, usable & _sound(model, new)

    def first(self, x: Array, u: Array, max_iterations: int) -> Steered:
        """The plan of the whole horizon from states x (N, n) and controls u (K, m).

        Raises:
            ValueError: if the problem's functions are not finite along them.
        """
        return solve_noise(
            self.posed, self.stakes, x, u, tolerance=self.tolerance, max_iterations=max_iterations
        )

    def _remaining(self, interval: int) -> Model:
        """The problem over the intervals that are left, from a state that is observed."""
        model = self.model
        times = model.times[interval:]
        known = np.zeros_like(model.start_covariance)
        return dataclasses.replace(model, times=times, dt=np.diff(times), start_covariance=known)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _sound(model: Model, plans: Tails) -> Array:
    """Whether plans are finite and their means follow their controls, (P,)."""
    axes = {name: tuple(range(1, getattr(plans, name).ndim)) for name in FIELDS}
    # A sum is finite only if every entry is.
    total = sum(getattr(plans, name).sum(axis=axes[name]) for name in FIELDS)
    P, K = plans.u.shape[:2]
    t, dt = np.broadcast_to(model.times[:-1], (P, K)), np.broadcast_to(model.dt, (P, K))
    before, after = plans.x[:, :-1], plans.x[:, 1:]
    moved = change(model.integrator, model.drift, t, dt, before, plans.u)
    gap = np.abs(before + moved - after).max(axis=(1, 2))
    return np.isfinite(total) & (gap <= CONSISTENCY * (1.0 + np.abs(plans.x).max(axis=(1, 2))))


def stakes_of(model: Model, risk_price: float, saturation: float) -> Stakes:
    """What every replan is charged: what a plan with feedback is."""
    if risk_price > 0.0 and not model.has("constraint"):
        raise ValueError(
            f"risk_price={risk_price:g} needs a problem with constraint(t, x) -> (..., p), "
            f"violated where > 0, which {type(model.problem).__name__} has not"
        )
    stakes = Request(feedback=True).stakes(model, 0.0).at_price(risk_price)
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
    model: Model,
    stakes: Stakes,
    iterations: int,
    tolerance: float,
    workers: int,
    compiled: bool | None,
) -> Replanner:
    """With compiled kernels where they can be had."""
    posed = pose(model, constraints=stakes.priced, compiled=compiled)
    return Replanner(posed, stakes, iterations, tolerance, workers)

"""Receding horizon: a new plan at every control interval, from the observed state.

At node k with state x the controller plays the first control of

    minimise E[ cost of the intervals left | x_k = x ] over ū and K,   u = ū + K (x − μ)

(:mod:`slipcar.planner.newton.loop`): the expected cost for Gaussian states, given that it
will go on to correct. A certainty-equivalent replan does not know that the noise to come depends
on what it chooses; this one does, and a Newton step from the last plan makes it.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np

from slipcar.planner.controllers import OpenLoop
from slipcar.planner.moments.gains import closed_loop_covariance, wrap
from slipcar.planner.options import check_count, check_number
from slipcar.planner.plan import steered_fields
from slipcar.planner.planning import plan
from slipcar.planner.problem.model import model_of
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.search.replanning import Tails, handover_of, replanner, stakes_of

Array = np.ndarray

#: Steps of the first plan, which is iterated to convergence.
_FIRST = 100


@dataclasses.dataclass(frozen=True, eq=False)
class Underway:
    """What a receding-horizon controller remembers of its episodes; never written to.

    Attributes:
        groups: episodes by the interval their plans begin with.
        failures: replans that failed so far in each episode, (episodes,).
    """

    groups: tuple[Group, ...]
    failures: Array


@dataclasses.dataclass(frozen=True, eq=False)
class Group:
    """Episodes whose plans begin at the same interval.

    Attributes:
        interval: which.
        rows: their places in the batch, (P,).
        plans: of those episodes.
    """

    interval: int
    rows: Array
    plans: Tails


class RecedingHorizon(OpenLoop):
    """Replans at every control interval and plays the first control of each new plan.

    All episodes begin with one plan, made here (`plan`; `preparation_time` is how long it took).
    Every later one is a Newton step from the plan before it, of all episodes at the
    same interval together. Where a replan fails, the last plan goes on with its feedback law
    u = ū + K (x − μ) and is counted. The counters count over the controller's life; what an
    episode was is in the state that `predict` returns, as in a recurrent policy of
    Stable-Baselines3, and nowhere else. Actions depend neither on how many episodes are asked for
    together nor on `workers`.

    The end: with `problem.terminal_weight`, gᵀWg is charged and there are replans to the last
    interval. Without, E g = 0 is exact in every plan, with feedback charged 100 ‖g‖² for its
    spread; this is ill-conditioned near the end, where the last feedback law takes over.

    Args:
        problem: anything that satisfies :class:`slipcar.planner.Problem`, without a
            `control_radius`.
        risk: δ in (0, 1): keep the margins that a plan with feedback needs for it. The price that
            `plan(problem, feedback=True, risk=δ)` finds is charged in every replan; the risk of
            replanning itself is not verified, but as a rule smaller (`plan.risk` is the plan's).
        risk_price: ν ≥ 0 instead, cost per unit of probability that `problem.constraint` is
            violated at a node; > 0 keeps margins.
        iterations: Newton steps of a replan, at most, ≥ 1. They start so near that more than one
            made no difference on the worlds tried.
        tolerance: a replan stops before where two steps together, ∫ ‖Δu‖² dt, are below it, > 0.
        saturation: control bounds are kept at so many standard deviations of the correction, ≥ 0.
        workers: threads that replan, ≥ 1; 0 takes one for each processor.
        compiled: replan by machine code, the same plans to rounding errors; see `plan`.
        handover: the last feedback law takes over where fewer intervals than this are left. None
            is 0 with a `terminal_weight`, else 2 ⌈q/m⌉ + 2 for q terminal conditions and m
            controls: at ⌈q/m⌉ the controls are just enough.

    Attributes:
        plan: the first one; its `status` is the controller's.
        replans: made so far.
        failures: how many of them failed.
        seconds: they took.

    Raises:
        TypeError: if the problem lacks a required member.
        ValueError: for an argument out of range, a `control_radius`, a `risk_price` without
            `problem.constraint`, or a horizon too short for the terminal condition.
    """

    closed_loop = True
    #: Episodes that `slipcar.evaluation` asks for at once.
    rows = 128

    def __init__(
        self,
        problem: Problem,
        *,
        risk: float | None = None,
        risk_price: float = 0.0,
        iterations: int = 1,
        tolerance: float = 1e-3,
        saturation: float = 1.0,
        workers: int = 1,
        compiled: bool | None = None,
        handover: int | None = None,
    ) -> None:
        began = time.perf_counter()
        check_number("risk_price", risk_price, zero_allowed=True)
        check_number("tolerance", tolerance)
        check_number("saturation", saturation, zero_allowed=True)
        check_count("iterations", iterations)
        check_count("workers", workers, least=0)
        if compiled not in (None, True, False):
            raise ValueError(f"compiled must be None, True or False, not {compiled!r}")
        model = model_of(problem)
        if model.radius < np.inf:
            raise ValueError(
                f"RecedingHorizon knows no control_radius (here {model.radius:g}): its replans "
                f"keep to boxes, control_bounds"
            )
        if risk is not None and risk_price > 0.0:
            raise ValueError("risk and risk_price exclude each other: risk=δ finds the price")
        stakes = stakes_of(model, float(risk_price), float(saturation))
        self._handover = handover_of(model, stakes, handover)
        price = {"risk": risk} if risk is not None else {"risk_price": float(risk_price) or None}
        first = plan(problem, feedback=True, compiled=compiled, **price)
        if first.risk is not None:
            stakes = stakes_of(model, first.risk.price, float(saturation))
        self._options = (stakes, int(iterations), float(tolerance), int(workers), compiled)
        self._replanner = replanner(model, *self._options)
        steered = self._replanner.first(first.mean, first.controls, _FIRST)
        self._first = Tails.of(steered)
        super().__init__(
            first.replace(
                **steered_fields(steered, model),
                status=steered.status,
                iterations=first.iterations + steered.iterations,
                gains=steered.gains,
                solve_time=time.perf_counter() - began,
                message="",
            )
        )
        self._angles = tuple(getattr(problem, "angles", ()))
        self.replans, self.failures, self.seconds = 0, 0, 0.0

    @property
    def time_per_replan(self) -> float:
        """Mean seconds of a replan; nan before the first."""
        return self.seconds / self.replans if self.replans else float("nan")

    def predict(  # type: ignore[override]
        self,
        observation: Any,
        state: Underway | None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Array, Underway]:
        """Actions for observations (d,) or (batch, d), and the state for the next call.

        Episodes may be at different times. One that begins, by `episode_start` or because there
        is no state, has the first plan's tail to begin with, whatever its time; so has one whose
        time has gone back.

        Args:
            observation: (d,) or (batch, d).
            state: what the last call returned for these episodes; None begins all anew.
            episode_start: which begin anew, (batch,) or a single one for all.
            deterministic: of no effect.

        Returns:
            float32 actions, (m,) or (batch, m), and the state.

        Raises:
            ValueError: if an observation has the wrong length or is not finite, or if the state
                is of another number of episodes.
        """
        t, x = self._decode(observation)
        shape, n = np.shape(x)[:-1], np.shape(x)[-1]
        x = np.array(x, dtype=np.float64).reshape(-1, n)
        E = len(x)
        interval = np.broadcast_to(self._interval(t), shape).reshape(-1)
        source = self._sources(state, episode_start, interval)
        failures = np.zeros(E, dtype=np.int64)
        if state is not None:
            failures[:] = np.where(source >= 0, state.failures, 0)
        u, groups = np.empty((E, self.plan.controls.shape[1])), []
        for k in np.unique(interval):
            rows = np.flatnonzero(interval == k)
            before = self._plans_at(int(k), state, source, rows)
            here = _unwrapped(x[rows], before.x[:, 0], self._angles)
            after, replanned, ok = self._replanned(int(k), before, here)
            failures[rows] += replanned & ~ok
            played = np.where(ok[:, None], after.u[:, 0], before.law(here))
            u[rows] = self._replanner.model.admissible(played)
            groups.append(Group(int(k), rows, after))
        encode = getattr(self.plan.problem, "encode_control", None)
        u = u.reshape(*shape, u.shape[1])
        action = np.asarray(u if encode is None else encode(u), dtype=np.float32)
        return action, Underway(tuple(groups), failures)

    def preview(self, state: Underway | None = None, row: int = 0) -> tuple[Array, Array | None]:
        """An episode's latest plan, from the state it was made from.

        Args:
            state: what `predict` returned; None is before the start.
            row: which episode of those `predict` was asked for.

        Returns:
            Mean states (K + 1, n) and closed-loop covariances (K + 1, n, n).

        Raises:
            ValueError: if the state is of fewer episodes.
        """
        if state is None:
            return self.plan.mean, self.plan.covariance
        for group in state.groups:
            for place in np.flatnonzero(group.rows == row):
                x, A, B, gains = (getattr(group.plans, f)[place] for f in ("x", "A", "B", "gains"))
                model, times = self._replanner.model, self.plan.times[group.interval :]
                known = np.zeros((x.shape[1], x.shape[1]))
                return x, closed_loop_covariance(model, times, x, A, B, gains, start=known)
        raise ValueError(f"row must be one of the state's {len(state.failures)}, not {row}")

    def _sources(self, state: Any, episode_start: Any, interval: Array) -> Array:
        """Which group of the state each episode goes on from, (E,); −1 where it begins anew."""
        E = len(interval)
        source = np.full(E, -1)
        if state is None:
            return source
        if not isinstance(state, Underway) or len(state.failures) != E:
            what = (
                f"of {len(state.failures)} episodes"
                if isinstance(state, Underway)
                else f"a {type(state).__name__}"
            )
            raise ValueError(
                f"state must be what predict returned for the same {E} episodes, not {what}"
            )
        for i, group in enumerate(state.groups):
            source[group.rows] = np.where(interval[group.rows] >= group.interval, i, -1)
        if episode_start is not None:
            starts = np.asarray(episode_start, dtype=bool).reshape(-1)
            if len(starts) not in (1, E):
                raise ValueError(f"episode_start must be one flag or {E}, not {len(starts)}")
            source[np.broadcast_to(starts, (E,))] = -1
        return source

    def _plans_at(self, k: int, state: Underway | None, source: Array, rows: Array) -> Tails:
        """The plans up to now of some episodes, from interval k on."""
        parts = []
        for i in np.unique(source[rows]):
            places = np.flatnonzero(source[rows] == i)
            if i < 0 or state is None:
                parts.append((places, self._first.later(k).repeat(len(places))))
                continue
            group = state.groups[i]
            tails = group.plans.later(k - group.interval)
            if len(places) < len(group.rows) or not np.array_equal(rows[places], group.rows):
                order = np.argsort(group.rows)
                at = np.searchsorted(group.rows, rows[places], sorter=order)
                tails = tails.take(order[at])
            parts.append((places, tails))
        return Tails.join(parts, len(rows))

    def _replanned(self, k: int, before: Tails, x: Array) -> tuple[Tails, Array, Array]:
        """Plans from states x (P, n), which are new or were tried to be, which succeeded (P,)."""
        wanted = np.full(len(x), len(self.plan.controls) - k >= self._handover)
        if k == 0:  # where it was planned for, there is nothing to add
            wanted &= (np.float32(x) != np.float32(self.plan.mean[0])).any(axis=1)
        ok = np.zeros(len(x), dtype=bool)
        if not wanted.any():
            return before, wanted, ok
        began = time.perf_counter()
        rows = np.flatnonzero(wanted)
        whole = len(rows) == len(x)
        tails = before if whole else before.take(rows)
        after, ok[rows] = self._replanner.replan(tails, x[rows], k)
        if not whole:
            others = np.flatnonzero(~wanted)
            after = Tails.join([(rows, after), (others, before.take(others))], len(x))
        after = after.choose(ok, before)
        self.replans += len(rows)
        self.failures += int((wanted & ~ok).sum())
        self.seconds += time.perf_counter() - began
        return after, wanted, ok

    def _numbers(self) -> list[Array]:
        stakes, iterations, tolerance, _, _ = self._options
        model = self._replanner.model
        return [
            *super()._numbers(),
            *(getattr(self._first, f.name) for f in dataclasses.fields(Tails)),
            stakes.weight,
            stakes.terminal,
            np.array([stakes.saturation, iterations, tolerance, self._handover]),
            np.array([self._replanner.posed.native]),
            model.R,
            model.lower,
            model.upper,
            self._replanner.posed.numbers,
        ]

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions do not travel to other processes; they are found again there.
        return {name: value for name, value in vars(self).items() if name != "_replanner"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._replanner = replanner(model_of(self.plan.problem), *self._options)


def _unwrapped(x: Array, mean: Array, angles: tuple[int, ...]) -> Array:
    """States (P, n) with angles on the plan's branch: observations know them modulo 2π."""
    return mean + wrap(x - mean, angles)

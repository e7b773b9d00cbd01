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

from slipcar.planner.control_loop import ControlLoop
from slipcar.planner.controllers import OpenLoop
from slipcar.planner.moments.gains import closed_loop_covariance, wrap
from slipcar.planner.newton.running import solve_noise
from slipcar.planner.options import check_count, check_flag, check_number
from slipcar.planner.plan import steered_fields
from slipcar.planner.planning import plan
from slipcar.planner.problem.model import model_of
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.search import replanning

Array = np.ndarray

#: Steps of the first plan, which is iterated to convergence.
_FIRST = 100


@dataclasses.dataclass(frozen=True, eq=False)
class Underway:
    """What a receding-horizon controller remembers of E episodes; not to be written to."""

    interval: Array  #: at which each episode's plan begins, (E,)
    #: over the whole horizon, (E, K, ...); of no meaning before their interval
    plans: replanning.Plans
    failures: Array  #: replans that failed so far in each episode, (E,)


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
        problem: any :class:`slipcar.planner.Problem` without a `control_radius`.
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
        ValueError: for an argument out of range, a problem it does not know, or one whose plan with
            feedback has no finite gains.
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
        check_flag("compiled", compiled, none_allowed=True)
        model = model_of(problem)
        if model.radius < np.inf:
            raise ValueError(
                f"RecedingHorizon knows no control_radius (here {model.radius:g}): its replans "
                f"keep to boxes, control_bounds"
            )
        if risk is not None and risk_price > 0.0:
            raise ValueError("risk and risk_price exclude each other: risk=δ finds the price")
        stakes = replanning.stakes_of(model, float(risk_price), float(saturation))
        self._handover = replanning.handover_of(model, stakes, handover)
        price = {"risk": risk} if risk is not None else {"risk_price": float(risk_price) or None}
        nominal = plan(problem, feedback=True, compiled=compiled, **price)
        if nominal.risk is not None:
            stakes = stakes.at_price(nominal.risk.price)
        self._replanner = replanning.Replanner(
            problem, stakes, int(iterations), float(tolerance), int(workers), compiled
        )
        with np.errstate(all="ignore"):
            steered = solve_noise(
                self._replanner.posed, stakes, nominal.mean, nominal.controls,
                tolerance=float(tolerance), max_iterations=_FIRST,
            )  # fmt: skip
        if not np.isfinite(steered.gains).all():
            raise ValueError(
                f"RecedingHorizon has no first plan to follow: the plan with feedback ended "
                f"{nominal.status.name}, its gains are not finite ({nominal.message})"
            )
        self._first: replanning.Plans = {name: getattr(steered, name) for name in replanning.FIELDS}
        super().__init__(
            nominal.replace(
                **steered_fields(steered, model),
                iterations=nominal.iterations + steered.iterations,
                solve_time=time.perf_counter() - began,
                message="" if steered.status.ok else nominal.message,
            )
        )
        self.replans, self.failures, self.seconds = 0, 0, 0.0
        self._loop: ControlLoop[Underway] | None = None

    def __getstate__(self) -> dict[str, Any]:
        # Another process steps an episode of its own, by a thread of its own.
        return {**vars(self), "_loop": None}

    @property
    def late(self) -> int:
        """How many calls of `step` played the last good law because their replan was not there."""
        return 0 if self._loop is None else self._loop.late

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
            ValueError: for an observation of wrong length or not finite, or another state.
        """
        t, x = self._decode(observation)
        shape, n = np.shape(x)[:-1], np.shape(x)[-1]
        x = np.array(x, dtype=np.float64).reshape(-1, n)
        interval = np.broadcast_to(self._interval(t), shape).reshape(-1)
        now = self._recalled(state, episode_start, interval)
        u = np.empty((len(x), self.plan.controls.shape[1]))
        for k in np.unique(interval):
            rows = np.flatnonzero(interval == k)
            u[rows] = self._played(now, rows, int(k), x[rows])
        u = self._replanner.posed.model.admissible(u)
        return self._action(u.reshape(*shape, u.shape[1])), now

    @property
    def underway(self) -> Underway | None:
        """The episode that `step` keeps, for `preview`; None before the first step."""
        return None if self._loop is None else self._loop.state

    def step(self, x: Any, t: float, *, deadline: float | None = None) -> Array:
        """The control for the state x at time t: one episode, in a control loop.

        With a deadline the replan runs in a thread. If it is not there in time, the last good
        plan's feedback law u = ū + K (x − μ) is played, `late` counts it, and the replan serves the
        steps to come. Unlike `predict`, it keeps the episode; a time that goes back begins anew.

        Args:
            x: observed state, (n,); angles modulo 2π.
            t: its time [s], on the plan's clock; the last interval lasts for ever.
            deadline: seconds from the call until it returns, > 0; None waits for the replan.

        Returns:
            Controls in physical units, (m,), admissible.

        Raises:
            ValueError: for a state of another shape, what is not finite, or a deadline ≤ 0.
        """
        state, n = np.asarray(x, dtype=np.float64), self.plan.mean.shape[1]
        if state.shape != (n,) or not np.isfinite(state).all():
            raise ValueError(f"x must be {n} finite numbers, not {x!r}")
        if not np.isfinite(t):
            raise ValueError(f"t must be finite [s], not {t!r}")
        if deadline is not None:
            check_number("deadline", deadline)
        if self._loop is None:
            begun = self._recalled(None, None, np.zeros(1, dtype=np.int64))
            self._loop = ControlLoop(self._followed, self._renewed, begun)
        return self._loop.step(state, int(self._interval(t)), deadline)

    def _followed(self, now: Underway, x: Array, k: int) -> Array:
        """Controls (m,) by the feedback law of the latest plan."""
        error = wrap(x - now.plans["x"][0, k], self._angles)
        u = now.plans["u"][0, k] + replanning.applied(now.plans["gains"][0, k], error)
        return self._replanner.posed.model.admissible(u)

    def _renewed(self, last: Underway, x: Array, k: int) -> tuple[Array, Underway]:
        """Controls (m,) of a new plan from x, and what is known then."""
        now = self._recalled(last, None, np.array([k]))
        u = self._played(now, np.zeros(1, dtype=np.int64), k, x[None])
        return self._replanner.posed.model.admissible(u)[0], now

    def preview(self, state: Underway | None = None, row: int = 0) -> tuple[Array, Array | None]:
        """An episode's latest plan, from the state it was made from; see `OpenLoop.preview`.

        Raises:
            ValueError: if the state is of fewer episodes.
        """
        if state is None:
            return self.plan.mean, self.plan.covariance
        if not 0 <= row < len(state.failures):
            raise ValueError(f"row must be one of the state's {len(state.failures)}, not {row}")
        k = state.interval[row]
        x, A, B, gains = (state.plans[name][row, k:] for name in ("x", "A", "B", "gains"))
        model, known = self._replanner.posed.model, np.zeros((x.shape[1], x.shape[1]))
        return x, closed_loop_covariance(model, model.times[k:], x, A, B, gains, start=known)

    def _recalled(self, state: Any, episode_start: Any, interval: Array) -> Underway:
        """What is known of episodes at these intervals (E,), to be written to."""
        E = len(interval)
        if state is None:
            plans = {name: np.repeat(a[None], E, axis=0) for name, a in self._first.items()}
            return Underway(interval, plans, np.zeros(E, dtype=np.int64))
        known = isinstance(state, Underway)
        if not known or len(state.failures) != E:
            what = f"of {len(state.failures)} episodes" if known else f"a {type(state).__name__}"
            raise ValueError(
                f"state must be what predict returned for the same {E} episodes, not {what}"
            )
        anew = interval < state.interval
        if episode_start is not None:
            starts = np.asarray(episode_start, dtype=bool).reshape(-1)
            if len(starts) not in (1, E):
                raise ValueError(f"episode_start must be one flag or {E}, not {len(starts)}")
            anew = anew | starts
        plans = {name: np.array(array) for name, array in state.plans.items()}
        if anew.any():
            for name, array in plans.items():
                array[anew] = self._first[name]
        return Underway(interval, plans, np.where(anew, 0, state.failures))

    def _played(self, now: Underway, rows: Array, k: int, x: Array) -> Array:
        """Controls (P, m) of episodes at interval k in states x (P, n), replanned if possible."""
        plans = now.plans
        # Observations know angles modulo 2π: on the plan's branch.
        mean = plans["x"][rows, k]
        x = mean + wrap(x - mean, self._angles)
        u = plans["u"][rows, k] + replanning.applied(plans["gains"][rows, k], x - mean)
        wanted = np.full(len(x), len(self.plan.controls) - k >= self._handover)
        if k == 0:  # where it was planned for, there is nothing to add
            wanted &= (np.float32(x) != np.float32(self.plan.mean[0])).any(axis=1)
        if not wanted.any():
            return u
        began, again = time.perf_counter(), rows[wanted]
        tails = {name: array[again, _from(name, k)] for name, array in plans.items()}
        with np.errstate(all="ignore"):  # replans that are not finite are not used
            ok = self._replanner.replan(tails, x[wanted], k)
        kept = again[ok]
        for name, array in tails.items():
            plans[name][kept, _from(name, k)] = array if len(kept) == len(ok) else array[ok]
        u[np.flatnonzero(wanted)[ok]] = tails["u"][ok, 0]
        now.failures[again] += ~ok
        self.replans += len(again)
        self.failures += int((~ok).sum())
        self.seconds += time.perf_counter() - began
        return u

    def _numbers(self) -> list[Array]:
        replanner, model = self._replanner, self._replanner.posed.model
        stakes, options = replanner.stakes, (replanner.iterations, replanner.tolerance)
        return [
            *super()._numbers(),
            *self._first.values(),
            stakes.weight,
            stakes.terminal,
            np.array([stakes.saturation, *options, self._handover]),
            np.array([replanner.posed.native]),
            model.R,
            model.lower,
            model.upper,
            replanner.posed.numbers,
        ]


def _from(name: str, interval: int) -> slice:
    """What is left of a plan's array at an interval; multipliers of the end have no time."""
    return slice(None) if name == "terminal" else slice(interval, None)

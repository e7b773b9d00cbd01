"""Monte Carlo: a controller drives many episodes, each along its own Brownian path.

    x_{k+1} = EulerMaruyama(x_k, u_k, ξ_k),   u_k = bounds · clip(predict(observe(t_k, x_k)))

The step is :func:`slipcar.envs.transition.transition`, the same that the environments take.
One block of :data:`slipcar.evaluation.noise.BLOCK` episodes is stepped at a time and always
whole: linear algebra rounds by the shape it is given, so a policy that saw 1000 rows here and
1024 there would not be the same function to the last bit.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from slipcar.envs import observation as layouts
from slipcar.envs.integrate import added_up
from slipcar.envs.options import check_seen
from slipcar.envs.scenario import Scenario
from slipcar.envs.transition import Transition, control_from_action, transition
from slipcar.envs.validate import checked_int
from slipcar.evaluation.between import log_clear
from slipcar.evaluation.controller import (
    Controller,
    check_controller,
    checked_answer,
    controller_name,
    observation_layout,
)
from slipcar.evaluation.executors import open_executor, run
from slipcar.evaluation.limits import time_limit
from slipcar.evaluation.metrics import EpisodeMetrics, Result
from slipcar.evaluation.noise import BLOCK, block_noise, block_starts
from slipcar.evaluation.threads import one_thread


@dataclasses.dataclass(frozen=True)
class Step:
    """One control step of a block.

    Attributes:
        index: k.
        before: where it began, x_k, (rows, 5).
        control: u_k, (rows, 2) [m/s², rad/s²].
        moved: where it led; `moved.state` is x_{k+1}, (rows, 5).
        passed: each substep's states before and after, as components.
        seconds: spent inside `predict`.
        failures: solves that failed so far in each episode, (rows,); None if its state does not
            say.
    """

    index: int
    before: np.ndarray
    control: np.ndarray
    moved: Transition
    passed: list[tuple[Any, Any]]
    seconds: float
    failures: np.ndarray | None


class Counts(NamedTuple):
    """Numbers that say what to run, as Python's own, which every file can hold."""

    episodes: int
    seed: int
    substeps: int
    n_jobs: int


def checked_counts(episodes: int, seed: int, substeps: int, n_jobs: int) -> Counts:
    """The numbers that say what to run; NumPy's integers are numbers, too.

    Raises:
        ValueError: naming the bad one and what is allowed.
    """
    return Counts(
        episodes=checked_int("episodes", episodes, at_least=1),
        seed=checked_int("seed", seed, at_least=0),
        substeps=checked_int("substeps", substeps, at_least=1),
        n_jobs=checked_int("n_jobs", n_jobs, at_least=1),
    )


def evaluate(
    controller: Controller,
    scenario: Scenario | str,
    episodes: int = 10_000,
    seed: int = 0,
    *,
    substeps: int = 1,
    batch_size: int | None = None,
    n_jobs: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Result:
    """Drive many episodes and say what came of them.

    Example:
        >>> from slipcar.evaluation import evaluate
        >>> from slipcar.planner import OpenLoop, plan
        >>> r = evaluate(OpenLoop(plan(scenario)), scenario, episodes=10_000, seed=0)
        >>> r.collision_rate, r.collision_interval, r.total, r.total_se

    The result is the same, bit for bit, for any `batch_size` and `n_jobs`; memory holds the
    per-episode metrics (73 bytes an episode) and one block.

    Args:
        controller: any object with the `predict` of Stable-Baselines3; see
            :class:`slipcar.evaluation.controller.Controller` for what else it may offer.
        scenario: a scenario or the name of one.
        episodes: how many, >= 1.
        seed: of the Brownian paths, >= 0; episode i depends on (seed, i) alone.
        substeps: Euler–Maruyama steps in each control interval.
        batch_size: episodes in one task of a worker, rounded up to whole blocks of 1024; None
            shares them out evenly.
        n_jobs: worker processes (joblib's loky, one thread in each); 1 stays in this process.
        progress: called with the number of episodes finished since the last call.

    Raises:
        ValueError: for a bad argument, or an action of wrong shape or not finite; the message
            names the controller, the step and the episode.
    """
    scenario = Scenario.of(scenario)
    episodes, seed, substeps, n_jobs = checked_counts(episodes, seed, substeps, n_jobs)
    if batch_size is not None:
        batch_size = checked_int("batch_size", batch_size, at_least=1)
    check_controller(controller)
    blocks = -(-episodes // BLOCK)
    if batch_size is None:
        size = BLOCK * min(16, -(-blocks // (4 * n_jobs)))  # some tasks a worker, for balance
    else:
        size = BLOCK * -(-batch_size // BLOCK)
    tasks = [
        Stretch(controller, scenario, first, min(size, episodes - first), seed, substeps)
        for first in range(0, episodes, size)
    ]
    done: dict[int, Measured] = {}
    with open_executor(n_jobs if len(tasks) > 1 else 1) as executor:
        for task, measured, error in run(measure, tasks, executor):
            if error is not None:
                raise error
            done[task.first] = measured
            if progress is not None:
                progress(task.episodes)
    return joined([done[first] for first in sorted(done)], scenario, seed, substeps)


def joined(parts: Sequence[Measured], scenario: Scenario, seed: int, substeps: int) -> Result:
    """Stretches of one row, in order, as one."""
    metrics = EpisodeMetrics.concatenate([part.metrics for part in parts])
    states = [part for part in parts if part.counted]
    return Result(
        metrics=metrics,
        seed=seed,
        substeps=substeps,
        closed_loop=parts[0].closed_loop,
        failures=sum(part.failures for part in states) if states else parts[0].failures,
        inference_time=sum(part.seconds for part in parts) / (len(metrics) * (scenario.nodes - 1)),
        preparation_time=parts[0].preparation_time,
        wall_time=sum(part.wall_time for part in parts),
    )


def sample_paths(
    controller: Controller, scenario: Scenario | str, episodes: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """The first episodes of an evaluation, recorded.

    Returns:
        States (episodes, N, 5) and controls (episodes, N−1, 2), SI units.

    Raises:
        ValueError: as :func:`evaluate`.
    """
    scenario = Scenario.of(scenario)
    episodes, seed, *_ = checked_counts(episodes, seed, 1, 1)
    check_controller(controller)
    states = np.empty((episodes, scenario.nodes, 5))
    controls = np.empty((episodes, scenario.nodes - 1, 2))
    with one_thread():
        for first in range(0, episodes, BLOCK):
            here = slice(first, min(first + BLOCK, episodes))
            wanted = here.stop - here.start
            for step in play(controller, scenario, seed, first // BLOCK, wanted):
                if step.index == 0:
                    states[here, 0] = step.before[:wanted]
                states[here, step.index + 1] = step.moved.state[:wanted]
                controls[here, step.index] = step.control[:wanted]
    return states, controls


def play(
    controller: Controller,
    scenario: Scenario,
    seed: int,
    block: int,
    wanted: int = BLOCK,
    substeps: int = 1,
) -> Iterator[Step]:
    """Step one block from the start to the horizon.

    Args:
        controller: see :class:`Controller`.
        scenario: the world.
        seed: of the Brownian paths.
        block: which block of episodes.
        wanted: its first `wanted` episodes matter; rounded up to what `predict` is given.
        substeps: Euler–Maruyama steps in each control interval.
    """
    chunk = int(getattr(controller, "rows", BLOCK))
    rows = -(-wanted // chunk) * chunk
    chunks = [slice(r, r + chunk) for r in range(0, rows, chunk)]
    hidden: list[Any] = [None] * len(chunks)
    starts = np.ones(chunk, dtype=bool)
    layout = observation_layout(controller)
    check_seen(layout, scenario)
    x = block_starts(seed, block, scenario)[:rows]
    noise = block_noise(seed, block, scenario, substeps)
    for k, variates in enumerate(noise):
        observed = layouts.observe(scenario, layout.kind, scenario.times[k], x, layout.slots)
        control = np.empty((rows, 2))
        seconds = 0.0
        for c, here in enumerate(chunks):
            first = block * BLOCK + here.start
            began = time.perf_counter()
            try:
                answer = controller.predict(
                    observed[here], state=hidden[c], episode_start=starts, deterministic=True
                )
            except Exception as error:
                error.add_note(
                    f"raised by {controller_name(controller)}.predict at step {k}, "
                    f"episodes {first} to {first + chunk - 1}"
                )
                raise
            seconds += time.perf_counter() - began
            action, hidden[c] = checked_answer(controller, scenario, answer, chunk, k, first)
            control[here] = control_from_action(scenario, action, (chunk,))
        passed: list[tuple[Any, Any]] = []

        def add(before: Any, added: Any, passed: list[tuple[Any, Any]] = passed) -> Any:
            after = added_up(before, added)
            passed.append((before, after))
            return after

        moved = transition(scenario, x, control, variates[:rows], add)
        counted = [state.failures for state in hidden if hasattr(state, "failures")]
        failures = np.concatenate(counted) if len(counted) == len(chunks) else None
        yield Step(k, x, control, moved, passed, seconds, failures)
        x = moved.state
        starts = np.zeros(chunk, dtype=bool)


@dataclasses.dataclass(frozen=True)
class Stretch:
    """Episodes in a row, to be driven by one worker.

    Attributes:
        controller: who drives, or a function of the scenario that makes it: then the worker plans.
        scenario: where.
        first: the first episode, a multiple of :data:`BLOCK`.
        episodes: how many.
        seed: of the Brownian paths.
        substeps: Euler–Maruyama steps in each control interval.
        time_limit: seconds that a block of 1024 may take, or None.
    """

    controller: Controller | Callable[[Scenario], Controller]
    scenario: Scenario
    first: int
    episodes: int
    seed: int
    substeps: int = 1
    time_limit: float | None = None


@dataclasses.dataclass(frozen=True)
class Measured:
    """What a stretch came to.

    Attributes:
        metrics: per-episode arrays.
        seconds: spent inside `predict`, for these episodes.
        failures: solves that failed on the way, if the controller's state counts them; else those
            behind the controller (a plan that did not converge is one).
        counted: whether its state counts them, and so stretches add up.
        closed_loop: whether the controller looks at the state.
        preparation_time: seconds of planning or training; nan when unknown.
        wall_time: seconds it took.
    """

    metrics: EpisodeMetrics
    seconds: float
    failures: int
    counted: bool
    closed_loop: bool
    preparation_time: float
    wall_time: float


def measure(stretch: Stretch, tick: Callable[[float], None] | None = None) -> Measured:
    """Drive the episodes of a stretch and measure each.

    Args:
        stretch: which.
        tick: called at each step with the episodes done so far, parts of them counted.

    Raises:
        ValueError: as :func:`evaluate`.
        TimeLimitError: if a block took too long.
    """
    began = time.perf_counter()
    parts, seconds = [], 0.0
    failures: int | None = None
    scenario = stretch.scenario
    controller = _made(stretch)
    h = scenario.dt / stretch.substeps
    for first in range(stretch.first, stretch.first + stretch.episodes, BLOCK):
        wanted = min(BLOCK, stretch.first + stretch.episodes - first)
        effort, obstacle, clear = np.zeros(()), np.zeros(()), np.zeros(())
        clearance = np.full((), np.inf)
        nearest: np.ndarray | None = None
        played = play(controller, scenario, stretch.seed, first // BLOCK, wanted, stretch.substeps)
        with time_limit(stretch.time_limit, f"{wanted} episodes") as look:
            for step in played:
                look()
                if tick is not None:
                    driven = (step.index + 1) / (scenario.nodes - 1)
                    tick(first - stretch.first + driven * wanted)
                moved = step.moved
                effort = effort + moved.effort
                obstacle = obstacle + moved.obstacle
                clearance = np.minimum(clearance, moved.distance)
                if len(step.passed) > 1 or nearest is None:
                    between = [log_clear(scenario, *ends, h) for ends in step.passed]
                else:
                    known = nearest, moved.distance
                    between = [log_clear(scenario, *step.passed[0], h, known)]
                clear = clear + sum(between)
                nearest = moved.distance
                seconds += step.seconds * wanted / len(step.control)
        whole = EpisodeMetrics.of(scenario, effort, obstacle, clearance, clear, moved.state)
        parts.append(whole.first(wanted))
        if step.failures is not None:
            failures = (failures or 0) + int(step.failures[:wanted].sum())
    preparation = getattr(controller, "preparation_time", None)
    return Measured(
        metrics=EpisodeMetrics.concatenate(parts),
        seconds=seconds,
        failures=solver_failures(controller) if failures is None else failures,
        counted=failures is not None,
        closed_loop=bool(getattr(controller, "closed_loop", True)),
        preparation_time=float("nan") if preparation is None else float(preparation),
        wall_time=time.perf_counter() - began,
    )


def _made(stretch: Stretch) -> Controller:
    if callable(getattr(stretch.controller, "predict", None)):
        return stretch.controller  # type: ignore[return-value]
    with time_limit(stretch.time_limit, "making the controller"):
        made = stretch.controller(stretch.scenario)  # type: ignore[operator]
    check_controller(made)
    return made


def solver_failures(controller: Controller) -> int:
    """Solves behind a controller that failed: its `failures`, else 1 for an unconverged plan."""
    counted = getattr(controller, "failures", None)
    if counted is not None:
        return int(counted)
    status = getattr(getattr(controller, "plan", None), "status", None)
    return int(status is not None and not status.ok)

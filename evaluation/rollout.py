"""Monte Carlo: a controller drives many episodes, each along its own Brownian path.

    x_{k+1} = EulerMaruyama(x_k, u_k, ξ_k),   u_k = bounds · clip(predict(observe(t_k, x_k)))

The step is :func:`slipcar.envs.transition.transition`, the same that the environments take.
One block of :data:`slipcar.evaluation.noise.BLOCK` episodes is stepped at a time and always
whole: linear algebra rounds by the shape it is given, so a policy that saw 1000 rows here and
1024 there would not be the same function to the last bit.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
import threadpoolctl

from slipcar.envs import observation as layouts
from slipcar.envs.options import check_slots
from slipcar.envs.scenario import Scenario
from slipcar.envs.transition import Transition, control_from_action, transition
from slipcar.envs.validate import checked_int
from slipcar.evaluation.metrics import EpisodeMetrics
from slipcar.evaluation.noise import BLOCK, block_noise, block_starts


@runtime_checkable
class Controller(Protocol):
    """What is evaluated: an object with the `predict` of Stable-Baselines3.

    Optional attributes:
        observation: `"features"` (default), `"state"` or `"egocentric"`: what `predict` is given.
        obstacle_slots: how many obstacles it is shown besides (default 0).
        closed_loop: whether it looks at the state (default True).
        preparation_time: seconds of planning or training (default unknown).
        failures: solves behind it that failed (default 0).
        fingerprint(): text that identifies its behaviour, so that a stored row can be reused.
        rows: how many episodes `predict` is given at once, a divisor of 1024 (default 1024).
            Always exactly that many, also when fewer episodes are asked for; a controller that
            is slow per row sets 1.
    """

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions in [−1, 1], (rows, 2), and the next hidden state.

        A state may have `failures` (rows,): solves that failed so far in each episode.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Step:
    """One control step of a block.

    Attributes:
        index: k.
        before: where it began, x_k, (rows, 5).
        control: u_k, (rows, 2) [m/s², rad/s²].
        moved: where it led; `moved.state` is x_{k+1}, (rows, 5).
        seconds: spent inside `predict`.
        failures: solves that failed so far in each episode, (rows,); None if its state does not
            say.
    """

    index: int
    before: np.ndarray
    control: np.ndarray
    moved: Transition
    seconds: float
    failures: np.ndarray | None


@dataclasses.dataclass(frozen=True)
class Rollout:
    """What :func:`rollout` measured.

    Attributes:
        metrics: per-episode arrays.
        inference_time: seconds inside `predict` per step and episode.
        failures: solves that failed on the way, if the controller's state counts them; else None.
    """

    metrics: EpisodeMetrics
    inference_time: float
    failures: int | None = None


def check_counts(
    episodes: int, seed: int, substeps: int, batch_size: int | None, n_jobs: int
) -> None:
    """Check the numbers that say what to run.

    Raises:
        ValueError: naming the bad one and what is allowed.
    """
    checked_int("episodes", episodes, at_least=1)
    checked_int("seed", seed, at_least=0)
    checked_int("substeps", substeps, at_least=1)
    checked_int("n_jobs", n_jobs, at_least=1)
    if batch_size is not None:
        checked_int("batch_size", batch_size, at_least=1)


def rollout(
    controller: Controller,
    scenario: Scenario | str,
    episodes: int = 10_000,
    seed: int = 0,
    *,
    substeps: int = 1,
    batch_size: int | None = None,
    n_jobs: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Rollout:
    """Drive `episodes` episodes and measure each.

    The result is the same, bit for bit, for any `batch_size` and `n_jobs`; memory holds the
    per-episode metrics and one block.

    Args:
        controller: see :class:`Controller`.
        scenario: a scenario or the name of one.
        episodes: how many, >= 1.
        seed: of the Brownian paths, >= 0; episode i depends on (seed, i) alone.
        substeps: Euler–Maruyama steps in each control interval.
        batch_size: episodes in one task of a worker, rounded up to whole blocks; None shares
            them out evenly.
        n_jobs: worker processes (joblib's loky, one thread in each); 1 stays in this process.
        progress: called with the number of episodes finished since the last call.

    Raises:
        ValueError: for a bad argument, or an action of wrong shape or not finite; the message
            names the controller, the step and the episode.
    """
    scenario = Scenario.of(scenario)
    check_counts(episodes, seed, substeps, batch_size, n_jobs)
    check_controller(controller)
    blocks = -(-episodes // BLOCK)
    if batch_size is None:
        per_task = min(16, -(-blocks // (4 * n_jobs)))  # some tasks a worker, for balance
    else:
        per_task = -(-batch_size // BLOCK)
    tasks = [range(b, min(b + per_task, blocks)) for b in range(0, blocks, per_task)]
    parts, seconds, rows = [], 0.0, 0
    failures: int | None = None
    common = (controller, scenario, episodes, seed, substeps)
    for part, part_seconds, part_failures in _run(tasks, n_jobs, common):
        parts.append(part)
        seconds += part_seconds
        rows += len(part)
        if part_failures is not None:
            failures = (failures or 0) + part_failures
        if progress is not None:
            progress(len(part))
    steps = scenario.nodes - 1
    return Rollout(EpisodeMetrics.concatenate(parts), seconds / (rows * steps), failures)


def sample_paths(
    controller: Controller, scenario: Scenario | str, episodes: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """The first episodes of an evaluation, recorded.

    Returns:
        States (episodes, N, 5) and controls (episodes, N−1, 2), SI units.

    Raises:
        ValueError: as :func:`rollout`.
    """
    scenario = Scenario.of(scenario)
    checked_int("episodes", episodes, at_least=1)
    checked_int("seed", seed, at_least=0)
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
    check_slots(layout, scenario)
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
            action, hidden[c] = _checked_answer(controller, scenario, answer, chunk, k, first)
            control[here] = control_from_action(scenario, action, (chunk,))
        moved = transition(scenario, x, control, variates[:rows])
        counted = [state.failures for state in hidden if hasattr(state, "failures")]
        failures = np.concatenate(counted) if len(counted) == len(chunks) else None
        yield Step(k, x, control, moved, seconds, failures)
        x = moved.state
        starts = np.zeros(chunk, dtype=bool)


def observation_layout(controller: Controller) -> layouts.Layout:
    """What `predict` is to be given: its `observation` and `obstacle_slots`, else what fits.

    Raises:
        ValueError: for an unknown kind, or a space that no observation fits.
    """
    named = getattr(controller, "observation", None)
    if isinstance(named, str):
        return layouts.Layout(named, getattr(controller, "obstacle_slots", 0))
    # A Stable-Baselines3 model says what it was trained on by its space alone.
    shape = getattr(getattr(controller, "observation_space", None), "shape", None)
    if shape is None:
        return layouts.Layout()
    try:
        return layouts.Layout.of_size(shape[0] if len(shape) == 1 else 0)
    except ValueError as error:
        raise ValueError(
            f"{controller_name(controller)} expects observations of shape {shape}: {error}"
        ) from None


def controller_name(controller: Any) -> str:
    """What an error calls it."""
    return type(controller).__name__


def check_controller(controller: Any) -> None:
    """Raises ValueError unless `controller` has a `predict` and sensible optional attributes."""
    if not callable(getattr(controller, "predict", None)):
        raise ValueError(
            f"a controller is an object with predict(observation, state, episode_start, "
            f"deterministic), which {controller!r} has not"
        )
    observation_layout(controller)
    rows = checked_int("rows", getattr(controller, "rows", BLOCK), at_least=1, at_most=BLOCK)
    if BLOCK % rows:
        raise ValueError(f"{controller_name(controller)}.rows must divide {BLOCK}, not {rows}")


def _run(
    tasks: list[range], n_jobs: int, common: tuple
) -> Iterator[tuple[EpisodeMetrics, float, int | None]]:
    if n_jobs == 1 or len(tasks) == 1:
        with one_thread():
            for task in tasks:
                yield _measure(task, *common)
        return
    import joblib

    with joblib.parallel_config(backend="loky", n_jobs=n_jobs, inner_max_num_threads=1):
        yield from joblib.Parallel(return_as="generator")(
            joblib.delayed(_measure)(task, *common) for task in tasks
        )


def _measure(
    blocks: range,
    controller: Controller,
    scenario: Scenario,
    episodes: int,
    seed: int,
    substeps: int,
) -> tuple[EpisodeMetrics, float, int | None]:
    """Metrics of the episodes in `blocks`; seconds of `predict` and failures they account for."""
    parts, seconds = [], 0.0
    failures: int | None = None
    for block in blocks:
        wanted = min(BLOCK, episodes - block * BLOCK)
        effort, obstacle = np.zeros(()), np.zeros(())
        clearance = np.full((), np.inf)
        for step in play(controller, scenario, seed, block, wanted, substeps):
            moved = step.moved
            effort = effort + moved.effort
            obstacle = obstacle + moved.obstacle
            clearance = np.minimum(clearance, moved.distance)
            seconds += step.seconds * wanted / len(step.control)
        whole = EpisodeMetrics.of(scenario, effort, obstacle, clearance, moved.state)
        parts.append(whole.first(wanted))
        if step.failures is not None:
            failures = (failures or 0) + int(step.failures[:wanted].sum())
    return EpisodeMetrics.concatenate(parts), seconds, failures


def _checked_answer(
    controller: Controller, scenario: Scenario, answer: Any, rows: int, k: int, first: int
) -> tuple[np.ndarray, Any]:
    name = controller_name(controller)
    where = f"at step {k} (t = {scenario.times[k]:.4g} s)"
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise ValueError(
            f"{name}.predict must return (action, state), not {type(answer).__name__} {where}"
        )
    try:
        action = np.asarray(answer[0], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}.predict returned no array of numbers {where}: {error}") from error
    if action.shape != (rows, 2):
        raise ValueError(
            f"{name}.predict must return actions of shape {(rows, 2)}, not {action.shape}, "
            f"{where}, episodes {first} to {first + rows - 1}"
        )
    if not np.isfinite(action).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(action))[0])
        raise ValueError(
            f"{name}.predict returned {action[row, column]} for action[{column}] {where}, "
            f"episode {first + row}; actions must be finite (they are clipped to [-1, 1])"
        )
    return action, answer[1]


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """BLAS and torch on one thread, as in the workers.

    Threads split matrix products, and so the order of their sums, by how many there are; for
    the small matrices of a policy one is faster as well.
    """
    with threadpoolctl.threadpool_limits(1):
        torch = sys.modules.get("torch")
        if torch is None:
            yield
            return
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(threads)

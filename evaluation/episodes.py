"""Episodes as an environment would have returned them, a block at a time.

    for part in record(Feedback(plan(scenario)), scenario, episodes=1000):
        part.observations, part.actions, part.rewards, part.infos

Episode i of a seed is driven along the Brownian path that :func:`slipcar.evaluation.evaluate`
drives it along, so its return is minus the cost found there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from slipcar.envs import observation as layouts
from slipcar.envs.cost import arrived
from slipcar.envs.observation import Layout
from slipcar.envs.options import layout_for
from slipcar.envs.scenario import Scenario
from slipcar.envs.validate import checked_float, checked_int
from slipcar.evaluation.controller import Controller, check_controller, controller_name
from slipcar.evaluation.noise import BLOCK
from slipcar.evaluation.rollout import play
from slipcar.evaluation.threads import one_thread

#: Keeps exploration apart from the Brownian paths, which have the entropy (seed, block).
_EXPLORATION = 0x0DA7A


@dataclasses.dataclass(frozen=True)
class Episodes:
    """Whole episodes (E of them, T = N − 1 steps each), as the environment returns them.

    Attributes:
        observations: (E, T+1, d) float32; the last is that of the terminal state.
        actions: what was played, exploration included, (E, T, 2) float32 in [−1, 1].
        rewards: (E, T).
        infos: name -> (E, T+1, ...): row 0 is what `reset` gives, row k+1 what step k gives.
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    infos: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.rewards)


def record(
    controller: Controller,
    scenario: Scenario | str,
    episodes: int,
    seed: int = 0,
    *,
    observation: str = "features",
    obstacle_slots: int = 0,
    exploration_noise: float = 0.0,
) -> Iterator[Episodes]:
    """Drive episodes and yield what the environment would have returned, a block at a time.

    Args:
        controller: see :class:`slipcar.evaluation.rollout.Controller`; it is given the kind of
            observation it asks for, whatever is recorded.
        scenario: a scenario or the name of one.
        episodes: how many, >= 1.
        seed: of the Brownian paths and of the exploration, >= 0; episode i depends on
            (seed, i) alone.
        observation: the kind that is recorded, one of `slipcar.envs.observation.KINDS`.
        obstacle_slots: how many obstacles it shows, the nearest first.
        exploration_noise: standard deviation of normal noise on each action, >= 0; the sum is
            clipped to [−1, 1].

    Raises:
        ValueError: for a bad argument, or an action of wrong shape or not finite.
    """
    scenario = Scenario.of(scenario)
    episodes, seed, exploration_noise = checked_recording(episodes, seed, exploration_noise)
    layout = layout_for(scenario, observation, obstacle_slots)
    scenario.action_scale  # noqa: B018  raises now if the scenario is unbounded
    check_controller(controller)
    # Its checks are made when it is called, not when the first block is asked for.
    return _blocks(controller, scenario, episodes, seed, layout, exploration_noise)


def checked_recording(episodes: int, seed: int, exploration_noise: float) -> tuple[int, int, float]:
    """These as Python's numbers; ValueError for what :func:`record` cannot do, naming the value."""
    return (
        checked_int("episodes", episodes, at_least=1),
        checked_int("seed", seed, at_least=0),
        checked_float("exploration_noise", exploration_noise, at_least=0.0),
    )


def _blocks(
    controller: Controller,
    scenario: Scenario,
    episodes: int,
    seed: int,
    layout: Layout,
    exploration_noise: float,
) -> Iterator[Episodes]:
    with one_thread():
        for block in range(-(-episodes // BLOCK)):
            wanted = min(BLOCK, episodes - block * BLOCK)
            yield _record_block(
                controller, scenario, seed, block, wanted, layout, exploration_noise
            )


class _Recorded:
    """A controller whose actions are made those of the environment's action space and kept.

    Attributes:
        actions: what was played, (rows, T, 2) float32, filled as the episodes go.
    """

    def __init__(self, controller: Controller, exploration: np.ndarray) -> None:
        self.controller = controller
        self.exploration = exploration
        self.actions = np.empty(exploration.shape, dtype=np.float32)
        self._begun = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.controller, name)  # rows, observation, and whatever else it says

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> Any:
        if state is None:
            first, step, hidden = self._begun, 0, None
            self._begun += len(observation)
        else:
            first, step, hidden = state
        answer = self.controller.predict(
            observation, state=hidden, episode_start=episode_start, deterministic=deterministic
        )
        if not isinstance(answer, tuple) or len(answer) != 2:
            return answer  # `play` says what is wrong with it
        action, hidden = answer
        if np.shape(action) != (len(observation), 2):
            return action, hidden
        rows = slice(first, first + len(observation))
        played = np.asarray(action, dtype=np.float64) + self.exploration[rows, step]
        self.actions[rows, step] = np.clip(played, -1.0, 1.0)
        return self.actions[rows, step], (first, step + 1, hidden)


def _record_block(
    controller: Controller,
    scenario: Scenario,
    seed: int,
    block: int,
    wanted: int,
    layout: Layout,
    exploration_noise: float,
) -> Episodes:
    T = scenario.nodes - 1
    exploration = np.zeros((BLOCK, T, 2))
    if exploration_noise > 0.0:
        entropy = np.random.SeedSequence((seed, block, _EXPLORATION))
        rng = np.random.default_rng(entropy)
        exploration = exploration_noise * rng.standard_normal(exploration.shape)
    recorded = _Recorded(controller, exploration)
    states = np.empty((wanted, T + 1, 5))
    controls = np.zeros((wanted, T + 1, 2))
    effort, obstacle = np.zeros((wanted, T + 1)), np.zeros((wanted, T + 1))
    distance = np.empty((wanted, T + 1))
    try:
        for step in play(recorded, scenario, seed, block, wanted):
            k, moved = step.index, step.moved
            if k == 0:
                states[:, 0] = step.before[:wanted]
                distance[:, 0] = scenario.signed_distance(states[:, 0])
            states[:, k + 1] = moved.state[:wanted]
            controls[:, k + 1] = step.control[:wanted]
            effort[:, k + 1] = moved.effort[:wanted]
            obstacle[:, k + 1] = moved.obstacle[:wanted]
            distance[:, k + 1] = moved.distance[:wanted]
    except ValueError as error:
        error.add_note(f"the controller recorded is {controller_name(controller)}")
        raise
    goal = np.zeros((wanted, T + 1))
    goal[:, -1] = scenario.goal_cost(states[:, -1])
    # A start is no node of the path: its distance is told at reset and then forgotten.
    clearance = distance.copy()
    np.minimum.accumulate(distance[:, 1:], axis=1, out=clearance[:, 1:])
    inside = distance < 0.0
    inside[:, 0] = False
    collision = np.logical_or.accumulate(inside, axis=1)
    success = np.zeros((wanted, T + 1), dtype=bool)
    at_end = arrived(states[:, -1].T, scenario.goal, scenario.goal_tolerance)
    success[:, -1] = at_end & ~collision[:, -1]
    times = np.arange(T + 1) * scenario.dt  # the environment's clock
    return Episodes(
        observations=layouts.observe(scenario, layout.kind, times, states, layout.slots),
        actions=recorded.actions[:wanted],
        rewards=-(effort + obstacle + goal)[:, 1:],
        infos={
            "effort": effort,
            "obstacle": obstacle,
            "goal": goal,
            "collision": collision,
            "clearance": clearance,
            "control": controls,
            "cost": inside.astype(np.float64),
            "is_success": success,
        },
    )

"""A quick look at how well a policy drives, for use while it learns.

The full comparison, with intervals and many controllers, is `slipcar.evaluation`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np
from gymnasium.vector import AutoresetMode

from slipcar.envs import Scenario, SlipCarVectorEnv
from slipcar.envs.validate import checked_int


class Predicts(Protocol):
    """Anything with Stable-Baselines3's `predict`."""

    def predict(self, observation: np.ndarray) -> tuple[np.ndarray, Any]:
        """Actions (n, 2) for features (n, 12)."""


@dataclasses.dataclass(frozen=True)
class Score:
    """Means over episodes.

    Attributes:
        total: mean path cost, effort + obstacle + goal.
        total_error: its standard error.
        effort: mean effort.
        obstacle: mean obstacle cost.
        goal: mean goal cost.
        collision_rate: share of episodes that touched an obstacle.
        position_rms: root mean square distance to the goal at the end [m].
        episodes: how many.
    """

    total: float
    total_error: float
    effort: float
    obstacle: float
    goal: float
    collision_rate: float
    position_rms: float
    episodes: int


def score(controller: Predicts, scenario: Scenario | str, episodes: int, seed: int) -> Score:
    """Drive `episodes` episodes at once, with seeds `seed`, `seed + 1`, …

    Equal seeds give equal noise, so scores of two policies can be compared closely.

    Args:
        controller: sees `features`.
        scenario: a scenario or a name.
        episodes: at least 1; memory grows with it (1 kB each).
        seed: non-negative.

    Raises:
        ValueError: for a bad argument.
    """
    scenario = Scenario.of(scenario)
    checked_int("episodes", episodes, at_least=1)
    checked_int("seed", seed, at_least=0)
    env = SlipCarVectorEnv(episodes, scenario, autoreset_mode=AutoresetMode.DISABLED)
    observation, info = env.reset(seed=seed)
    parts = np.zeros((3, episodes))
    for _ in range(scenario.nodes - 1):
        action, _ = controller.predict(observation)
        observation, _, _, _, info = env.step(action)
        parts += (info["effort"], info["obstacle"], info["goal"])
    _, x = scenario.decode_observation(observation)
    total = parts.sum(axis=0)
    miss = x[:, :2] - scenario.goal[:2]
    effort, obstacle, goal = parts.mean(axis=1).tolist()
    return Score(
        total=float(total.mean()),
        total_error=float(total.std() / np.sqrt(episodes)),
        effort=effort,
        obstacle=obstacle,
        goal=goal,
        collision_rate=float(info["collision"].mean()),
        position_rms=float(np.sqrt((miss * miss).sum(axis=-1).mean())),
        episodes=episodes,
    )

"""A quick look at how well a policy drives, for use while it learns.

The full comparison, with intervals and many controllers, is `slipcar.evaluation`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from gymnasium.vector import AutoresetMode

from slipcar.envs import Scenario, SlipCarVectorEnv
from slipcar.envs.sources import Source, base_of, most_obstacles, source_of
from slipcar.envs.validate import checked_int


class Predicts(Protocol):
    """Anything with Stable-Baselines3's `predict`."""

    def predict(self, observation: np.ndarray) -> tuple[np.ndarray, Any]:
        """Actions (n, 2) for observations (n, d)."""


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


def score(
    controller: Predicts,
    scenario: Source | str | Sequence[Scenario],
    episodes: int,
    seed: int,
) -> Score:
    """Drive `episodes` episodes at once, with seeds `seed`, `seed + 1`, …

    Equal seeds give equal noise, so scores of two policies can be compared closely.

    Args:
        controller: sees what its `observation` and `obstacle_slots` name, else `features`.
        scenario: a scenario, a name, a family (every episode in a world of its own), or a sequence
            of scenarios with equal `nodes` and bounds: episode i is in the one numbered i modulo
            their number.
        episodes: at least 1; memory grows with it (1 kB each).
        seed: non-negative.

    Raises:
        ValueError: for a bad argument.
    """
    episodes = checked_int("episodes", episodes, at_least=1)
    seed = checked_int("seed", seed, at_least=0)
    kind = getattr(controller, "observation", "features")
    slots = getattr(controller, "obstacle_slots", 0)
    several = isinstance(scenario, Sequence) and not isinstance(scenario, str)
    given: Any = scenario if several else [scenario]
    worlds = [Scenario.of(world) if several else source_of(world) for world in given]
    if not worlds:
        raise ValueError("scenario must be one or more, not an empty sequence")
    nodes = {base_of(world).nodes for world in worlds}
    if len(nodes) > 1:
        raise ValueError(f"scenarios driven side by side need equal nodes, not {sorted(nodes)}")
    first = max(worlds, key=most_obstacles)  # so that all of them fit
    env = SlipCarVectorEnv(episodes, first, kind, slots, autoreset_mode=AutoresetMode.DISABLED)
    each = [worlds[i % len(worlds)] for i in range(episodes)]
    observation, info = env.reset(seed=seed, options={"scenario": each} if several else None)
    parts = np.zeros((3, episodes))
    for _ in range(nodes.pop() - 1):
        action, _ = controller.predict(observation)
        observation, _, _, _, info = env.step(action)
        parts += (info["effort"], info["obstacle"], info["goal"])
    total = parts.sum(axis=0)
    goals = np.array([world.goal[:2] for world in env.scenarios])
    miss = env.states[:, :2] - goals
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

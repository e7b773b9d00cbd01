"""Other goals: a reward for success alone."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from slipcar.envs.vector import SlipCarVectorEnv


class SparseSuccess(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Reward 1 at the end of an episode that succeeds, else 0.

    Success is to arrive within the scenario's `goal_tolerance` without a collision
    (`info["is_success"]`). The costs stay in `info`.
    """

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """As the environment's, with the sparse reward."""
        observation, _, terminated, truncated, info = self.env.step(action)
        return observation, float(info["is_success"]), terminated, truncated, info


class VectorSparseSuccess(VectorWrapper):
    """:class:`SparseSuccess` for the native vector environment, in any autoreset mode.

    Raises:
        ValueError: for an environment without this package's `info`.
    """

    def __init__(self, env: VectorEnv) -> None:
        super().__init__(env)
        if not isinstance(env.unwrapped, SlipCarVectorEnv):
            raise ValueError(f"VectorSparseSuccess wraps a SlipCarVectorEnv, not {env.unwrapped!r}")

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """As the environment's, with the sparse reward (num_envs,)."""
        observation, reward, terminated, truncated, info = self.env.step(actions)
        # With SAME_STEP, `info` tells of the episode that has just begun.
        same_step = self.env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        last = info.get("final_info", info) if same_step else info
        return observation, last["is_success"].astype(reward.dtype), terminated, truncated, info

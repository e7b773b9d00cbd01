"""Stable-Baselines3's `VecEnv` over the native vector environment.

The two conventions differ in three ways, and this adapter is the translation:

* SB3 resets finished episodes inside `step` and hands the last observation over in
  `info["terminal_observation"]`: our SAME_STEP autoreset, `final_obs`.
* SB3 asks for `info["TimeLimit.truncated"]`: False at the horizon, which belongs to the problem
  (bootstrapping there makes learning fail), True where `max_episode_steps` cut an episode off.
* SB3 wants one dictionary per sub-environment. Only those of finished episodes are filled,
  with the `"episode"` entry its Monitor would write, so no Python loop runs over
  sub-environments in mid-episode.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from slipcar.envs import SlipCarVectorEnv

#: What is summed over an episode, beside the reward.
_SUMMED = ("effort", "obstacle", "cost")


class SB3VecEnv(VecEnv):
    """`SlipCarVectorEnv` as Stable-Baselines3 wants it.

    Rewards are float32 and multiplied by `reward_scale`; `info["episode"]["r"]` at an
    episode's end is the unscaled return. At an episode's end `info` also holds the whole
    episode's `effort`, `obstacle` and `cost` (nodes inside an obstacle), its `goal` cost,
    `collision`, `clearance` and `is_success`, which Stable-Baselines3 logs.

    Args:
        env: the native environment, with SAME_STEP autoreset.
        reward_scale: factor on the rewards, finite and > 0.

    Raises:
        ValueError: for another autoreset mode or a bad scale.
    """

    def __init__(self, env: SlipCarVectorEnv, reward_scale: float = 1.0) -> None:
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                f"autoreset_mode must be {AutoresetMode.SAME_STEP.value!r} for "
                f"Stable-Baselines3, not {env.autoreset_mode.value!r}"
            )
        if not (np.isfinite(reward_scale) and reward_scale > 0.0):
            raise ValueError(f"reward_scale must be finite and > 0, not {reward_scale!r}")
        self.env = env
        self.reward_scale = float(reward_scale)
        self._actions = np.zeros((env.num_envs, 2), dtype=np.float32)
        self._totals = np.zeros((4, env.num_envs))  # return and `_SUMMED` of the episode
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._began = time.perf_counter()
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.render_mode = env.render_mode

    def reset(self) -> np.ndarray:
        """Start new episodes everywhere, with the seeds and options that were set, if any.

        Options are those of a single environment; a key must be given to all or to none.

        Returns:
            Observations, (num_envs, d) float32.

        Raises:
            ValueError: for an unknown option, or one that not all are given.
        """
        seeds = list(self._seeds) if any(s is not None for s in self._seeds) else None
        given = self._options
        self._reset_seeds()
        self._reset_options()
        observation, _ = self.env.reset(seed=seeds, options=_together(given))
        self._totals[:] = 0.0
        self._lengths[:] = 0
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions, (num_envs, 2), for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """One control interval everywhere.

        Returns:
            Observations (num_envs, d); scaled rewards (num_envs,) float32; whether episodes
            ended (num_envs,); one dictionary each, empty but for ended episodes.

        Raises:
            ValueError: for misshapen or non-finite actions.
        """
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        # Where an episode ended, `info` tells of the new one and `final_info` of the old.
        last = info.get("final_info")
        for row, name in zip(self._totals[1:], _SUMMED, strict=True):
            row += info[name] if last is None else np.where(done, last[name], info[name])
        self._totals[0] += reward
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if last is not None:
            for i in np.flatnonzero(done):
                infos[i] = self._end_of_episode(int(i), info["final_obs"][i], last)
                infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            self._totals[:, done] = 0.0
            self._lengths[done] = 0
        return observation, (reward * self.reward_scale).astype(np.float32), done, infos

    def _end_of_episode(
        self, i: int, observation: np.ndarray, last: dict[str, np.ndarray]
    ) -> dict[str, Any]:
        total, *sums = self._totals[:, i].tolist()
        seconds = round(time.perf_counter() - self._began, 6)
        return {
            "terminal_observation": observation,
            "episode": {"r": total, "l": int(self._lengths[i]), "t": seconds},
            **dict(zip(_SUMMED, sums, strict=True)),
            "goal": float(last["goal"][i]),
            "collision": bool(last["collision"][i]),
            "clearance": float(last["clearance"][i]),
            "is_success": bool(last["is_success"][i]),
        }

    def close(self) -> None:
        """Close the native environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """The native environment's attribute, once per index: sub-environments share it.

        Raises:
            AttributeError: if there is none of that name.
        """
        value = getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(
        self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None
    ) -> None:
        """Refused: sub-environments share everything but their random generators.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"cannot set {attr_name!r}: sub-environments share attributes")

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: int | Iterable[int] | None = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Refused: sub-environments are rows of arrays and have no methods of their own.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"cannot call {method_name!r} on one sub-environment")

    def env_is_wrapped(
        self,
        wrapper_class: Callable[..., gym.Wrapper[Any, Any, Any, Any]],
        indices: int | Iterable[int] | None = None,
    ) -> list[bool]:
        """True for Monitor, whose `info["episode"]` with unscaled returns is here; else False."""
        wrapped = isinstance(wrapper_class, type) and issubclass(wrapper_class, Monitor)
        return [wrapped for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """One picture (H, W, 3) each where the environment was made to draw them, else None."""
        if self.env.render_mode != "rgb_array":
            return [None] * self.num_envs
        return list(self.env.render() or [])


def _together(options: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The options of all sub-environments as those of the native environment."""
    keys = {key for given in options for key in given}
    for key in keys:
        missing = [i for i, given in enumerate(options) if key not in given]
        if missing:
            raise ValueError(
                f"option {key!r} must be given to all sub-environments or to none; {missing[:10]} "
                "have none"
            )
    merged: dict[str, Any] = {key: [given[key] for given in options] for key in keys}
    return {k: v if k == "scenario" else np.asarray(v) for k, v in merged.items()}

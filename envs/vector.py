"""`SlipCar-v0` as a native vector environment: one array operation steps all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from slipcar.envs import observation as layouts
from slipcar.envs.scenario import Scenario
from slipcar.envs.slip_car import RENDER_FPS
from slipcar.envs.transition import control_from_action, draw_noise, transition
from slipcar.envs.validate import checked_int


class SlipCarVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many `SlipCar-v0` at once; see :class:`slipcar.envs.SlipCarEnv` for the task.

    Each sub-environment has a generator of its own, seeded `seed + i` as Gymnasium's
    `SyncVectorEnv` does, so its paths depend on that seed alone and equal the single
    environment's.

    Args:
        num_envs: how many, at least 1.
        scenario: shared by all; a :class:`Scenario` or a name.
        observation: `"features"` or `"state"`.
        substeps: Euler–Maruyama steps per control interval.
        terminate_on_collision: see `SlipCarEnv`.
        autoreset_mode: NEXT_STEP (Gymnasium's default), SAME_STEP or DISABLED; the enum or
            its value (`"NextStep"`, `"SameStep"`, `"Disabled"`).

    Raises:
        ValueError: naming a bad argument.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | str = "paper",
        observation: str = "features",
        substeps: int = 1,
        terminate_on_collision: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            allowed = [mode.value for mode in AutoresetMode]
            raise ValueError(
                f"unknown autoreset_mode {autoreset_mode!r}; allowed are {allowed}"
            ) from None
        self.num_envs = checked_int("num_envs", num_envs, at_least=1)
        self.scenario = Scenario.of(scenario)
        self.observation = layouts.check_kind(observation)
        self.substeps = checked_int("substeps", substeps, at_least=1)
        self.terminate_on_collision = bool(terminate_on_collision)
        self.scenario.action_scale  # noqa: B018  raises now if the scenario is unbounded
        self.metadata = {
            "render_modes": [],
            "render_fps": RENDER_FPS,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.single_observation_space = layouts.observation_space(self.scenario, self.observation)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._rngs: list[np.random.Generator | None] = [None] * self.num_envs
        self._ready = False
        steps = self.scenario.nodes - 1
        # Steps first, so that the noise of one step of all environments is contiguous.
        self._noise = np.empty((steps, self.num_envs, self.substeps, 3))
        self._x = np.tile(self.scenario.start, (self.num_envs, 1))
        self._steps = np.zeros(self.num_envs, dtype=np.int64)
        self._distance = np.full(self.num_envs, np.inf)
        self._over = np.ones(self.num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start episodes in all sub-environments, or in those of `options["reset_mask"]`.

        Args:
            seed: None keeps the generators (or seeds them from the system at first), an int
                seeds sub-environment i with `seed + i`, a list gives one seed each.
            options: `reset_mask`, a (num_envs,) bool array with at least one True.

        Raises:
            ValueError: for an unknown option, a bad mask or a list of the wrong length.
        """
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        if options:
            raise ValueError(f"unknown reset options {sorted(options)}; known is 'reset_mask'")
        if mask is None:
            mask = np.ones(self.num_envs, dtype=bool)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"reset_mask must be a bool array of shape ({self.num_envs},) with at least one "
                f"True, not {mask.dtype} of shape {mask.shape}"
            )
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + i for i in range(self.num_envs)]
        if seed is not None and np.asarray(seed, dtype=object).shape != (self.num_envs,):
            raise ValueError(f"seed must be None, an int or {self.num_envs} of them, not {seed!r}")
        if seed is not None:
            for i in np.flatnonzero(mask):
                if seed[i] is not None:
                    self._rngs[i] = seeding.np_random(seed[i])[0]
        self._ready = True
        self._start_episodes(mask)
        return self._observe(), self._info_at_start(mask)

    def _start_episodes(self, mask: np.ndarray) -> None:
        for i in np.flatnonzero(mask):
            rng = self._rngs[i]
            if rng is None:  # never seeded: from the system's entropy
                rng = self._rngs[i] = seeding.np_random()[0]
            self._noise[:, i] = draw_noise(rng, self.scenario, self.substeps)
        self._x[mask] = self.scenario.start
        self._steps[mask] = 0
        self._distance[mask] = self.scenario.signed_distance(self.scenario.start)
        self._over[mask] = False

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control interval in every sub-environment.

        Raises:
            ValueError: for misshapen or non-finite actions, naming the index.
            ResetNeeded: before the first reset, or, with DISABLED, where an episode is over.
        """
        if not self._ready:
            raise ResetNeeded("call reset() before step()")
        resetting = self._over
        if self.autoreset_mode is AutoresetMode.DISABLED and resetting.any():
            raise ResetNeeded(
                f"sub-environments {np.flatnonzero(resetting).tolist()} are over: reset them "
                "with options={'reset_mask': ...} before step()"
            )
        u = control_from_action(self.scenario, actions, (self.num_envs,))
        if resetting.any():  # NEXT_STEP: this call starts their episodes and ignores the action
            started = resetting.copy()
            self._start_episodes(started)
            running = ~started
        else:
            started, running = None, None
        noise = self._noise_now()
        moved = transition(self.scenario, self._x, u, noise)
        effort, obstacle = moved.effort, moved.obstacle
        if running is None:
            self._x = moved.state
            self._steps += 1
            np.minimum(self._distance, moved.distance, out=self._distance)
        else:
            self._x[running] = moved.state[running]
            self._steps[running] += 1
            self._distance[running] = np.minimum(self._distance, moved.distance)[running]
            effort, obstacle = np.where(running, effort, 0.0), np.where(running, obstacle, 0.0)
            u[started] = 0.0
        over = self._steps == self.scenario.nodes - 1
        if self.terminate_on_collision:
            over |= self._distance < 0.0
            if started is not None:
                over &= running
        self._over = over.copy()  # _start_episodes writes to it
        any_over = bool(over.any())
        goal = np.zeros(self.num_envs)
        if any_over:
            goal[over] = self.scenario.goal_cost(self._x[over])
        info = self._info(u, effort, obstacle, goal)
        reward = -(effort + obstacle + goal)
        observation = self._observe()
        if any_over and self.autoreset_mode is AutoresetMode.SAME_STEP:
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(over):
                final[i] = observation[i].copy()
            self._start_episodes(over)
            fresh = self._info_at_start(over)
            info = {
                **{k: _choose(over, fresh[k], info[k]) for k in info},
                "final_obs": final,
                "_final_obs": over.copy(),
                "final_info": {k: _masked(over, info[k]) for k in info},
                "_final_info": over.copy(),
            }
            observation = self._observe()
        return observation, reward, over, np.zeros(self.num_envs, dtype=bool), info

    def _noise_now(self) -> np.ndarray:
        first = self._steps[0]
        if (self._steps == first).all():  # always, unless episodes end at collisions
            return self._noise[first]
        return self._noise[self._steps, np.arange(self.num_envs)]

    def _observe(self) -> np.ndarray:
        t = self._steps * self.scenario.dt
        return layouts.observe(self.scenario, self.observation, t, self._x)

    def _info_at_start(self, here: np.ndarray) -> dict[str, Any]:
        nothing = np.zeros(self.num_envs)
        return self._info(np.zeros((self.num_envs, 2)), nothing, nothing, nothing, here)

    def _info(
        self,
        u: np.ndarray,
        effort: np.ndarray,
        obstacle: np.ndarray,
        goal: np.ndarray,
        here: np.ndarray | None = None,
    ) -> dict[str, Any]:
        values = {
            "effort": effort,
            "obstacle": obstacle,
            "goal": goal,
            "collision": self._distance < 0.0,
            "clearance": self._distance.copy(),
            "control": u,
        }
        here = np.ones(self.num_envs, dtype=bool) if here is None else here
        return {**values, **{f"_{name}": here.copy() for name in values}}


def _choose(mask: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)


def _masked(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    return _choose(mask, values, np.zeros_like(values))

"""`SlipCar-v0` as a native vector environment: one array operation steps all of them."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from slipcar.envs import observation as layouts
from slipcar.envs.arrays import ARRAYS
from slipcar.envs.car import NOISE_DIM, STATE_DIM
from slipcar.envs.cost import arrived
from slipcar.envs.episode import read_episodes, words_for_episode
from slipcar.envs.fleet import Worlds
from slipcar.envs.noise import Tapes, generators
from slipcar.envs.noise_store import NoiseStore
from slipcar.envs.options import (
    RENDER_MODES,
    autoreset_mode_of,
    check_render_mode,
    check_source,
    checked_flag,
    checked_start,
    dtype_of,
    layout_for,
    masked,
    read_options,
)
from slipcar.envs.parameters import Parameters
from slipcar.envs.pictures.gallery import Gallery
from slipcar.envs.scenario import Scenario
from slipcar.envs.slip_car import RENDER_FPS
from slipcar.envs.sources import Source, base_of, chosen, longest_horizon, source_of
from slipcar.envs.spec import PlainSpec
from slipcar.envs.transition import Moved, goal_cost, limited_action, proximity, step
from slipcar.envs.validate import checked_array, checked_int
from slipcar.envs.vector_info import info_at_start, restarted, step_info

#: Cars whose step is computed at a time.
_TOGETHER = 4096


class SlipCarVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many `SlipCar-v0` at once; see :class:`slipcar.envs.SlipCarEnv` for the task.

    Each sub-environment has a generator of its own, seeded `seed + i` as Gymnasium's
    `SyncVectorEnv` does, so its paths depend on that seed alone and equal the single
    environment's. With a family each draws a new world for every episode.

    States and rewards are float64. What a step adds to them is computed in float32 unless told
    otherwise: twice as fast, and some 1e-6 m off at the end of an episode
    (`benchmarks/run.py --only environment` measures it). Obstacles and the goal are then seen from
    a position rounded to 6e-8 of its distance from the origin: in a world 10 km away, by 1 mm.

    Args:
        num_envs: how many, at least 1.
        scenario: shared by all: a :class:`Scenario`, a name, JSON text or data; or a
            :class:`Family` or `"family:NAME"`.
        observation: `"features"`, `"state"` or `"egocentric"`.
        obstacle_slots: how many obstacles an observation shows; see `SlipCarEnv`.
        substeps: Euler–Maruyama steps per control interval.
        terminate_on_collision: see `SlipCarEnv`.
        autoreset_mode: NEXT_STEP (Gymnasium's default), SAME_STEP or DISABLED; the enum or
            its value (`"NextStep"`, `"SameStep"`, `"Disabled"`).
        dtype: `"float32"` or `"float64"`, of what a step adds.
        render_mode: `"rgb_array"`, one picture for each sub-environment; `"human"`, a window
            with the first sixteen side by side; or None.
        max_episode_steps: cut episodes off after so many steps, as Gymnasium's `TimeLimit` does:
            `truncated`, with the goal not charged unless the horizon is reached. By default, or
            with −1, they end at the horizon alone.

    Raises:
        ValueError: naming a bad argument.
    """

    spec: Any = PlainSpec()

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Any = "paper",
        observation: str = "features",
        obstacle_slots: int | None = None,
        substeps: int = 1,
        terminate_on_collision: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        dtype: str = "float32",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ) -> None:
        self.autoreset_mode = autoreset_mode_of(autoreset_mode)
        self.metadata = {
            "render_modes": list(RENDER_MODES),
            "render_fps": RENDER_FPS,
            "autoreset_mode": self.autoreset_mode,
        }
        self.render_mode = check_render_mode(render_mode)
        self._dtype = dtype_of(dtype)
        self.num_envs = checked_int("num_envs", num_envs, at_least=1)
        self.layout = layout_for(source_of(scenario), observation, obstacle_slots)
        self.substeps = checked_int("substeps", substeps, at_least=1)
        self.terminate_on_collision = checked_flag("terminate_on_collision", terminate_on_collision)
        self._sources: list[Source] = [source_of(scenario)]
        self._source_of = np.zeros(self.num_envs, dtype=np.int64)
        base = base_of(self._sources[0])
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        horizon = longest_horizon(self._sources[0])
        self.single_observation_space = self.layout.space(horizon)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._tapes = Tapes(self.num_envs)
        self._worlds = Worlds(self.num_envs, self._dtype, base)
        self._ready = False
        self._everyone = np.arange(self.num_envs)
        #: What is computed at a time, small enough for the cache.
        self._parts = _parts(self.num_envs)
        self._noise = NoiseStore(self.num_envs, base.nodes - 1, self.substeps, base.noise_dim)
        #: States, (5, num_envs), and the same as increments and observations take them.
        self._x = self._worlds.start.copy()
        self._rounded = self._x.astype(self._dtype)
        self._step = np.zeros(self.num_envs, dtype=np.int64)
        #: The step that all are at, or None where they differ.
        self._common_step: int | None = 0
        self._distance = np.full(self.num_envs, np.inf, dtype=self._dtype)
        #: Those whose episode is over, or has not begun: indices.
        self._waiting = self._everyone
        self._began = np.zeros(self.num_envs, dtype=bool)  # whether there has been an episode
        #: Steps after which an episode is cut off, or None.
        self._limit: int | None = None
        if max_episode_steps is not None and max_episode_steps != -1:
            self._limit = checked_int("max_episode_steps", max_episode_steps, at_least=1)
        self._gallery: Gallery | None = None
        if render_mode is not None:
            human = render_mode == "human"
            self._gallery = Gallery(self.num_envs, human=human, fps=RENDER_FPS)
            self._shown: list[Scenario] = [base] * self._gallery.shown

    # ------------------------------------------------------------------------------- worlds

    @property
    def observation(self) -> str:
        """Kind of observation."""
        return self.layout.kind

    @property
    def scenario(self) -> Scenario:
        """The scenario that all share; of a family, what all its worlds share."""
        return base_of(self._sources[0]) if len(self._sources) == 1 else self.scenarios[0]

    @property
    def scenarios(self) -> list[Scenario]:
        """The world that each sub-environment is in, `num_envs` of them."""
        return [self._world(i) for i in range(self.num_envs)]

    def _world(self, i: int) -> Scenario:
        if not self._began[i]:
            return base_of(self._sources[self._source_of[i]])
        return self._worlds.scenario(i, self._sources[self._source_of[i]])

    @property
    def states(self) -> np.ndarray:
        """The cars' states, (num_envs, 5) [m, m, rad, m/s, rad/s]."""
        return self._x.T.copy()

    # ------------------------------------------------------------------------------- resets

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start episodes in all sub-environments, or in those of `options["reset_mask"]`.

        Args:
            seed: None keeps the generators (or seeds them from the system at first), an int
                seeds sub-environment i with `seed + i`, a list gives one seed each.
            options: `reset_mask`, a (num_envs,) bool array with at least one True; `scenario`,
                as the argument of that name or a list of `num_envs` of them, for those that
                are reset, until another is given; `start`, x(0) of these episodes
                (num_envs, 5), and `noise`, their standard normal variates
                (num_envs, N − 1, substeps, 3 + p), in place of drawn ones.

        Raises:
            ValueError: for an unknown option, a bad value of one, or a list of the wrong length.
        """
        known = ("reset_mask", "scenario", "start", "noise")
        mask, given, start, noise = read_options(options, known)
        # All that can be wrong is found before anything is changed.
        here = masked(mask, self.num_envs)
        rngs = generators(seed, self.num_envs)
        sources = self._sources, self._source_of
        if given is not None:
            sources = chosen(*sources, here, given)
            for source in sources[0]:
                check_source(self.layout, self.single_observation_space, source)
        if start is not None:
            start = checked_start(start, (self.num_envs, STATE_DIM))
        reached = sorted({i for s in sources[0] for i, _ in base_of(s).process})
        if noise is not None:
            steps = max(base_of(s).nodes - 1 for s in sources[0])
            shape = (self.num_envs, steps, self.substeps, NOISE_DIM + len(reached))
            noise = checked_array("noise", noise, shape)
        self._sources, self._source_of = sources
        for i in here:
            if (rng := rngs[i]) is not None:
                self._tapes.start(int(i), rng)
        self._ready = True
        self._start(here)
        if start is not None:
            self._put_at(here, start[here].T)
        if noise is not None:
            self._noise.give(here, noise[here], self._worlds.noise_columns(reached))
        distance, observation = self._look()
        started = np.zeros(self.num_envs, dtype=bool)
        started[here] = True
        self._record(here, moved=False)
        return observation, self._info_at_start(distance, started)

    def _start(self, here: np.ndarray) -> None:
        """New episodes in the sub-environments `here` (indices)."""
        for number, source in enumerate(self._sources):
            if len(self._sources) == 1:
                self._start_from(source, here)
            else:
                some = here[self._source_of[here] == number]
                if len(some):
                    self._start_from(source, some)
        self._step[here] = 0
        self._distance[here] = np.inf
        if len(self._waiting):
            self._waiting = np.setdiff1d(self._waiting, here, assume_unique=True)
        self._began[here] = True
        together = len(here) == self.num_envs or bool((self._step == 0).all())
        self._common_step = 0 if together else None

    def _start_from(self, source: Source, here: np.ndarray) -> None:
        base, worlds = base_of(source), self._worlds
        words = self._tapes.take(here, words_for_episode(source, self.substeps))
        if len(here) == self.num_envs and isinstance(source, Scenario):
            if worlds.shared is not source:
                worlds.share(source)
            self._noise.fit(base.nodes - 1, base.noise_dim)
            episodes = read_episodes(source, words, self.substeps, self._noise.array)
        else:
            episodes = read_episodes(source, words, self.substeps)
            before = [i for i, _ in worlds.parameters.process]
            if worlds.shared is not source:
                worlds.put(here, source, episodes.drawn)
            self._noise.put(
                here,
                episodes.noise,
                where=worlds.noise_columns([i for i, _ in base.process]),
                columns=NOISE_DIM + len(worlds.parameters.process),
                kept=worlds.noise_columns(before),
            )
        start = worlds.start[:, here]
        if episodes.deviations is not None:
            start = start + base.start_deviation[:, None] * episodes.deviations.T
        self._put_at(here, start)

    def _put_at(self, here: np.ndarray, states: np.ndarray) -> None:
        self._x[:, here] = states
        self._rounded[:, here] = states

    # -------------------------------------------------------------------------------- steps

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
        resetting = self._waiting
        if self.autoreset_mode is AutoresetMode.DISABLED and len(resetting):
            raise ResetNeeded(
                f"sub-environments {resetting.tolist()} are over: reset them "
                "with options={'reset_mask': ...} before step()"
            )
        limited = limited_action(actions, (self.num_envs,), self._dtype)
        u = np.empty((2, self.num_envs), dtype=self._dtype)
        for row, column, scale in zip(u, limited.T, self._worlds.action_scale, strict=True):
            np.multiply(column, scale, out=row)
        if len(resetting):  # NEXT_STEP: this call starts their episodes and ignores the action
            self._start(resetting)
        if len(resetting) == self.num_envs:
            moved, observation = self._stay()
            u[:] = 0.0
        else:
            begun = self._x[:, resetting]
            moved, observation = self._move(u)
            if len(resetting):
                moved, observation = self._undone(resetting, begun, moved, u)
            else:
                np.minimum(self._distance, moved.distance, out=self._distance)
        over, cut, ended = self._ended(resetting)
        goal = np.zeros(self.num_envs)
        success = np.zeros(self.num_envs, dtype=bool)
        if len(ended):
            goal[over] = goal_cost(self._worlds.parameters, self._x)[over]
            success[ended] = self._arrived()[ended]
        self._waiting = ended
        info = self._info(u, moved, goal, success)
        # In float64, so that the return is minus the sum of the costs that `info` tells of.
        reward = np.add(moved.effort, moved.obstacle, dtype=np.float64)
        if len(ended):
            reward += goal
        np.negative(reward, out=reward)
        self._record(resetting, moved=True)
        if len(ended) and self.autoreset_mode is AutoresetMode.SAME_STEP:
            observation, info = self._restart(ended, over | cut, observation, info)
        return observation, reward, over, cut, info

    def _move(self, u: np.ndarray) -> tuple[Moved, np.ndarray]:
        """One step of all, and what they see then."""
        noise, observation = self._noise_now(), self._blank()
        self._step += 1
        if self._common_step is not None:
            self._common_step += 1
        effort = obstacle = distance = np.empty(0)
        if len(self._parts) > 1:
            effort, obstacle, distance = np.empty((3, self.num_envs), dtype=self._dtype)
        for here in self._parts:
            p = self._worlds.part(here)
            add = functools.partial(self._add, here)
            moved = step(p, self._rounded[:, here], u[:, here], noise[..., here], ARRAYS, add)
            self._observe(p, here, moved.rims, observation)
            if len(self._parts) == 1:
                return moved, observation
            effort[here], obstacle[here] = moved.effort, moved.obstacle
            distance[here] = moved.distance
        return Moved(None, effort, obstacle, distance, None), observation

    def _add(self, here: slice, x: Any, added: list[np.ndarray]) -> np.ndarray:
        """Add to the states, and give them as increments take them."""
        self._x[:, here] += np.concatenate(added).reshape(len(added), -1)
        rounded = self._rounded[:, here]
        rounded[:] = self._x[:, here]
        return rounded

    def _undone(
        self, resetting: np.ndarray, begun: np.ndarray, moved: Moved, u: np.ndarray
    ) -> tuple[Moved, np.ndarray]:
        """Those that have just been reset have not moved."""
        self._put_at(resetting, begun)
        self._step[resetting] = 0
        self._common_step = None
        u[:, resetting] = 0.0
        moved.effort[resetting] = moved.obstacle[resetting] = 0.0
        now, observation = self._look()
        moved.distance[resetting] = np.inf
        np.minimum(self._distance, moved.distance, out=self._distance)
        return moved._replace(distance=now), observation

    def _stay(self) -> tuple[Moved, np.ndarray]:
        """All have just been reset."""
        distance, observation = self._look()
        nothing = np.zeros((2, self.num_envs), dtype=self._dtype)
        return Moved(None, nothing[0], nothing[1], distance, None), observation

    def _look(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance to the nearest rim (num_envs,), and observations, where the cars are."""
        distance, observation = np.empty(self.num_envs, dtype=self._dtype), self._blank()
        for here in self._parts:
            p = self._worlds.part(here)
            _, distance[here], rims = proximity(p, self._rounded[:, here], ARRAYS)
            self._observe(p, here, rims, observation)
        return distance, observation

    def _noise_now(self) -> np.ndarray:
        """Variates of this step, indexed [substep, column, car]."""
        if self._common_step is None:
            now = self._noise.each(self._step)
        else:
            now = self._noise.common(self._common_step)
        return now.astype(self._dtype, copy=False)

    def _ended(self, resetting: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whose episode is over now, whose is cut off, (num_envs,) of bool; indices of either."""
        shared, k = self._worlds.shared, self._common_step
        over, cut = np.zeros((2, self.num_envs), dtype=bool)
        together = k is not None and not self.terminate_on_collision and self._limit is None
        if together and shared is not None and k != shared.nodes - 1:
            return over, cut, self._everyone[:0]
        over[:] = self._step == self._worlds.steps
        if self.terminate_on_collision:
            over |= self._distance < 0.0
        if self._limit is not None:
            cut[:] = self._step >= self._limit
            cut[resetting] = False
        over[resetting] = False
        return over, cut, np.flatnonzero(over | cut)

    def _arrived(self) -> np.ndarray:
        worlds = self._worlds
        close = arrived(self._x, worlds.parameters.goal, worlds.tolerance)
        return close & (self._distance >= 0.0) & (self._step == worlds.steps)

    def _restart(
        self, ended: np.ndarray, over: np.ndarray, observation: np.ndarray, info: dict[str, Any]
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """SAME_STEP: start the next episodes and hand on how the last ones ended."""
        self._start(ended)
        self._record(ended, moved=False)
        distance, fresh = self._look()
        return fresh, restarted(info, self._info_at_start(distance, over), observation, over)

    # ------------------------------------------------------------------------- what is seen

    def _blank(self) -> np.ndarray:
        return np.empty((self.num_envs, self.layout.size), dtype=np.float32)

    def _observe(self, p: Parameters, here: slice, rims: Any, out: np.ndarray) -> None:
        k = self._common_step
        t = p.dt * (self._step[here] if k is None else k)
        if isinstance(t, np.ndarray):
            t = t.astype(self._dtype, copy=False)
        seen = layouts.entries(self.layout, p, t, self._rounded[:, here], rims, ARRAYS)
        layouts.fill(out[here], *seen)

    def _record(self, started: np.ndarray, *, moved: bool) -> None:
        """Keep trails and worlds for pictures, if any are wanted."""
        if self._gallery is None:
            return
        for i in started[started < self._gallery.shown]:
            self._shown[i] = self._world(int(i))
        self._gallery.record(self._x.T[: self._gallery.shown], started, moved=moved)
        if self.render_mode == "human":
            self._gallery.draw(self._shown, self._distance < 0.0)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One picture (H, W, 3) uint8 for each sub-environment; None for a window.

        Raises:
            ResetNeeded: before the first reset.
        """
        gallery = self._pictures()
        return None if gallery is None else gallery.frames(self._shown, self._distance < 0.0)

    def render_tiled(self) -> np.ndarray | None:
        """All of `render`'s pictures as one, side by side: (H, W, 3) uint8; None for a window.

        Raises:
            ResetNeeded: before the first reset.
        """
        gallery = self._pictures()
        return None if gallery is None else gallery.draw(self._shown, self._distance < 0.0)

    def _pictures(self) -> Gallery | None:
        if self._gallery is None:
            gym.logger.warn("render() without a render_mode does nothing; pass one to gym.make_vec")
            return None
        if not self._ready:
            raise ResetNeeded("call reset() before render()")
        return self._gallery

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if any."""
        if self._gallery is not None:
            self._gallery.close()

    def _info_at_start(self, distance: np.ndarray, here: np.ndarray) -> dict[str, Any]:
        return info_at_start(distance, self._distance, self._step == 0, here)

    def _info(
        self, u: np.ndarray, moved: Moved, goal: np.ndarray, success: np.ndarray
    ) -> dict[str, Any]:
        fresh = self._step == 0 if self._common_step is None or self._common_step == 0 else None
        return step_info(u, moved, goal, success, self._distance, fresh)


def _parts(count: int) -> list[slice]:
    """Slices of almost equal length, of at most `_TOGETHER`."""
    pieces = -(-count // _TOGETHER)
    ends = np.linspace(0, count, pieces + 1).round().astype(int).tolist()
    return [slice(a, b) for a, b in itertools.pairwise(ends)]

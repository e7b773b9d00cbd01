"""`SlipCar-v0`, the single Gymnasium environment."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box

from slipcar.envs import observation as layouts
from slipcar.envs.arrays import FLOATS
from slipcar.envs.car import STATE_DIM
from slipcar.envs.cost import arrived
from slipcar.envs.episode import draw_episode
from slipcar.envs.options import (
    RENDER_MODES,
    check_render_mode,
    check_source,
    checked_flag,
    checked_start,
    layout_for,
    read_options,
)
from slipcar.envs.overlay import Overlay
from slipcar.envs.parameters import Parameters
from slipcar.envs.scenario import Scenario
from slipcar.envs.sources import base_of, longest_horizon, source_of
from slipcar.envs.spec import PlainSpec
from slipcar.envs.transition import control_from_action, goal_cost, proximity, step
from slipcar.envs.validate import checked_array, checked_int

RENDER_FPS = 8


class SlipCarEnv(gym.Env[np.ndarray, np.ndarray]):
    """Drive a car that slips when it turns at speed past obstacles to a goal pose.

    ## Description
    The car follows dx = b(x, u) dt + σ(x) dB with x = (r_x, r_y, θ, v, ω) and
    u = (a_v, a_ω); noise grows with |v ω| (:mod:`slipcar.envs.car`; Bonalli, Lew, Pavone,
    §6.3). One episode is one path: N − 1 control steps of Euler–Maruyama.

    ## Action space
    `Box(-1, 1, (2,), float32)`; clipped, then scaled by the scenario's control bounds.

    | index | action | min | max | unit at ±1 (default) |
    |---|---|---|---|---|
    | 0 | forward acceleration a_v | −1 | 1 | 2 m/s² |
    | 1 | angular acceleration a_ω | −1 | 1 | 4 rad/s² |

    ## Observation space
    `observation="features"` (12 numbers of order one) or `"state"` (r_x, r_y, θ, v, ω, t);
    float32. The tables are in :mod:`slipcar.envs.observation`.

    ## Reward
    −(dt ‖u‖² + dt λ Σ_o max(0, (δ_o+ε)² − ‖r−r_o‖²)²) a step and, on the last,
    −(x−x^f)ᵀW(x−x^f) as well. The return is exactly minus the path cost (float64).

    ## Starting state
    The scenario's `start`, plus a normal deviation where it has a `start_deviation`.

    ## Episode end
    `terminated` at the horizon: the observation holds the time and the horizon belongs to
    the problem, so nothing may be bootstrapped there. With `terminate_on_collision=True`
    also at the first collision (this changes the objective).

    ## Information
    `effort`, `obstacle`, `goal`: cost of this step by part. `collision`: whether any node so
    far lay inside a bare radius. `clearance`: smallest signed distance so far [m].
    `control`: the applied control in physical units. For safe reinforcement learning `cost`:
    1.0 where this node lies inside a bare radius, else 0.0 (as in Safety-Gymnasium; with
    `obstacle_weight=0` obstacles are a constraint alone). `is_success`: at the end, whether the
    car arrived within the scenario's `goal_tolerance` and never collided.

    ## Arguments
    * `scenario`: a :class:`Scenario`, the name of one (default `"paper"`), its JSON text or data;
      or a :class:`Family`, or `"family:NAME"`, of which every episode draws a world.
    * `observation`: `"features"`, `"state"` or `"egocentric"`.
    * `obstacle_slots`: how many obstacles the observation shows, the nearest first; by default
      none for a scenario, and as many as there may be for a family.
    * `substeps`: Euler–Maruyama steps in each control interval, default 1.
    * `terminate_on_collision`: default False.

    ## Reset options
    * `scenario`: as the argument; stays until another is given.
    * `start`: x(0) of this episode, (5,), in place of the scenario's.
    * `noise`: standard normal variates of this episode, (N − 1, substeps, 3 + p), with p the number
      of states that process noise reaches; in place of drawn ones.

    ## Randomness
    Everything comes from `np_random`; the same seed and actions give the same path.

    ## Version history
    * v0: first release.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  as gymnasium.Env declares it
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
    }
    spec: Any = PlainSpec()

    def __init__(
        self,
        scenario: Any = "paper",
        observation: str = "features",
        obstacle_slots: int | None = None,
        substeps: int = 1,
        terminate_on_collision: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self.source = source_of(scenario)
        self.layout = layout_for(self.source, observation, obstacle_slots)
        self.substeps = checked_int("substeps", substeps, at_least=1)
        self.terminate_on_collision = checked_flag("terminate_on_collision", terminate_on_collision)
        self.render_mode = check_render_mode(render_mode)
        #: What is drawn over the scene beside the trail; see :class:`slipcar.envs.overlay.Overlay`.
        self.overlay: Overlay | None = None
        base = base_of(self.source)
        base.action_scale  # noqa: B018  raises now, not at the first step, if unbounded
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = self.layout.space(longest_horizon(self.source))
        self._scenario: Scenario | None = None
        self._noise: list[list[list[float]]] = []
        self._over = True
        self._screen: Any = None

    @property
    def scenario(self) -> Scenario:
        """The world of the current episode (of a family before the first: what worlds share)."""
        return base_of(self.source) if self._scenario is None else self._scenario

    @property
    def observation(self) -> str:
        """Kind of observation."""
        return self.layout.kind

    @property
    def state(self) -> np.ndarray:
        """The car's state, (5,) [m, m, rad, m/s, rad/s].

        Raises:
            ResetNeeded: before the first reset.
        """
        if self._scenario is None:
            raise ResetNeeded("call reset() first: no episode is running")
        return np.array(self._x)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: None goes on with the generator.
            options: `scenario`, `start` and `noise`; see the class.

        Raises:
            ValueError: for an unknown option or a bad value of one.
        """
        given, start, noise = read_options(options, ("scenario", "start", "noise"))
        source = self.source if given is None else source_of(given)
        if source is not self.source:
            check_source(self.layout, self.observation_space, source)
        base = base_of(source)
        if start is not None:
            start = checked_start(start, (STATE_DIM,))
        if noise is not None:
            noise = checked_array("noise", noise, (base.nodes - 1, self.substeps, base.noise_dim))
        super().reset(seed=seed)  # all that can be wrong but the seed has been found
        self.source = source
        episode = draw_episode(self.np_random, source, self.substeps)
        self._scenario = episode.scenario
        self._p = Parameters.of(episode.scenario)
        self._noise = (episode.noise if noise is None else noise).tolist()
        self._x: list[float] = (episode.start if start is None else start).tolist()
        self._step = 0
        self._over = False
        _, here, self._rims = proximity(self._p, self._x, FLOATS)
        self._distance = math.inf
        self._trail = [self._x]
        if self.render_mode == "human":
            self.render()
        return self._observe(), self._info([0.0, 0.0], 0.0, 0.0, 0.0, here)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control interval.

        Raises:
            ValueError: for a misshapen or non-finite action.
            ResetNeeded: before the first reset or after the episode's end.
        """
        if self._over:
            raise ResetNeeded("call reset() before step(): no episode is running")
        scenario, p = self.scenario, self._p
        u = control_from_action(scenario, action).tolist()
        moved = step(p, self._x, u, self._noise[self._step], FLOATS)
        self._x, self._rims = list(moved.state), moved.rims
        self._step += 1
        self._trail.append(self._x)
        self._distance = min(self._distance, moved.distance)
        at_horizon = self._step == scenario.nodes - 1
        self._over = at_horizon or (self.terminate_on_collision and self._distance < 0.0)
        goal = goal_cost(p, self._x) if self._over else 0.0
        if self.render_mode == "human":
            self.render()
        info = self._info(u, moved.effort, moved.obstacle, goal, moved.distance)
        return self._observe(), -(moved.effort + moved.obstacle + goal), self._over, False, info

    def _observe(self) -> np.ndarray:
        t = self._step * self._p.dt
        seen, _ = layouts.entries(self.layout, self._p, t, self._x, self._rims, FLOATS)
        seen += [0.0] * (self.layout.size - len(seen))
        return np.array(seen, dtype=np.float32)

    def _info(
        self, u: list[float], effort: float, obstacle: float, goal: float, distance: float
    ) -> dict[str, Any]:
        clearance = distance if self._step == 0 else self._distance
        return {
            "effort": effort,
            "obstacle": obstacle,
            "goal": goal,
            "cost": float(self._step > 0 and distance < 0.0),
            "collision": self._distance < 0.0,
            "clearance": clearance,
            "control": np.array(u),
            "is_success": self._over
            and self._distance >= 0.0
            and self._step == self.scenario.nodes - 1
            and bool(arrived(self._x, self._p.goal, self.scenario.goal_tolerance)),
        }

    def render(self) -> Any:
        """The scene: (H, W, 3) uint8 for `rgb_array`, a window for `human`.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn("render() without a render_mode does nothing; pass one to gym.make")
            return None
        if self._scenario is None:
            raise ResetNeeded("call reset() before render()")
        if self._screen is None:
            from slipcar.envs.render import Screen

            self._screen = Screen(self.scenario, human=self.render_mode == "human", fps=RENDER_FPS)
        elif self._screen.scenario is not self._scenario:  # frames keep their size
            self._screen.enter(self._scenario)
        collided = self._distance < 0.0
        return self._screen.draw(np.array(self._trail), collided=collided, overlay=self.overlay)

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles draw anew: pygame's surfaces cannot be copied."""
        return {**vars(self), "_screen": None}

    def close(self) -> None:
        """Close the window, if any."""
        if self._screen is not None:
            self._screen.close()
            self._screen = None

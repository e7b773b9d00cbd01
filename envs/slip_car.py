"""`SlipCar-v0`, the single Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box

from slipcar.envs import observation as layouts
from slipcar.envs.scenario import Scenario
from slipcar.envs.transition import control_from_action, draw_noise, transition
from slipcar.envs.validate import checked_int

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
    float32 with finite bounds. The tables are in :mod:`slipcar.envs.observation`.

    ## Reward
    −(dt ‖u‖² + dt λ Σ_o max(0, (δ_o+ε)² − ‖r−r_o‖²)²) a step and, on the last,
    −(x−x^f)ᵀW(x−x^f) as well. The return is exactly minus the path cost (float64).

    ## Starting state
    The scenario's `start`.

    ## Episode end
    `terminated` at the horizon: the observation holds the time and the horizon belongs to
    the problem, so nothing may be bootstrapped there. With `terminate_on_collision=True`
    also at the first collision (this changes the objective).

    ## Information
    `effort`, `obstacle`, `goal`: cost of this step by part. `collision`: whether any node so
    far lay inside a bare radius. `clearance`: smallest signed distance so far [m].
    `control`: the applied control in physical units.

    ## Arguments
    * `scenario`: a :class:`Scenario` or the name of one, default `"paper"`.
    * `observation`: `"features"` or `"state"`.
    * `substeps`: Euler–Maruyama steps in each control interval, default 1.
    * `terminate_on_collision`: default False.

    ## Randomness
    Everything comes from `np_random`; the same seed and actions give the same path.

    ## Version history
    * v0: first release.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  as gymnasium.Env declares it
        "render_modes": ["rgb_array", "human"],
        "render_fps": RENDER_FPS,
    }

    def __init__(
        self,
        scenario: Scenario | str = "paper",
        observation: str = "features",
        substeps: int = 1,
        terminate_on_collision: bool = False,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"unknown render_mode {render_mode!r}; allowed are None and "
                f"{self.metadata['render_modes']}"
            )
        self.scenario = Scenario.of(scenario)
        self.observation = layouts.check_kind(observation)
        self.substeps = checked_int("substeps", substeps, at_least=1)
        self.terminate_on_collision = bool(terminate_on_collision)
        self.render_mode = render_mode
        self.scenario.action_scale  # noqa: B018  raises now, not at the first step, if unbounded
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = layouts.observation_space(self.scenario, self.observation)
        self._noise: np.ndarray | None = None
        self._over = True
        self._screen: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode. `options` takes no keys yet.

        Raises:
            ValueError: for an unknown option.
        """
        super().reset(seed=seed)
        if options:
            raise ValueError(f"unknown reset options {sorted(options)}; none are known")
        self._noise = draw_noise(self.np_random, self.scenario, self.substeps)
        self._x = self.scenario.start.copy()
        self._step = 0
        self._over = False
        self._distance = float(self.scenario.signed_distance(self._x))
        self._trail = [self._x]
        if self.render_mode == "human":
            self.render()
        return self._observe(), self._info(np.zeros(2), 0.0, 0.0, 0.0)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control interval.

        Raises:
            ValueError: for a misshapen or non-finite action.
            ResetNeeded: before the first reset or after the episode's end.
        """
        if self._over or self._noise is None:
            raise ResetNeeded("call reset() before step(): no episode is running")
        u = control_from_action(self.scenario, action)
        moved = transition(self.scenario, self._x, u, self._noise[self._step])
        self._x = moved.state
        self._step += 1
        self._trail.append(self._x)
        self._distance = min(self._distance, float(moved.distance))
        at_horizon = self._step == self.scenario.nodes - 1
        self._over = at_horizon or (self.terminate_on_collision and self._distance < 0.0)
        goal = float(self.scenario.goal_cost(self._x)) if self._over else 0.0
        effort, obstacle = float(moved.effort), float(moved.obstacle)
        if self.render_mode == "human":
            self.render()
        info = self._info(u, effort, obstacle, goal)
        return self._observe(), -(effort + obstacle + goal), self._over, False, info

    def _observe(self) -> np.ndarray:
        t = self._step * self.scenario.dt
        return layouts.observe(self.scenario, self.observation, t, self._x)

    def _info(self, u: np.ndarray, effort: float, obstacle: float, goal: float) -> dict[str, Any]:
        return {
            "effort": effort,
            "obstacle": obstacle,
            "goal": goal,
            "collision": self._distance < 0.0,
            "clearance": self._distance,
            "control": u,
        }

    def render(self) -> Any:
        """The scene: (H, W, 3) uint8 for `rgb_array`, a window for `human`.

        Raises:
            ResetNeeded: before the first reset.
        """
        if self.render_mode is None:
            gym.logger.warn("render() without a render_mode does nothing; pass one to gym.make")
            return None
        if self._noise is None:
            raise ResetNeeded("call reset() before render()")
        if self._screen is None:
            from slipcar.envs.render import Screen

            self._screen = Screen(self.scenario, human=self.render_mode == "human", fps=RENDER_FPS)
        return self._screen.draw(np.stack(self._trail), collided=self._distance < 0.0)

    def close(self) -> None:
        """Close the window, if any."""
        if self._screen is not None:
            self._screen.close()
            self._screen = None

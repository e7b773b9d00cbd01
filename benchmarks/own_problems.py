"""Problems written as a user writes them: plain classes, NumPy, no Jacobian, nothing declared."""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.envs import Scenario

Array = np.ndarray


class OwnCar:
    """A scenario's problem in a plain class (n = 5): nothing of it is known to the planner.

    Args:
        scenario: whose numbers it has.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self.start, self.times = np.array(scenario.start), np.array(scenario.times)
        self.goal = np.array(scenario.goal)
        self.control_weight = np.array(scenario.control_weight)
        self.centres = np.array(scenario.obstacles[:, :2])
        self.reach = scenario.obstacles[:, 2] + scenario.clearance
        self.alpha, self.beta = (float(slip) for slip in scenario.slip)
        self.penalty_weight = np.array(scenario.penalty_weight)

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        theta, v, omega = x[..., 2], x[..., 3], x[..., 4]
        moved = [v * np.cos(theta), v * np.sin(theta), omega, u[..., 0], u[..., 1]]
        return np.stack(moved, axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        sigma = np.zeros((*x.shape, 3))
        for i, slip in enumerate((self.alpha, self.alpha, self.beta)):
            sigma[..., i, i] = slip * x[..., 3] * x[..., 4]
        return sigma

    def penalty(self, t: Any, x: Array) -> Array:
        offset = x[..., None, :2] - self.centres
        return self.reach**2 - np.sum(offset * offset, axis=-1)

    def terminal(self, x: Array) -> Array:
        return x - self.goal

    def initial_guess(self) -> tuple[Array, Array]:
        return self._scenario.initial_guess()


class Pendulums:
    """Coupled pendulums, each with a motor: n = 2 count states, m = count controls.

    From rest, hanging, to an angle of half a radian each; springs between neighbours, drag.

    Args:
        count: pendulums.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self.start, self.times = np.zeros(2 * count), np.linspace(0.0, 3.0, 41)
        self.control_weight = np.eye(count)
        self.penalty_weight = np.full(count, 10.0)

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        angle, rate = x[..., : self.count], x[..., self.count :]
        pull = np.zeros_like(angle)
        for i in range(self.count - 1):
            spring = 0.5 * np.sin(angle[..., i + 1] - angle[..., i])
            pull[..., i] += spring
            pull[..., i + 1] -= spring
        turned = u - np.sin(angle) + pull - 0.1 * rate * np.abs(rate)
        return np.concatenate([rate, turned], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return np.zeros((*x.shape, 1)) + 0.05 * np.eye(2 * self.count)[:, -1:]

    def penalty(self, t: Any, x: Array) -> Array:
        return x[..., self.count :] ** 2 - 0.5

    def terminal(self, x: Array) -> Array:
        return x - np.concatenate([np.full(self.count, 0.5), np.zeros(self.count)])

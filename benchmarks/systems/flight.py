"""In the air: a rocket that lands, a quadrotor between balls."""

from __future__ import annotations

from typing import Any

import numpy as np

from .shapes import constant, distances, line, pushes

Array = np.ndarray


class Rocket:
    """x = (x, z, v_x, v_z, θ, ω), u = thrust per mass and angular acceleration.

    Args:
        T: time to land [s].
    """

    start = np.array([20.0, 50.0, -3.0, -8.0, 0.1, 0.0])
    goal = np.array([0.0, 0.0, 0.0, -0.5, 0.0, 0.0])
    control_weight = np.diag([0.01, 0.5])
    control_bounds = np.array([[4.0, -1.5], [22.0, 1.5]])
    terminal_weight = np.array([10.0, 10.0, 20.0, 20.0, 100.0, 20.0])
    penalty_weight = np.array([50.0, 20.0])

    def __init__(self, T: float = 6.0) -> None:
        self.times = np.linspace(0.0, T, 61)

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        thrust, theta = u[..., 0], x[..., 4]
        ax, az = -thrust * np.sin(theta), thrust * np.cos(theta) - 9.81
        return np.stack([x[..., 2], x[..., 3], ax, az, x[..., 5], u[..., 1]], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, pushes(6, {2: 0.15, 3: 0.15, 5: 0.03}))

    def terminal(self, x: Array) -> Array:
        return x - self.goal

    def penalty(self, t: Any, x: Array) -> Array:
        return np.stack([-x[..., 1], x[..., 4] * x[..., 4] - 0.6**2], axis=-1)

    def constraint(self, t: Any, x: Array) -> Array:
        return np.stack([-x[..., 1] - 0.5, x[..., 4] - 0.8, -x[..., 4] - 0.8], axis=-1)

    def initial_guess(self) -> tuple[Array, Array]:
        x = line(self.start, self.goal, len(self.times))
        return x, np.tile([9.81, 0.0], (len(x) - 1, 1))

    def reposed(self, start: Any = None, final_time: Any = None) -> Rocket:
        return Rocket(final_time or self.times[-1])


class Quad12:
    """x = (position, velocity, φθψ, body rates), u = thrust per mass and torques; three balls."""

    start = np.zeros(12)
    goal = np.r_[4.0, 1.0, 1.5, np.zeros(9)]
    times = np.linspace(0.0, 4.0, 51)
    control_weight = np.diag([0.05, 2.0, 2.0, 2.0])
    control_bounds = np.array([[0.0, -0.5, -0.5, -0.3], [20.0, 0.5, 0.5, 0.3]])
    inertia = np.array([0.03, 0.03, 0.05])
    balls = np.array([[1.2, 0.35, 0.5, 0.4], [2.4, 0.4, 0.8, 0.4], [3.0, 1.2, 1.4, 0.35]])
    penalty_weight = np.full(3, 300.0)
    terminal_weight = np.r_[np.full(3, 50.0), np.full(9, 10.0)]

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        v, thrust, J = x[..., 3:6], u[..., 0], self.inertia
        phi, theta, psi, p, q, r = (x[..., i] for i in range(6, 12))
        sin_phi, cos_phi = np.sin(phi), np.cos(phi)
        sin_theta, cos_theta = np.sin(theta), np.cos(theta)
        sin_psi, cos_psi = np.sin(psi), np.cos(psi)
        acceleration = [
            thrust * (cos_psi * sin_theta * cos_phi + sin_psi * sin_phi) - 0.1 * v[..., 0],
            thrust * (sin_psi * sin_theta * cos_phi - cos_psi * sin_phi) - 0.1 * v[..., 1],
            thrust * cos_theta * cos_phi - 9.81 - 0.1 * v[..., 2],
        ]
        turning = [
            p + sin_phi * sin_theta / cos_theta * q + cos_phi * sin_theta / cos_theta * r,
            cos_phi * q - sin_phi * r,
            (sin_phi * q + cos_phi * r) / cos_theta,
        ]
        spinning = [
            (u[..., 1] - (J[2] - J[1]) * q * r) / J[0],
            (u[..., 2] - (J[0] - J[2]) * p * r) / J[1],
            (u[..., 3] - (J[1] - J[0]) * p * q) / J[2],
        ]
        rest = np.stack([*acceleration, *turning, *spinning], axis=-1)
        return np.concatenate([v, rest], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        sizes = {3: 0.08, 4: 0.08, 5: 0.08, 9: 0.05, 10: 0.05, 11: 0.05}
        return constant(x, pushes(12, sizes))

    def terminal(self, x: Array) -> Array:
        return x - self.goal

    def penalty(self, t: Any, x: Array) -> Array:
        return (self.balls[:, 3] + 0.15) ** 2 - distances(x, self.balls[:, :3]) ** 2

    def constraint(self, t: Any, x: Array) -> Array:
        return self.balls[:, 3] - distances(x, self.balls[:, :3])

    def initial_guess(self) -> tuple[Array, Array]:
        # The whole line moves at the mean speed, the start too: the planner puts that one right.
        x = line(self.start, self.goal, len(self.times))
        x = x + np.r_[np.zeros(3), 1.0, 0.25, 0.37, np.zeros(6)]
        return x, np.tile([9.81, 0.0, 0.0, 0.0], (len(x) - 1, 1))

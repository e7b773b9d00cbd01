"""On the ground: a Dubins car in the wind, a racing car on its track, a corridor of fifty discs."""

from __future__ import annotations

from typing import Any

import numpy as np

from .shapes import constant, distances, line, pushes

Array = np.ndarray


class Dubins:
    """x = (x, y, ψ) at constant speed in a sheared wind, between three discs; u = turn rate."""

    start = np.zeros(3)
    goal = np.array([6.0, 3.0, 0.0])
    times = np.linspace(0.0, 9.0, 61)
    control_weight = np.eye(1)
    control_bounds = np.array([1.2])
    discs = np.array([[2.0, 0.6, 0.7], [4.2, 2.6, 0.6], [3.6, 0.4, 0.5]])
    penalty_weight = np.full(3, 50.0)
    terminal_weight = np.full(3, 10.0)
    angles = (2,)

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        along = np.cos(x[..., 2]) - 0.1 * x[..., 1]
        across = np.sin(x[..., 2]) + 0.1 * np.sin(0.5 * x[..., 0])
        return np.stack([along, across, u[..., 0]], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, 0.05 * np.eye(3))

    def terminal(self, x: Array) -> Array:
        return x - self.goal

    def penalty(self, t: Any, x: Array) -> Array:
        return (self.discs[:, 2] + 0.2) ** 2 - distances(x, self.discs[:, :2]) ** 2

    def constraint(self, t: Any, x: Array) -> Array:
        return self.discs[:, 2] - distances(x, self.discs[:, :2])

    def initial_guess(self) -> tuple[Array, Array]:
        x = line(self.start, self.goal, len(self.times))
        x[1:, 2] = np.arctan2(3.0, 6.0)
        return x, np.zeros((len(x) - 1, 1))


class Race:
    """x = (s, n, α, v_x, v_y, r, δ), a bicycle with linear tyres; u = acceleration, steering rate.

    Args:
        T: time for 90 m of the track [s].
    """

    start = np.array([0.0, 0.0, 0.0, 12.0, 0.0, 0.0, 0.0])
    control_weight = np.diag([0.02, 1.0])
    control_bounds = np.array([[-8.0, -1.5], [5.0, 1.5]])
    penalty_weight = np.array([20.0, 20.0])
    terminal_weight = np.array([1.0, 10.0, 50.0])
    half_width = 4.0

    def __init__(self, T: float = 6.0) -> None:
        self.times = np.linspace(0.0, T, 81)

    def curvature(self, s: Array) -> Array:
        left = 0.03 * np.exp(-(((s - 30.0) / 12.0) ** 2))
        return left - 0.045 * np.exp(-(((s - 65.0) / 9.0) ** 2))

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        s, n, alpha, vx, vy, r, delta = (x[..., i] for i in range(7))
        front, rear, mass, inertia = 1.2, 1.4, 1200.0, 1800.0
        force_front = 80e3 * (delta - (vy + front * r) / vx)
        force_rear = 90e3 * (-(vy - rear * r) / vx)
        k = self.curvature(s)
        ds = (vx * np.cos(alpha) - vy * np.sin(alpha)) / (1.0 - k * n)
        rates = [
            ds,
            vx * np.sin(alpha) + vy * np.cos(alpha),
            r - k * ds,
            u[..., 0] + vy * r,
            (force_front + force_rear) / mass - vx * r,
            (front * force_front - rear * force_rear) / inertia,
            u[..., 1],
        ]
        return np.stack(rates, axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, pushes(7, {3: 0.1, 4: 0.3, 5: 0.1}))

    def terminal(self, x: Array) -> Array:
        return np.stack([x[..., 0] - 90.0, x[..., 1], x[..., 2]], axis=-1)

    def penalty(self, t: Any, x: Array) -> Array:
        return self._beyond(x, self.half_width - 1.0)

    def constraint(self, t: Any, x: Array) -> Array:
        return self._beyond(x, self.half_width)

    def _beyond(self, x: Array, limit: float) -> Array:
        return np.stack([x[..., 1] - limit, -x[..., 1] - limit], axis=-1)

    def initial_guess(self) -> tuple[Array, Array]:
        N = len(self.times)
        x = np.zeros((N, 7))
        x[:, 0] = np.linspace(0.0, 90.0, N)
        x[:, 3] = 90.0 / self.times[-1]
        x[0] = self.start
        return x, np.zeros((N - 1, 2))

    def reposed(self, start: Any = None, final_time: Any = None) -> Race:
        return Race(final_time)


class Corridor:
    """x = (position, velocity) in the plane, u = acceleration; fifty discs and two walls.

    Args:
        seed: of the discs.
    """

    start = np.zeros(4)
    goal = np.array([12.0, 0.0, 0.0, 0.0])
    times = np.linspace(0.0, 12.0, 101)
    control_weight = np.eye(2)
    control_bounds = np.array([2.0, 2.0])
    terminal_weight = np.full(4, 50.0)
    penalty_weight = np.full(52, 300.0)

    def __init__(self, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        discs: list[Array] = []
        while len(discs) < 50:
            centre = np.array([rng.uniform(0.8, 11.2), rng.uniform(-1.4, 1.4)])
            radius = rng.uniform(0.06, 0.14)
            if all(np.hypot(*(centre - d[:2])) > radius + d[2] + 0.36 for d in discs):
                discs.append(np.r_[centre, radius])
            elif rng.uniform() < 0.002:
                discs = []
        self.discs = np.array(discs)

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        return np.concatenate([x[..., 2:], u], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, pushes(4, {2: 0.02, 3: 0.02}))

    def terminal(self, x: Array) -> Array:
        return x - self.goal

    def penalty(self, t: Any, x: Array) -> Array:
        inside = (self.discs[:, 2] + 0.08) ** 2 - distances(x, self.discs[:, :2]) ** 2
        return np.concatenate([inside, self._beyond(x, 1.4)], axis=-1)

    def constraint(self, t: Any, x: Array) -> Array:
        inside = self.discs[:, 2] - distances(x, self.discs[:, :2])
        return np.concatenate([inside, self._beyond(x, 1.5)], axis=-1)

    def _beyond(self, x: Array, limit: float) -> Array:
        return np.stack([x[..., 1] - limit, -x[..., 1] - limit], axis=-1)

    def initial_guess(self) -> tuple[Array, Array]:
        x = line(self.start, self.goal, len(self.times))
        x[1:, 2] = 1.0
        return x, np.zeros((len(x) - 1, 2))

"""In orbit: a rendezvous (Clohessy–Wiltshire), a free-flyer that turns and moves between balls."""

from __future__ import annotations

from typing import Any

import numpy as np

from .shapes import constant, distances, line, pushes

Array = np.ndarray


class Rendezvous:
    """x = (position, velocity) [m] about a target in a circular orbit, u = acceleration [m/s²].

    W. H. Clohessy and R. S. Wiltshire, Terminal guidance system for satellite rendezvous, 1960:
    x radial, y along the track, z across it.
    """

    start = np.array([200.0, -1000.0, 80.0, 0.0, 0.3, -0.1])
    times = np.linspace(0.0, 1500.0, 76)
    control_weight = np.eye(3)
    control_bounds = np.full(3, 3e-3)
    terminal_weight = np.array([1e-4, 1e-4, 1e-4, 1.0, 1.0, 1.0])
    rate = 2.0 * np.pi / 5580.0

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        w, v = self.rate, x[..., 3:]
        ax = 3.0 * w * w * x[..., 0] + 2.0 * w * v[..., 1] + u[..., 0]
        ay = -2.0 * w * v[..., 0] + u[..., 1]
        az = -w * w * x[..., 2] + u[..., 2]
        return np.concatenate([v, np.stack([ax, ay, az], axis=-1)], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, pushes(6, {3: 1e-3, 4: 1e-3, 5: 1e-3}))

    def terminal(self, x: Array) -> Array:
        return x


class FreeFlyer:
    """x = (position, velocity, quaternion, body rates) [m, s], u = body forces [N], torques [N m].

    A robot of a space station goes from rest to rest past two keep-out balls and turns by 120°.
    Euler steps let the quaternion's length grow: a term draws it back to 1, and the attitude at the
    end is asked for by the vector part of the rotation that is left.
    """

    start = np.r_[np.zeros(6), 1.0, np.zeros(6)]
    end = np.array([2.5, 1.0, 0.8])
    attitude = np.r_[np.cos(np.pi / 3), np.sin(np.pi / 3) * np.array([2.0, -1.0, 2.0]) / 3.0]
    times = np.linspace(0.0, 20.0, 61)
    control_weight = np.diag([1.0, 1.0, 1.0, 20.0, 20.0, 20.0])
    control_bounds = np.r_[np.full(3, 0.2), np.full(3, 0.01)]
    mass, inertia = 7.2, np.array([0.1083, 0.1083, 0.1324])
    balls = np.array([[0.9, 0.3, 0.3, 0.35], [1.7, 0.9, 0.5, 0.3]])
    penalty_weight = np.full(2, 100.0)
    terminal_weight = np.full(12, 10.0)

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        v, q, w = x[..., 3:6], x[..., 6:10], x[..., 10:]
        a, b, c, d = (q[..., i] for i in range(4))
        axis, force = q[..., 1:], u[..., :3]
        # Body to world: f + 2 axis × (axis × f + a f).
        pushed = force + 2.0 * np.cross(axis, np.cross(axis, force) + a[..., None] * force)
        wx, wy, wz = (w[..., i] for i in range(3))
        turned = 0.5 * np.stack(
            [
                -b * wx - c * wy - d * wz,
                a * wx + c * wz - d * wy,
                a * wy + d * wx - b * wz,
                a * wz + b * wy - c * wx,
            ],
            axis=-1,
        )
        turned = turned + 0.5 * (1.0 - np.sum(q * q, axis=-1, keepdims=True)) * q
        spun = (u[..., 3:] - np.cross(w, self.inertia * w)) / self.inertia
        return np.concatenate([v, pushed / self.mass, turned, spun], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, pushes(13, {3: 2e-3, 4: 2e-3, 5: 2e-3, 10: 1e-3, 11: 1e-3, 12: 1e-3}))

    def terminal(self, x: Array) -> Array:
        q, goal = x[..., 6:10], self.attitude
        left = goal[0] * q[..., 1:] - q[..., :1] * goal[1:] - np.cross(goal[1:], q[..., 1:])
        return np.concatenate([x[..., :3] - self.end, x[..., 3:6], left, x[..., 10:]], axis=-1)

    def penalty(self, t: Any, x: Array) -> Array:
        return (self.balls[:, 3] + 0.1) ** 2 - distances(x, self.balls[:, :3]) ** 2

    def constraint(self, t: Any, x: Array) -> Array:
        return self.balls[:, 3] - distances(x, self.balls[:, :3])

    def initial_guess(self) -> tuple[Array, Array]:
        goal = np.r_[self.end, np.zeros(3), self.attitude, np.zeros(3)]
        x = line(self.start, goal, len(self.times))
        x[:, 6:10] /= np.linalg.norm(x[:, 6:10], axis=1, keepdims=True)
        return x, np.zeros((len(x) - 1, 6))

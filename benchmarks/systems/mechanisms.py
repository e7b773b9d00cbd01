"""Mechanisms: a cart-pole, a two-link arm, a pendulum held upright for long."""

from __future__ import annotations

from typing import Any

import numpy as np

from .shapes import constant, line, pushes

Array = np.ndarray


class CartPole:
    """x = (p, θ, v, ω), θ = 0 hanging; u = force on the cart. Swing up within a short rail."""

    start = np.zeros(4)
    goal = np.array([0.0, np.pi, 0.0, 0.0])
    times = np.linspace(0.0, 2.0, 61)
    control_weight = 0.01 * np.eye(1)
    control_bounds = np.array([20.0])
    terminal_weight = np.array([100.0, 100.0, 10.0, 10.0])
    penalty_weight = np.array([200.0, 200.0])

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        M, m, length, g = 1.0, 0.3, 0.5, 9.81
        theta, v, w = x[..., 1], x[..., 2], x[..., 3]
        s, c, force = np.sin(theta), np.cos(theta), u[..., 0]
        D = M + m * s * s
        a = (force + m * s * (length * w * w + g * c)) / D
        alpha = (-force * c - m * length * w * w * c * s - (M + m) * g * s) / (length * D)
        return np.stack([v, w, a, alpha], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, pushes(4, {2: 0.05, 3: 0.1}))

    def terminal(self, x: Array) -> Array:
        return x - self.goal

    def penalty(self, t: Any, x: Array) -> Array:
        return np.stack([x[..., 0] - 0.7, -x[..., 0] - 0.7], axis=-1)

    def constraint(self, t: Any, x: Array) -> Array:
        return np.stack([x[..., 0] - 0.9, -x[..., 0] - 0.9], axis=-1)

    def initial_guess(self) -> tuple[Array, Array]:
        return line(self.start, self.goal, len(self.times)), np.zeros((len(self.times) - 1, 1))


class FallingArm:
    """x = (q₁, q₂, q̇₁, q̇₂), angles from the horizontal and of the elbow; u = torques.

    Two links of 1 m and 1 kg swing from nearly hanging to a pose above the shoulder. There is no
    guess: the planner starts from the uncontrolled path, on which the arm falls.
    """

    start = np.array([-1.2, 0.4, 0.0, 0.0])
    goal = np.array([0.9, -0.8, 0.0, 0.0])
    times = np.linspace(0.0, 2.0, 61)
    control_weight = np.diag([0.01, 0.02])
    control_bounds = np.array([20.0, 8.0])
    terminal_weight = np.array([100.0, 100.0, 10.0, 10.0])

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        m, length, half, J, g = 1.0, 1.0, 0.5, 1.0 / 12.0, 9.81
        q1, q2, w1, w2 = (x[..., i] for i in range(4))
        c2, h = np.cos(q2), m * length * half * np.sin(q2)
        M22 = J + m * half**2
        M12 = M22 + m * length * half * c2
        M11 = J + m * half**2 + m * length**2 + M22 + 2.0 * m * length * half * c2
        fall2 = m * half * g * np.cos(q1 + q2)
        fall1 = m * (half + length) * g * np.cos(q1) + fall2
        b1 = u[..., 0] + h * (2.0 * w1 * w2 + w2 * w2) - fall1 - 0.1 * w1
        b2 = u[..., 1] - h * w1 * w1 - fall2 - 0.1 * w2
        D = M11 * M22 - M12 * M12
        return np.stack([w1, w2, (M22 * b1 - M12 * b2) / D, (M11 * b2 - M12 * b1) / D], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, pushes(4, {2: 0.05, 3: 0.05}))

    def terminal(self, x: Array) -> Array:
        return x - self.goal


class Arm(FallingArm):
    """The same from the line between start and goal."""

    def initial_guess(self) -> tuple[Array, Array]:
        return line(self.start, self.goal, len(self.times)), np.zeros((len(self.times) - 1, 2))


class Upright:
    """x = (θ, ω) of a linearised inverted pendulum, u = torque: unstable by e^{3.1 T}.

    Args:
        T: seconds.
    """

    start = np.array([0.3, 0.0])
    control_weight = np.eye(1)

    def __init__(self, T: float = 10.0) -> None:
        self.times = np.linspace(0.0, T, int(50 * T) + 1)

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        return np.stack([x[..., 1], 9.81 * x[..., 0] + u[..., 0]], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, np.zeros((2, 1)))

    def terminal(self, x: Array) -> Array:
        return x

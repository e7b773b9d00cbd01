"""Processes: a stirred tank that can run away, the glucose of a diabetic."""

from __future__ import annotations

from typing import Any

import numpy as np

from .shapes import constant

Array = np.ndarray


class CSTR:
    """x = (concentration [mol/m³], temperature [K]) of a reactor, u = coolant's [K]; minutes."""

    start = np.array([877.0, 324.5])
    goal = np.array([500.0, 350.0])
    times = np.linspace(0.0, 8.0, 61)
    control_weight = np.array([[1e-3]])
    control_bounds = np.array([[270.0], [330.0]])
    terminal_weight = np.array([1e-3, 1e-1])
    penalty_weight = np.array([1.0])

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        q, V, rho, Cp, heat, ER, k0, UA = 100.0, 100.0, 1000.0, 0.239, 5e4, 8750.0, 7.2e10, 5e4
        Ca, T = x[..., 0], x[..., 1]
        r = k0 * np.exp(-ER / T) * Ca
        fed = q / V * (350.0 - T) + heat / (rho * Cp) * r * 1e-3
        cooled = UA / (V * rho * Cp) * (u[..., 0] - T)
        return np.stack([q / V * (1000.0 - Ca) - r, fed + cooled], axis=-1)

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, np.diag([2.0, 0.4]))

    def control_cost(self, t: Any, x: Array) -> Array:
        return np.broadcast_to([-2e-3 * 300.0], (*x.shape[:-1], 1))

    def terminal(self, x: Array) -> Array:
        return x - self.goal

    def penalty(self, t: Any, x: Array) -> Array:
        return x[..., 1:] - 355.0

    def constraint(self, t: Any, x: Array) -> Array:
        return x[..., 1:] - 360.0


class Glucose:
    """x = (glucose [mg/dl], remote insulin [1/min], insulin [mU/l]), u ≥ 0 infused [mU/min].

    R. N. Bergman, Minimal model of glucose regulation, with a meal that is absorbed from the
    beginning; four hours. It starts too high and is to end at 100 mg/dl, insulin at rest.
    """

    basal = np.array([81.0, 0.0, 15.0])
    start = np.array([220.0, 0.0, 15.0])
    times = np.linspace(0.0, 240.0, 81)
    control_weight = np.array([[1e-2]])
    control_bounds = np.array([[0.0], [50.0]])
    terminal_weight = np.array([1.0, 1.0])
    penalty_weight = np.array([10.0])

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        p1, p2, p3, decay, volume = 0.01, 0.025, 1.3e-5, 5.0 / 54.0, 12.0
        G, X, I = x[..., 0], x[..., 1], x[..., 2]  # noqa: E741
        meal = 3.0 * np.exp(-0.03 * t)
        return np.stack(
            [
                -p1 * (G - self.basal[0]) - X * G + meal,
                -p2 * X + p3 * (I - self.basal[2]),
                -decay * (I - self.basal[2]) + u[..., 0] / volume,
            ],
            axis=-1,
        )

    def diffusion(self, t: Any, x: Array) -> Array:
        return constant(x, [[0.5], [0.0], [0.0]])

    def state_cost(self, t: Any, x: Array) -> Array:
        return 1e-3 * (x[..., 0] - 100.0) ** 2

    def terminal(self, x: Array) -> Array:
        return np.stack([x[..., 0] - 100.0, x[..., 2] - 20.0], axis=-1)

    def penalty(self, t: Any, x: Array) -> Array:
        return 75.0 - x[..., :1]

    def constraint(self, t: Any, x: Array) -> Array:
        return 70.0 - x[..., :1]

"""A planar quadrotor flies through a gate in gusts.

    python examples/quadrotor.py

Its rotor discs catch the wind broadside: the more it tilts, the harder horizontal gusts push.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner import Feedback, plan

GRAVITY = 9.81


@dataclasses.dataclass(frozen=True)
class Quadrotor:
    """State (x, z, θ, v_x, v_z, ω) [m, m, rad, m/s, m/s, rad/s], θ > 0 leans to the left.

    Controls: thrust per mass beyond hovering [m/s²] and angular acceleration [rad/s²].

    min E ∫ uᵀRu + 300 Σ max(0, c)² dt,   dx = b dt + σ dB,   E x(T) = goal,   bounds on u

    Gusts push by P(θ) · wind, 0.8/s along the rotors' axis and 0.2/s across, the wind being white
    noise. They leave θ and ω alone, so σ may depend on θ.
    """

    start: tuple = (0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    goal: tuple = (5.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    posts: tuple = ((2.5, 0.9, 0.6), (2.5, 3.1, 0.6))  # x, z, radius [m]
    wind: tuple = (1.0, 0.3)  # horizontal, vertical [m/s √s]
    times = np.linspace(0.0, 2.0, 51)
    control_weight = np.diag([0.1, 0.01])
    control_bounds = np.array([6.0, 20.0])
    penalty_weight = np.array([300.0, 300.0])

    def drift(self, t, x, u):
        theta, velocity, thrust = x[..., 2], x[..., 3:5], GRAVITY + u[..., 0]
        lift = np.stack([-thrust * np.sin(theta), thrust * np.cos(theta) - GRAVITY], axis=-1)
        return np.concatenate([velocity, x[..., 5:], lift - 0.3 * velocity, u[..., 1:]], axis=-1)

    def diffusion(self, t, x):
        sin, cos = np.sin(x[..., 2]), np.cos(x[..., 2])
        sigma = np.zeros((*x.shape, 2), dtype=x.dtype)
        sigma[..., 3, 0] = self.wind[0] * (0.2 + 0.6 * sin**2)
        sigma[..., 3, 1] = self.wind[1] * -0.6 * sin * cos
        sigma[..., 4, 0] = self.wind[0] * -0.6 * sin * cos
        sigma[..., 4, 1] = self.wind[1] * (0.2 + 0.6 * cos**2)
        return sigma

    def penalty(self, t, x):
        """Keep 0.25 m between the posts' rims and the quadrotor's centre."""
        posts = np.array(self.posts)
        dx, dz = x[..., 0, None] - posts[:, 0], x[..., 1, None] - posts[:, 1]
        return (posts[:, 2] + 0.25) ** 2 - dx**2 - dz**2

    def terminal(self, x):
        return x - np.array(self.goal)


def main() -> None:
    """Plan without heed of the gusts and with it, and follow the plan with feedback."""
    for weight in (0.0, 10.0):
        p = plan(Quadrotor(), variance_weight=weight, integrator="rk4")
        tilt, spread = np.degrees(np.abs(p.mean[:, 2]).max()), np.sqrt(p.covariance[-1, 0, 0])
        print(f"variance weight {weight:4.1f}: {p}")
        print(f"  tilts by {tilt:.0f}° and arrives within ± {spread:.2f} m")
    pushed = p.mean[25] + np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0])  # 20 cm up
    action, _ = Feedback(p).predict(np.append(pushed, p.times[25]))
    print(f"planned (thrust, turn) {p.controls[25]}, with feedback {action}")


if __name__ == "__main__":
    main()

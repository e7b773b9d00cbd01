"""Promise a risk for a system of your own: a ferry passes a lightship in gusts.

    python examples/risk.py

What must not happen is a function that is positive where it does, `constraint(t, x)`. The planner
keeps the probability that it happens at any node below what is asked for, at least expected cost.
"""

from __future__ import annotations

import numpy as np

from slipcar.planner import Feedback, OpenLoop, Plan, plan
from slipcar.planner.moments.monte_carlo import violations


class Ferry:
    """State (x, y, v_x, v_y) [m, m, m/s, m/s], control thrust [m/s²]; gusts push it about.

    min E ∫ ‖u‖² dt,   dx = b dt + σ dB,   E x(20 s) = (20, 0, 0, 0),   P(collision) ≤ δ
    """

    start = np.zeros(4)
    goal = np.array([20.0, 0.0, 0.0, 0.0])
    times = np.linspace(0.0, 20.0, 41)
    control_weight = np.eye(2)
    control_bounds = np.array([0.6, 0.6])
    #: With feedback, what missing the goal costs, for each component.
    terminal_weight = np.full(4, 1.0)
    lightship = np.array([10.0, -0.5])
    safe = 2.0  # metres from it

    def drift(self, t, x, u):
        return np.concatenate([x[..., 2:], u - 0.1 * x[..., 2:]], axis=-1)

    def diffusion(self, t, x):
        gusts = np.concatenate([np.zeros((2, 2)), 0.05 * np.eye(2)])
        return np.broadcast_to(gusts, (*x.shape[:-1], 4, 2))

    def constraint(self, t, x):
        """Positive within `safe` of the lightship, (..., 1)."""
        away = x[..., :2] - self.lightship
        return self.safe - np.sqrt((away * away).sum(axis=-1))[..., None]

    def terminal(self, x):
        return x - self.goal


def describe(name: str, p: Plan, controller: OpenLoop) -> None:
    """Cost and nearest approach of the mean, and collisions on paths of our own."""
    rate = violations(p.problem, controller.control, episodes=100_000, seed=1).mean()
    near = np.linalg.norm(p.mean[:, :2] - Ferry.lightship, axis=1).min()
    print(f"{name}: {p.status}, effort {p.effort:.4f}, {near:.2f} m away, collisions {rate:.2%}")


def main() -> None:
    """The cheapest way past, then safer ones, then one that corrects itself."""
    ferry = Ferry()
    p = plan(ferry)  # the mean knows no constraint
    describe("no risk asked for    ", p, OpenLoop(p))
    for delta in (0.05, 0.01):
        p = plan(ferry, risk=delta)
        describe(f"open loop, risk {delta:.0%}   ", p, OpenLoop(p))
    p = plan(ferry, feedback=True, risk=0.01)
    describe("with feedback, risk 1%", p, Feedback(p))
    print(p.risk)
    print(p.expected)


if __name__ == "__main__":
    main()

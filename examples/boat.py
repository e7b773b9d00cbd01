"""Plan for a system of your own: a boat that crosses a river with gusts.

    python examples/boat.py

The class below is all that the planner needs: drift, diffusion, terminal condition and costs as
functions batched over leading axes. They are traced and differentiated exactly, by the planner.
"""

from __future__ import annotations

import numpy as np

from slipcar.planner import Feedback, plan


class Boat:
    """State (x, y, v_x, v_y) [m, m, m/s, m/s], control thrust [m/s²]; gusts grow with speed.

    min E ∫ ‖u‖² + 100 max(0, c)² dt,   dx = b dt + σ dB,   E x(10 s) = (2, 5, 0, 0),   |u| ≤ 1
    """

    plane = (0, 1)  # what `slipcar live` draws
    start = np.zeros(4)
    times = np.linspace(0.0, 10.0, 61)
    control_weight = np.eye(2)
    control_bounds = np.array([1.0, 1.0])
    penalty_weight = np.array([100.0])

    def drift(self, t, x, u):
        """The river flows fastest in the middle; water brakes."""
        stream = 0.06 * x[..., 1] * (5.0 - x[..., 1])
        velocity = x[..., 2:]
        position = np.stack([velocity[..., 0] + stream, velocity[..., 1]], axis=-1)
        return np.concatenate([position, u - 0.2 * velocity], axis=-1)

    def diffusion(self, t, x):
        """Two Brownian motions push the position, the harder the faster the boat."""
        sigma = np.zeros((*x.shape, 2), dtype=x.dtype)
        sigma[..., 0, 0] = 0.1 * x[..., 2]
        sigma[..., 1, 1] = 0.1 * x[..., 3]
        return sigma

    def penalty(self, t, x):
        """Keep 1 m away from a pier at (1, 2.5)."""
        return (1.0 - (x[..., 0] - 1.0) ** 2 - (x[..., 1] - 2.5) ** 2)[..., None]

    def terminal(self, x):
        """Arrive at (2, 5) and stop."""
        return x - np.array([2.0, 5.0, 0.0, 0.0])


def main() -> None:
    """Plan with and without the variance penalty and follow the plan with feedback."""
    boat = Boat()
    for weight in (0.0, 1.0, 10.0):
        p = plan(boat, variance_weight=weight)
        print(f"variance weight {weight:4.1f}: {p}")
    state = p.mean[10] + np.array([0.1, 0.0, 0.0, 0.0])  # 10 cm off course
    action, _ = Feedback(p).predict(np.append(state, p.times[10]))
    print(f"planned thrust {p.controls[10]}, with feedback {action}")


if __name__ == "__main__":
    main()

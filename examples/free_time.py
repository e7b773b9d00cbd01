"""Let the planner choose the final time: a hoist lifts a load from rest to rest.

    python examples/free_time.py

Haste costs energy, waiting costs time: the least of 12 d²/T³ + c T is at T* = (36 d²/c)^¼.
Noise adds a third term: the longer the way takes, the further the load strays.
"""

from __future__ import annotations

import numpy as np

from slipcar.planner import plan


class Hoist:
    """State (height, speed) [m, m/s], control acceleration [m/s²]; the rope shakes the load.

    min over T and u  E ∫ u² dt + c T,   dx = (speed, u) dt + (0, s) dB,   E x(T) = (d, 0)
    """

    start = np.zeros(2)
    control_weight = np.eye(1)

    def __init__(self, distance=10.0, shaking=0.1, times=None):
        self.distance, self.shaking = distance, shaking
        # A first guess: the planner stretches the grid, its number of nodes stays.
        self.times = np.linspace(0.0, 5.0, 51) if times is None else times

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def diffusion(self, t, x):
        return np.broadcast_to([[0.0], [self.shaking]], (*x.shape[:-1], 2, 1))

    def terminal(self, x):
        return x - np.array([self.distance, 0.0])


def main() -> None:
    """Compare with the textbook, then let time cost less and noise more."""
    hoist = Hoist()
    for c in (0.1, 1.0, 10.0):
        p = plan(hoist, free_final_time=True, time_weight=c, variance_weight=0.0)
        textbook = (36.0 * hoist.distance**2 / c) ** 0.25
        print(f"time weight {c:4.1f}: T = {p.final_time:6.3f} s, textbook {textbook:6.3f} s; {p}")
    for w in (1.0, 10.0):
        p = plan(hoist, free_final_time=True, time_weight=1.0, variance_weight=w)
        spread = np.sqrt(p.covariance[-1, 0, 0])
        print(f"variance weight {w:4.1f}: T = {p.final_time:.3f} s, load within ± {spread:.2f} m")


if __name__ == "__main__":
    main()

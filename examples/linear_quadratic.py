"""A problem with a closed-form answer: a spacecraft docks from 30 m away, in orbit.

    python examples/linear_quadratic.py

Linear dynamics (Clohessy and Wiltshire, 1960), quadratic costs, additive noise: one sub-problem
solves it. Minimum energy in free space is the textbook case, u affine in t and J = 12 ‖d‖²/T³.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner import plan


@dataclasses.dataclass(frozen=True)
class Docking:
    """State (x, y, v_x, v_y) relative to the port [m, m, m/s, m/s], x radial, y along the orbit.

    min E ∫ ‖u‖² + w ‖x‖² dt,   dx = (A x + B u) dt + σ(t) dB,   E x(T) = 0,   u in [mm/s²]

    Costs are taken at the mean. Since E ‖x‖² = ‖E x‖² + tr Σ, planning with `variance_weight=w`
    completes the expectation.
    """

    rate: float = 0.00113  # of the orbit [rad/s]; 0 is free space
    state_weight: float = 1e-4  # w
    nodes: int = 61
    horizon: float = 900.0  # T [s]

    start = np.array([10.0, -30.0, 0.0, 0.0])
    control_weight = np.eye(2)

    @property
    def times(self):
        return np.linspace(0.0, self.horizon, self.nodes)

    def drift(self, t, x, u):
        """Gravity's gradient and Coriolis' acceleration; no force in free space."""
        n, velocity = self.rate, x[..., 2:]
        radial = 3.0 * n**2 * x[..., 0] + 2.0 * n * x[..., 3]
        gravity = np.stack([radial, -2.0 * n * x[..., 2]], axis=-1)
        return np.concatenate([velocity, gravity + 1e-3 * u], axis=-1)

    def diffusion(self, t, x):
        """Each thruster shakes, the plume pushes both ways at once; all fades towards the port."""
        fading = 1.0 - 0.8 * t / self.horizon
        shape = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 1.0], [0.0, 2.0, -1.0]])
        return 2e-5 * fading[..., None, None] * shape

    def state_cost(self, t, x):
        return self.state_weight * (x**2).sum(axis=-1)

    def terminal(self, x):
        return x


def main() -> None:
    """Dock in orbit, then compare free space with the textbook."""
    orbit = Docking()
    p = plan(orbit, variance_weight=orbit.state_weight)
    spread = np.sqrt(np.trace(p.covariance[-1, :2, :2]))
    print(f"in orbit: {p}")
    print(f"  expected cost {p.cost + orbit.state_weight * p.variance:.3f}, ± {spread:.2f} m")
    free = Docking(rate=0.0, state_weight=0.0)
    exact = 12.0 * np.sum((1e3 * free.start[:2]) ** 2) / free.horizon**3
    print(f"in free space the textbook's cost is {exact:.6f}, and with more and more nodes")
    for nodes in (31, 61, 121, 241):
        p = plan(dataclasses.replace(free, nodes=nodes))
        print(f"  N = {nodes:3d}: {p.effort:.6f}, off by {p.effort / exact - 1.0:+.1e}")


if __name__ == "__main__":
    main()

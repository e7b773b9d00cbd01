"""A user's script, as type checkers read it: `make types` holds mypy and pyright to it."""

from pathlib import Path

import numpy as np

import slipcar
from slipcar.envs import Family, Scenario
from slipcar.evaluation import compare, evaluate
from slipcar.planner import Feedback, OpenLoop, Plan, RecedingHorizon, Status, plan, plan_batch


class Glider:
    """Steer x = (height, climb) from rest to 1 m in 4 s; gusts grow with climb."""

    start = np.array([0.0, 0.0])
    control_weight = np.eye(1)

    def __init__(self, duration: float = 4.0) -> None:
        self.times = np.linspace(0.0, duration, 41)

    def drift(self, t: np.ndarray, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack([x[..., 1], u[..., 0] - 0.1 * x[..., 1] ** 2], axis=-1)

    def diffusion(self, t: np.ndarray, x: np.ndarray) -> np.ndarray:
        return np.stack([0.0 * x[..., 1], 0.1 * x[..., 1]], axis=-1)[..., None]

    def terminal(self, x: np.ndarray) -> np.ndarray:
        return x - np.array([1.0, 0.0])


scenario: Scenario = Scenario.named("paper")
p: Plan = plan(scenario)
q: Plan = plan(Glider(), method="convex", trust_region="adaptive", integrator="rk4")
several: list[Plan] = plan_batch([scenario, Family.named("random").sample(0)], method="newton")
ok: bool = p.status is Status.CONVERGED and p.status.ok
effort: float = p.effort
mean: np.ndarray = p.mean
where: Path = p.save("plan.npz")
version: str = slipcar.__version__
controllers = {"open": OpenLoop(p), "closed": Feedback(p), "again": RecedingHorizon(scenario)}
rate: float = evaluate(controllers["open"], scenario, episodes=100).collision_rate
text: str = compare(controllers, scenario, episodes=100).to_markdown()

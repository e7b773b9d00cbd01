"""Improve a plan by pathwise gradients: descent on the expected total cost, in Torch.

    python examples/pathwise_gradients.py

Needs torch: pip install "slipcar[rl]". The plan minimises effort and obstacle cost along its mean;
what slip makes of it at the goal, it does not know. A path's cost is differentiable, so its mean
over a few thousand paths says how to change the controls, and the gains of a feedback.
"""

from __future__ import annotations

import torch

from slipcar.envs import Scenario
from slipcar.envs.torch_paths import draw_noise, path_costs
from slipcar.planner import Feedback, plan


class Affine(torch.nn.Module):
    """u = ū_k + K_k (x − x̄_k), with ū and K to be learnt and K = 0 in open loop."""

    def __init__(self, world: Scenario, closed: bool) -> None:
        super().__init__()
        p = plan(world)
        print(f"the plan: {p}")
        p = Feedback(p).plan  # with the gains of its time-varying LQR
        numbers = (p.controls, p.gains if closed else 0.0 * p.gains, p.mean)
        controls, gains, mean = (torch.tensor(a, dtype=torch.float32) for a in numbers)
        self.dt, self.mean = world.dt, mean
        self.controls = torch.nn.Parameter(controls)
        self.gains = torch.nn.Parameter(gains, requires_grad=closed)

    def forward(self, t: float, x: torch.Tensor) -> torch.Tensor:
        k = round(t / self.dt)
        return self.controls[k] + (x - self.mean[k]) @ self.gains[k].T


def improve(policy: Affine, world: Scenario, paths: int, iterations: int) -> None:
    """L-BFGS on the mean cost of a fixed set of paths, a smooth function of controls and gains."""
    learnt = [p for p in policy.parameters() if p.requires_grad]
    options = {"max_iter": iterations, "history_size": 30, "line_search_fn": "strong_wolfe"}
    descent = torch.optim.LBFGS(learnt, **options)
    noise = draw_noise(world, paths, seed=0)

    def expected() -> torch.Tensor:
        descent.zero_grad()
        loss = path_costs(world, policy, noise).total.mean()
        loss.backward()
        return loss

    descent.step(expected)


def describe(name: str, policy: Affine, world: Scenario, paths: int) -> float:
    """Costs and collisions on fresh paths; returns the mean total cost."""
    with torch.no_grad():
        costs = path_costs(world, policy, draw_noise(world, paths, seed=1))
    parts = (f"{part} {getattr(costs, part).mean():.3f}" for part in ("effort", "obstacle", "goal"))
    error, hit = costs.total.std() / paths**0.5, (costs.distance < 0.0).double().mean()
    total = costs.total.mean().item()
    print(f"{name:23s} cost {total:.3f} ± {error:.3f} ({', '.join(parts)}), collisions {hit:.2%}")
    return total


def main(paths: int = 4096, iterations: int = 40, check: int = 100_000) -> list[float]:
    """Open loop and feedback, before and after; returns the four mean total costs."""
    torch.set_num_threads(1)  # on small tensors more are slower
    world, totals = Scenario.named("paper"), []
    for name in ("open loop", "feedback"):
        policy = Affine(world, closed=name == "feedback")
        totals.append(describe(f"{name}, planned", policy, world, check))
        improve(policy, world, paths, iterations)
        totals.append(describe(f"{name}, improved", policy, world, check))
    return totals


if __name__ == "__main__":
    main()

"""Collisions between nodes: the formula beside bridges that are sampled finely.

python benchmarks/between.py

Paths of stochastic SCP on the paper's case; between their nodes, Brownian bridges sampled at many
points, with Broadie's shift of the rim for what lies between those.
"""

from __future__ import annotations

import argparse

import numpy as np

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate, sample_paths
from slipcar.planner import OpenLoop, plan
from slipcar.planner.moments.bridge import OVERSHOOT


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--episodes", type=int, default=20_000)
    parser.add_argument("--points", type=int, default=128, help="between two nodes")
    parser.add_argument("--seed", type=int, default=5)
    options = parser.parse_args()
    scenario = Scenario.named("paper")
    controller = OpenLoop(plan(scenario))
    x, _ = sample_paths(controller, scenario, options.episodes, options.seed)
    rng = np.random.default_rng(options.seed)
    dt = scenario.dt / options.points
    hit = (scenario.signed_distance(x[:, 1:]) < 0.0).any(axis=1)
    at_nodes = hit.mean()
    for k in range(scenario.nodes - 1):
        deviation = np.abs(scenario.slip[0] * x[:, k, 3] * x[:, k, 4])
        r, end = x[:, k].copy(), x[:, k + 1, :2]
        for j in range(options.points - 1):
            left = scenario.dt - j * dt
            step = deviation * np.sqrt(dt * (left - dt) / left)
            r[:, :2] += (end - r[:, :2]) * dt / left + step[:, None] * rng.normal(size=end.shape)
            hit |= scenario.signed_distance(r) < OVERSHOOT * deviation * np.sqrt(dt)
    error = np.sqrt(hit.mean() * (1.0 - hit.mean()) / options.episodes)
    formula = evaluate(controller, scenario, options.episodes, options.seed).between_rate
    print(
        f"{options.episodes:,} paths: {at_nodes:.2%} collide at nodes; at or between them "
        f"{hit.mean():.2%} ± {error:.2%} by sampling, {formula:.2%} by the formula"
    )


if __name__ == "__main__":
    main()

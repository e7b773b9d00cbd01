"""Behaviour cloning: a network that does what a planner with feedback does (least squares).

min_θ  mean over examples of ‖π_θ(o) − a‖²
"""

from __future__ import annotations

from typing import Any

import torch

from slipcar.baselines.cloning_config import CloneConfig
from slipcar.baselines.demonstrations import Demonstrations, demonstrate
from slipcar.baselines.network import make_network, policy_of
from slipcar.baselines.policy import Policy
from slipcar.baselines.session import training_session
from slipcar.baselines.watch import Watch
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source


def train(source: Source, layout: Layout, config: CloneConfig, seed: int) -> Policy:
    """See :func:`slipcar.baselines.clone_planner`, which checks the arguments."""
    with training_session():
        watch = Watch(source, config.validation_episodes)
        examples = demonstrate(
            source, layout, worlds=config.worlds, episodes=config.episodes,
            noise=config.action_noise, seed=seed,
        )  # fmt: skip
        planning = round(watch.seconds, 1)
        network, error = fit(examples, config, seed)
        latest = watch.look(policy_of(network, source, layout), examples.steps)
    shared: dict[str, Any] = {
        "algorithm": "behaviour cloning of planned feedback",
        "config": config.to_dict(),
        "seed": seed,
        "teacher": {"failures": examples.failures, "seconds": planning},
        "error": error,
    }
    return watch.finish(latest, shared)["last"]


def fit(
    examples: Demonstrations, config: CloneConfig, seed: int
) -> tuple[torch.nn.Sequential, float]:
    """A network fitted to examples, and the mean squared error of the last pass."""
    generator = torch.Generator().manual_seed(seed)
    seen, done = torch.from_numpy(examples.observations), torch.from_numpy(examples.actions)
    network = make_network((seen.shape[1], *config.hidden, done.shape[1]), generator)
    adam = torch.optim.Adam(network.parameters())
    batches = -(-len(seen) // config.batch)
    error = 0.0
    for epoch in range(config.epochs):
        order, error = torch.randperm(len(seen), generator=generator), 0.0
        for i, rows in enumerate(order.split(config.batch)):
            left = 1.0 - (epoch + i / batches) / config.epochs
            adam.param_groups[0]["lr"] = config.learning_rate * left
            loss = torch.nn.functional.mse_loss(network(seen[rows]), done[rows])
            adam.zero_grad()
            loss.backward()
            adam.step()
            error += loss.item() * len(rows) / len(seen)
    return network, error

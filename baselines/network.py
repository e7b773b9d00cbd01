"""The actor as a Torch network, for learners other than Stable-Baselines3: there and back."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from slipcar.baselines.policy import Policy
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source


def make_network(sizes: Sequence[int], generator: torch.Generator) -> torch.nn.Sequential:
    """Linear layers with ReLU between them, in float32.

    Weights are orthogonal and biases zero, as Stable-Baselines3 starts; the last layer's are a
    hundredth of that, so that the car hardly moves at first.

    Args:
        sizes: widths from the observation to the action.
        generator: what the weights are drawn with.
    """
    layers: list[torch.nn.Module] = []
    last = len(sizes) - 2
    for i, (width, out) in enumerate(itertools.pairwise(sizes)):
        linear = torch.nn.Linear(width, out, dtype=torch.float32)
        gain = 0.01 if i == last else 2.0**0.5
        torch.nn.init.orthogonal_(linear.weight, gain, generator=generator)
        torch.nn.init.zeros_(linear.bias)
        layers += [linear] if i == last else [linear, torch.nn.ReLU()]
    return torch.nn.Sequential(*layers)


def copy_into(network: Iterable[torch.nn.Module], policy: Policy) -> None:
    """Give the linear layers of a network of the same sizes a policy's weights and biases."""
    layers = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
    with torch.no_grad():
        for layer, weight, bias in zip(layers, policy.weights, policy.biases, strict=True):
            layer.weight.copy_(torch.from_numpy(weight.copy()))
            layer.bias.copy_(torch.from_numpy(bias.copy()))


def policy_of(
    network: torch.nn.Sequential,
    source: Source,
    layout: Layout,
    log_std: float = 0.0,
    training: Mapping[str, Any] | None = None,
) -> Policy:
    """A copy of the network as it stands, as a policy.

    Args:
        network: as :func:`make_network` makes it.
        source: what it was trained on.
        layout: of its observations.
        log_std: of both actions.
        training: how it was trained.
    """
    layers = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
    return Policy(
        weights=tuple(layer.weight.detach().numpy().copy() for layer in layers),
        biases=tuple(layer.bias.detach().numpy().copy() for layer in layers),
        log_std=np.full(2, log_std),
        trained_on=source,
        training=training or {},
        observation=layout.kind,
        obstacle_slots=layout.slots,
    )

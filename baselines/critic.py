"""Start PPO from an actor that can drive: copy it, and fit the critic to what it earns.

    min_φ  mean over states of (V_φ(o_k) − Σ_{j≥k} γ^(j−k) r_j)²

PPO judges an action by how much better than expected it turned out. With a critic that expects
nothing yet, the first updates would spoil the actor.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch

from slipcar.baselines.learner import Learner
from slipcar.baselines.network import copy_into
from slipcar.baselines.policy import Policy

#: Rollouts that the critic is fitted to, passes over them, and examples at a time.
FITTED_ROLLOUTS, _EPOCHS, _BATCH = 4, 20, 1024
_LEARNING_RATE = 1e-3


def adopt(learner: Learner, policy: Policy) -> None:
    """Make `policy` the learner's actor, and fit its critic.

    Args:
        learner: untrained.
        policy: with its observations and layers.

    Raises:
        ValueError: if layers or observations differ.
    """
    network = learner.policy
    layers = [*network.mlp_extractor.policy_net, network.action_net]
    linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    sizes = (linear[0].in_features, *(layer.out_features for layer in linear))
    if (policy.layout, policy.sizes) != (learner.layout, sizes):
        raise ValueError(
            f"the initial policy sees {policy.layout} with layers {policy.sizes}, and the "
            f"configuration has {learner.layout} with {sizes}: they must be equal"
        )
    copy_into(layers, policy)
    seed = np.random.SeedSequence([int(learner.seed or 0), 0xC717]).generate_state(1)[0]
    torch.manual_seed(int(seed))
    seen, earned = _rollouts(learner, int(seed))
    values = [*network.mlp_extractor.value_net.parameters(), *network.value_net.parameters()]
    adam = torch.optim.Adam(values, lr=_LEARNING_RATE)
    for _ in range(_EPOCHS):
        for rows in torch.randperm(len(seen)).split(_BATCH):
            expected = network.predict_values(seen[rows])[:, 0]
            adam.zero_grad()
            torch.nn.functional.mse_loss(expected, earned[rows]).backward()
            adam.step()


def _rollouts(learner: Learner, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Observations (rows, d) and the returns from there (rows,), driven with exploration."""
    env = learner.get_env()
    assert env is not None
    seen, earned = [], []
    env.seed(seed)
    observation = env.reset()
    for _ in range(FITTED_ROLLOUTS):
        observations, rewards = [], []
        for _ in range(learner.n_steps):
            observations.append(np.asarray(observation))
            action, _ = learner.predict(np.asarray(observation), deterministic=False)
            observation, reward, _, _ = env.step(action)
            rewards.append(reward)
        # A rollout is one whole episode everywhere, so nothing is to come after its end.
        returns = itertools.accumulate(
            reversed(rewards), lambda later, now: now + learner.gamma * later
        )
        seen += observations
        earned += list(returns)[::-1]
    return torch.from_numpy(np.concatenate(seen)), torch.from_numpy(np.concatenate(earned))

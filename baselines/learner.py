"""Stable-Baselines3's PPO on the native vector environment, repeatable to the bit.

Every iteration starts from random states that follow from (seed, iteration) alone, and from
fresh episodes: a rollout is one whole episode, so nothing but the network and Adam's moments
is carried from one iteration to the next. That is why a run can be continued from those.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger, configure

from slipcar.baselines.config import PPOConfig
from slipcar.baselines.easing import eased
from slipcar.baselines.policy import Policy
from slipcar.baselines.sb3 import SB3VecEnv
from slipcar.envs import SlipCarVectorEnv
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source, base_of


class Learner(PPO):
    """PPO that seeds itself at every iteration and calls `after_iteration` after each.

    Attributes:
        iteration: how many are done.
        layout: of the observations.
        source_of: what an iteration trains on, by its number; None if always the same.
        after_iteration: called without arguments when a rollout and its updates are done.
    """

    iteration: int = 0
    layout: Layout
    source_of: Callable[[int], Source] | None = None
    after_iteration: Callable[[], None] = staticmethod(lambda: None)

    def collect_rollouts(self, env: Any, *args: Any, **kwargs: Any) -> bool:
        """Fresh episodes with fresh noise, then Stable-Baselines3's rollout."""
        for_env, for_numpy, for_torch = np.random.SeedSequence(
            [int(self.seed or 0), self.iteration]
        ).generate_state(3)
        # Stable-Baselines3 shuffles with NumPy's global generator.
        np.random.seed(for_numpy)  # noqa: NPY002
        torch.manual_seed(int(for_torch))
        env.seed(int(for_env))
        if self.source_of is not None:
            env.set_options({"scenario": self.source_of(self.iteration)})
        self._last_obs = env.reset()
        self._last_episode_starts = np.ones(env.num_envs, dtype=bool)
        return super().collect_rollouts(env, *args, **kwargs)

    def train(self) -> None:
        """The updates on one rollout."""
        super().train()
        self.iteration += 1
        self.after_iteration()


def make_learner(source: Source, config: PPOConfig, seed: int) -> Learner:
    """An untrained learner; equal arguments give equal weights."""
    steps = base_of(source).nodes - 1
    env = SlipCarVectorEnv(
        config.environments,
        source,
        config.observation,
        config.obstacle_slots,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    learner = Learner(
        "MlpPolicy",
        SB3VecEnv(env, config.reward_scale),
        # The last iteration may overshoot total_steps, where the rate must not turn negative.
        learning_rate=lambda remaining: config.learning_rate * max(remaining, 0.0),
        n_steps=steps,
        batch_size=config.environments * steps // config.minibatches,
        n_epochs=config.epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip_range,
        ent_coef=config.entropy_weight,
        vf_coef=config.value_weight,
        max_grad_norm=config.max_gradient_norm,
        policy_kwargs={
            "net_arch": {"pi": list(config.hidden), "vf": list(config.hidden)},
            "activation_fn": torch.nn.ReLU,
            "log_std_init": config.log_std_init,
            "optimizer_kwargs": {"eps": config.adam_epsilon},
        },
        seed=seed,
        device=config.device,
    )
    learner.layout = env.layout
    if config.goal_share < 1.0:
        iterations = config.iterations(steps)
        learner.source_of = lambda i: eased(source, config.goal_share, i, iterations)
    learner.set_logger(Logger(folder=None, output_formats=[]))
    return learner


def log_to(learner: Learner, folder: str) -> None:
    """Write tensorboard events into `folder`."""
    learner.set_logger(configure(folder, ["tensorboard"]))


def actor(learner: Learner, source: Source) -> Policy:
    """A copy of the learner's actor as it stands."""
    network = [*learner.policy.mlp_extractor.policy_net, learner.policy.action_net]
    layers = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
    return Policy(
        weights=tuple(_array(layer.weight) for layer in layers),
        biases=tuple(_array(layer.bias) for layer in layers),
        log_std=_array(learner.policy.log_std),
        trained_on=source,
        observation=learner.layout.kind,
        obstacle_slots=learner.layout.slots,
    )


def get_state(learner: Learner) -> dict[str, np.ndarray]:
    """Everything the next iteration depends on: network parameters and Adam's moments."""
    state = {f"policy.{name}": _array(x) for name, x in learner.policy.state_dict().items()}
    moments = learner.policy.optimizer.state_dict()["state"]
    for index, values in moments.items():
        for name, value in values.items():
            state[f"adam.{index}.{name}"] = _array(value)
    return state


def set_state(learner: Learner, state: Mapping[str, np.ndarray], iteration: int) -> None:
    """Continue from what :func:`get_state` gave after `iteration` iterations.

    Raises:
        ValueError: if tensors are missing or misshapen.
    """
    parameters: dict[str, torch.Tensor] = {}
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for key, array in state.items():
        kind, _, name = key.partition(".")
        tensor = torch.from_numpy(array.copy())
        if kind == "policy":
            parameters[name] = tensor
        elif kind == "adam":
            index, _, moment = name.partition(".")
            moments.setdefault(int(index), {})[moment] = tensor
    optimizer = learner.policy.optimizer
    groups = optimizer.state_dict()["param_groups"]
    expected = {index: {"step", "exp_avg", "exp_avg_sq"} for index in groups[0]["params"]}
    if {index: set(values) for index, values in moments.items()} != expected:
        raise ValueError("Adam's moments are missing or incomplete")
    try:
        learner.policy.load_state_dict(parameters)
    except RuntimeError as error:
        raise ValueError(f"the network's parameters do not fit: {error}") from error
    optimizer.load_state_dict({"state": moments, "param_groups": groups})
    learner.iteration = iteration
    learner.num_timesteps = iteration * learner.n_envs * learner.n_steps
    learner._n_updates = iteration * learner.n_epochs


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()

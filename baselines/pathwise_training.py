"""The work behind :func:`slipcar.baselines.train_pathwise`: roll out, differentiate, step."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from slipcar.baselines.easing import eased
from slipcar.baselines.network import copy_into, make_network, policy_of
from slipcar.baselines.pathwise_config import PathwiseConfig
from slipcar.baselines.policy import ACTION_DIM, Policy
from slipcar.baselines.progress import Progress
from slipcar.baselines.session import bar_for, training_session
from slipcar.baselines.storage import save_policy
from slipcar.baselines.watch import Watch
from slipcar.envs.arrays import tensor_functions
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source, base_of
from slipcar.envs.torch_paths import observe
from slipcar.envs.torch_worlds import TensorWorlds
from slipcar.envs.transition import goal_cost, proximity, step

if TYPE_CHECKING:
    from torch import Tensor

_CPU, _DTYPE = torch.device("cpu"), torch.float32
#: Worlds of a family drawn at a time, in paths; and for how many iterations they serve.
_POOL, _POOL_SERVES = 16, 16


def expected_cost(
    network: torch.nn.Module, layout: Layout, worlds: TensorWorlds, noise: Tensor
) -> Tensor:
    """Mean cost of paths that a network drives, differentiable in its parameters.

    Args:
        network: observations (paths, d) to actions (paths, 2), which are limited to [−1, 1].
        layout: of the observations.
        worlds: one for each path, or one for all.
        noise: standard normal variates, (N − 1, substeps, 3 + p, paths).
    """
    functions, p = tensor_functions(), worlds.parameters
    scale = base_of(worlds.source).action_scale.tolist()
    paths = noise.shape[-1]
    x = [component.expand(paths) for component in worlds.start]
    _, _, rims = proximity(p, x, functions)
    cost = noise.new_zeros(paths)
    for k, variates in enumerate(noise):
        seen = observe(layout, p, p.dt * k, x, rims, functions)
        action = torch.clamp(network(seen), -1.0, 1.0)
        u = [action[:, i] * scale[i] for i in range(ACTION_DIM)]
        moved = step(p, x, u, variates, functions)
        x, rims = moved.state, moved.rims
        cost = cost + moved.effort + moved.obstacle
    return (cost + goal_cost(p, x)).mean()


def train(
    source: Source,
    layout: Layout,
    config: PathwiseConfig,
    seed: int,
    *,
    initial: Policy | None,
    folder: Path | None,
    progress: bool,
    callback: Callable[[Progress], None] | None,
) -> Policy:
    """See :func:`slipcar.baselines.train_pathwise`, which checks the arguments."""
    watch, base = Watch(source, config.validation_episodes), base_of(source)
    for_worlds, for_torch = np.random.SeedSequence([seed, 0xBAC]).spawn(2)
    rng = np.random.default_rng(for_worlds)
    generator = torch.Generator().manual_seed(int(for_torch.generate_state(1)[0]))
    shape = (base.nodes - 1, 1, base.noise_dim, config.paths)
    steps, total = config.paths * (base.nodes - 1), config.iterations
    with training_session(), bar_for("pathwise gradients", total * steps, progress) as bar:
        network = make_network((layout.size, *config.hidden, ACTION_DIM), generator)
        before = 0
        if initial is not None:
            copy_into(network, initial)
            before = watch.take_up(initial)
            watch.look(policy_of(network, source, layout), before)
        adam = torch.optim.Adam(network.parameters())
        for i in range(total):
            if i % _POOL_SERVES == 0:
                now = eased(source, config.goal_share, i, total)
                worlds = TensorWorlds(now, config.paths, _POOL * config.paths, rng, _CPU, _DTYPE)
            worlds.choose(generator)
            noise = torch.randn(shape, generator=generator)
            adam.param_groups[0]["lr"] = learning_rate(config, i)
            adam.zero_grad()
            expected_cost(network, layout, worlds, noise).backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), config.max_gradient_norm)
            adam.step()
            if (i + 1) % config.evaluate_every == 0 or i + 1 == total:
                policy = policy_of(network, source, layout)
                bar.tell(watch.look(policy, before + (i + 1) * steps).validation)
            bar.update(steps)
            if callback is not None:
                latest = watch.latest.validation if watch.latest else None
                done = (i + 1) * steps
                callback(Progress(i + 1, done, total * steps, watch.seconds, latest))
    assert watch.latest is not None
    shared = {
        "algorithm": "pathwise gradients",
        "config": config.to_dict(),
        "seed": seed,
        "initial": None if initial is None else initial.fingerprint(),
    }
    policies = watch.finish(watch.latest, shared)
    if folder is not None:
        save_policy(policies["last"], folder / "last")
        save_policy(policies["best"], folder / "policy")
    return policies["best"]


def learning_rate(config: PathwiseConfig, iteration: int) -> float:
    """Adam's step size at an iteration: a linear rise, and half a cosine down to zero."""
    rise = min(1.0, (iteration + 1) / config.warm_up)
    fall = 0.5 * (1.0 + math.cos(math.pi * iteration / config.iterations))
    return config.learning_rate * rise * fall

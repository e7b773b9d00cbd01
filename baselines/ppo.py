"""Train the learning baseline: PPO without access to any plan (docs/learning.md).

    policy = train_ppo("paper", PPOConfig(total_steps=3_000_000), seed=0, folder="runs/ppo")
    policy = train_ppo("family:random")        # another world every episode

torch and Stable-Baselines3 are imported when training starts and at no other time.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slipcar.baselines.checkpoint import describe_run, read_checkpoint
from slipcar.baselines.config import PPOConfig
from slipcar.baselines.policy import Policy
from slipcar.baselines.progress import Progress
from slipcar.envs.extras import install
from slipcar.envs.options import layout_for
from slipcar.envs.sources import Source, base_of, source_of
from slipcar.envs.validate import checked_int


def train_ppo(
    scenario: Source | str = "paper",
    config: PPOConfig | None = None,
    *,
    seed: int = 0,
    folder: str | Path | None = None,
    resume: bool = True,
    progress: bool = True,
    callback: Callable[[Progress], None] | None = None,
    initial: Policy | None = None,
) -> Policy:
    """Train a policy with PPO; the same arguments give the same weights, to the bit.

    Every `evaluate_every` iterations the mean action is scored on a fixed set of validation
    episodes. The policy with the lowest validation cost is returned: over seeds it is better
    than the last one on fresh episodes too, mostly in collisions.

    Args:
        scenario: a scenario or a name, or a family or `"family:NAME"`; the `control_bounds` scale
            the actions.
        config: None is `PPOConfig.suited_to(scenario)`: on a scenario three million steps, a
            minute or two on one core.
        seed: non-negative; sets first weights, noise and exploration.
        folder: where `checkpoint.safetensors`, `run.json`, `tensorboard/` and the policies
            `policy` (the returned one) and `last` go; None keeps nothing.
        resume: whether to continue from a checkpoint in `folder`; the weights are the same
            to the bit as without the interruption. Otherwise training starts over there.
        progress: whether to show a progress bar.
        callback: called after each iteration; an exception from it stops training.
        initial: an actor to start from, with the layers and observations of `config`; its critic
            is fitted to what it earns first, and its own steps and seconds count in the history.

    Raises:
        ValueError: for a bad argument, or if `folder` holds a checkpoint of another scenario,
            configuration, seed or initial policy (naming what differs), or a corrupt one.
        ImportError: without torch or Stable-Baselines3, saying what to install.
        KeyboardInterrupt: when interrupted, saying where the last checkpoint is.
    """
    source = source_of(scenario)
    base_of(source).action_scale  # noqa: B018  raises now if it is unbounded
    config = PPOConfig.suited_to(source) if config is None else config
    layout_for(source, config.observation, config.obstacle_slots)
    seed = checked_int("seed", seed, at_least=0)
    place = None if folder is None else Path(folder)
    run = describe_run(source, config, seed, initial)
    # Before the slow imports: a folder that holds another run is refused at once.
    checkpoint = read_checkpoint(place, run) if place is not None and resume else None
    try:
        from slipcar.baselines.training import train
    except ImportError as error:
        raise ImportError(
            f"training needs torch, Stable-Baselines3, tensorboard and tqdm ({error}): "
            f"{install('rl')}"
        ) from error
    return train(
        source, config, seed, run, initial=initial,
        folder=place, checkpoint=checkpoint, progress=progress, callback=callback,
    )  # fmt: skip

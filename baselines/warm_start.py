"""Learn from the planner first: imitate its plans with feedback, then go on with PPO.

    policy = clone_planner("paper", seed=0)            # imitation alone: seconds
    policy = train_warm_started("paper", seed=0)       # and PPO from there

torch is imported when training starts and at no other time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from slipcar.baselines.cloning_config import CloneConfig
from slipcar.baselines.config import PPOConfig
from slipcar.baselines.policy import Policy
from slipcar.baselines.ppo import train_ppo
from slipcar.baselines.progress import Progress
from slipcar.baselines.storage import load_policy, save_policy
from slipcar.envs.extras import install
from slipcar.envs.options import layout_for
from slipcar.envs.sources import Source, base_of, source_of
from slipcar.envs.validate import checked_int


def finetuning(source: Source) -> PPOConfig:
    """How PPO goes on from a clone: a smaller step and less exploration than from nothing."""
    return dataclasses.replace(
        PPOConfig.suited_to(source),
        total_steps=2_000_000,
        learning_rate=3e-4,
        log_std_init=-2.0,
    )


def clone_planner(
    scenario: Source | str = "paper",
    config: CloneConfig | None = None,
    *,
    seed: int = 0,
    folder: str | Path | None = None,
) -> Policy:
    """A network that imitates planned feedback; the same arguments give the same weights.

    Args:
        scenario: a scenario or a name, or a family or `"family:NAME"`.
        config: None is `CloneConfig.suited_to(scenario)`.
        seed: non-negative; sets worlds, noise, first weights and order.
        folder: where `policy` goes when it is done; None keeps nothing.

    Raises:
        ValueError: for a bad argument, or if no plan converges.
        ImportError: without torch, saying what to install.
    """
    source = source_of(scenario)
    base_of(source).action_scale  # noqa: B018  raises now if it is unbounded
    config = CloneConfig.suited_to(source) if config is None else config
    layout = layout_for(source, config.observation, config.obstacle_slots)
    seed = checked_int("seed", seed, at_least=0)
    try:
        from slipcar.baselines.cloning import train
    except ImportError as error:
        raise ImportError(f"training needs torch ({error}): {install('rl')}") from error
    policy = train(source, layout, config, seed)
    if folder is not None:
        save_policy(policy, Path(folder) / "policy")
    return policy


def train_warm_started(
    scenario: Source | str = "paper",
    config: PPOConfig | None = None,
    *,
    cloning: CloneConfig | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    resume: bool = True,
    progress: bool = True,
    callback: Callable[[Progress], None] | None = None,
) -> Policy:
    """Clone the planner, then train with PPO from there.

    The steps and seconds in the policy's record are those of both, demonstrations included. The
    clone itself is among the policies of which the best is returned.

    Args:
        scenario: a scenario or a name, or a family or `"family:NAME"`.
        config: of PPO; None is `finetuning(scenario)`.
        cloning: None is `CloneConfig.suited_to(scenario)`, with PPO's network and observations.
        seed: of both.
        folder: as for :func:`train_ppo`; the clone goes there too, under `clone`.
        resume: whether to take up the clone and the checkpoint in `folder`.
        progress: whether to show a progress bar.
        callback: called after each iteration of PPO.

    Raises:
        ValueError: for a bad argument, or if `folder` holds a checkpoint of another run.
        ImportError: without torch or Stable-Baselines3, saying what to install.
        KeyboardInterrupt: when interrupted, saying where the last checkpoint is.
    """
    source = source_of(scenario)
    config = finetuning(source) if config is None else config
    seen = {name: getattr(config, name) for name in ("hidden", "observation", "obstacle_slots")}
    cloning = CloneConfig.suited_to(source) if cloning is None else cloning
    cloning = dataclasses.replace(cloning, **seen)
    initial = _stored(folder, source, cloning, seed) if resume else None
    if initial is None:
        initial = clone_planner(source, cloning, seed=seed)
        if folder is not None:
            save_policy(initial, Path(folder) / "clone")
    return train_ppo(
        source, config, seed=seed, folder=folder, resume=resume, progress=progress,
        callback=callback, initial=initial,
    )  # fmt: skip


def _stored(
    folder: str | Path | None, source: Source, config: CloneConfig, seed: int
) -> Policy | None:
    """The clone that an interrupted run has left in its folder, if it is the one wanted."""
    if folder is None or not (Path(folder) / "clone.json").is_file():
        return None
    found = load_policy(Path(folder) / "clone")
    wanted = {"config": config.to_dict(), "seed": seed}
    same = all(found.training.get(name) == value for name, value in wanted.items())
    return found if same and found.trained_on == source else None

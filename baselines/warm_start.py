"""Learn from the planner first: imitate its plans with feedback, then go on with PPO.

    policy = clone_planner("paper", seed=0)            # imitation alone: seconds
    policy = train_warm_started("paper", seed=0)       # and PPO from there

torch is imported when training starts and at no other time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from slipcar.baselines.config import PPOConfig, check_number, check_widths, is_count
from slipcar.baselines.policy import Policy
from slipcar.baselines.ppo import Progress, train_ppo
from slipcar.baselines.storage import load_policy, save_policy
from slipcar.envs import Family
from slipcar.envs.observation import Layout
from slipcar.envs.options import layout_for
from slipcar.envs.sources import Source, base_of, source_of
from slipcar.envs.validate import checked_int


@dataclasses.dataclass(frozen=True)
class CloneConfig:
    """Behaviour cloning of plans with feedback (`slipcar.planner.plan(..., feedback=True)`).

    Attributes:
        worlds: how many worlds of a family are planned; a scenario is one.
        episodes: driven along the plans, in all.
        action_noise: standard deviation of the noise on the actions (−1 to 1) while they are.
        epochs: passes over the examples.
        batch: examples of one update.
        learning_rate: Adam's first step size; it falls linearly to zero.
        hidden: widths of the hidden layers (ReLU).
        validation_episodes: episodes that it is scored on.
        observation: what the policy sees: `features`, `egocentric` or `state`.
        obstacle_slots: how many obstacles it sees; None shows all that a family's worlds may have,
            and none of a single scenario's, which are always the same.

    Raises:
        ValueError: naming the field, the bad value and what is allowed.
    """

    worlds: int = 1
    episodes: int = 4000
    action_noise: float = 0.1
    epochs: int = 10
    batch: int = 256
    learning_rate: float = 3e-3
    hidden: tuple[int, ...] = (64, 64)
    validation_episodes: int = 4096
    observation: str = "features"
    obstacle_slots: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(self.hidden))
        for name in ("worlds", "episodes", "epochs", "batch", "validation_episodes"):
            check_number(name, getattr(self, name), is_count, "an integer >= 1")
        check_number("learning_rate", self.learning_rate, lambda x: x > 0.0, "finite and > 0")
        check_number("action_noise", self.action_noise, lambda x: x >= 0.0, "finite and >= 0")
        check_widths(self.hidden)
        Layout(self.observation, self.obstacle_slots or 0)

    @classmethod
    def suited_to(cls, source: Source) -> CloneConfig:
        """What was measured to work: the defaults for one scenario, another choice for a family."""
        return cls(**FAMILY) if isinstance(source, Family) else cls()

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**dataclasses.asdict(self), "hidden": list(self.hidden)}


#: What cloning takes for a family beside the defaults.
FAMILY: dict[str, Any] = {
    "worlds": 3000,
    "episodes": 12_000,
    "action_noise": 0.15,
    "epochs": 8,
    "batch": 512,
    "learning_rate": 2e-3,
    "hidden": (128, 128),
    "validation_episodes": 2048,
    "observation": "egocentric",
}


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
        raise ImportError(f"training needs torch ({error}): pip install 'slipcar[rl]'") from error
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

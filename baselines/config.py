"""What a training run is made of, as data (docs/learning.md)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.envs import Family
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (Schulman et al. 2017), as it works here (docs/learning.md).

    A rollout is one whole episode in every environment. What breaks learning: observation
    normalisation, log_std 0, rewards x 0.02, potential shaping, λ 0.9.

    Attributes:
        total_steps: environment steps in all; rounded up to whole iterations.
        environments: episodes run side by side, and so per iteration.
        minibatches: parts a rollout is cut into for the updates; must divide `environments`
            (4 parts of 256 environments x 40 steps are 2560 samples each).
        epochs: passes over each rollout.
        learning_rate: Adam's first step size; it falls linearly to zero.
        gamma: discount γ; 1, because the horizon is finite.
        gae_lambda: λ of the generalised advantage estimate.
        clip_range: how far the probability ratio may leave 1.
        entropy_weight: weight of the entropy bonus.
        value_weight: weight of the value loss.
        max_gradient_norm: gradients are scaled down to this norm.
        adam_epsilon: Adam's ε.
        log_std_init: logarithm of the first exploration noise (in actions, −1 to 1).
        hidden: widths of the hidden layers (ReLU), the same for actor and critic.
        reward_scale: factor on the rewards, so that values are of order one.
        evaluate_every: iterations between evaluations.
        validation_episodes: episodes of one evaluation; their noise is always the same.
        checkpoint_every: iterations between checkpoints.
        device: where torch computes; a network this small is slower on a GPU.
        observation: what the policy sees: `features`, `egocentric` or `state`.
        obstacle_slots: how many obstacles it sees; None shows all that a family's worlds may have,
            and none of a single scenario's, which are always the same.
        goal_share: share of the goal weight that training begins with, in (0, 1]; it rises to 1
            over the first half of training (:mod:`slipcar.baselines.easing`).

    Raises:
        ValueError: naming the field, the bad value and what is allowed.
    """

    total_steps: int = 3_000_000
    environments: int = 256
    minibatches: int = 4
    epochs: int = 5
    learning_rate: float = 1e-3
    gamma: float = 1.0
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    entropy_weight: float = 0.0
    value_weight: float = 0.5
    max_gradient_norm: float = 0.5
    adam_epsilon: float = 1e-5
    log_std_init: float = -1.0
    hidden: tuple[int, ...] = (64, 64)
    reward_scale: float = 0.1
    evaluate_every: int = 10
    validation_episodes: int = 4096
    checkpoint_every: int = 10
    device: str = "cpu"
    observation: str = "features"
    obstacle_slots: int | None = None
    goal_share: float = 1.0

    def __post_init__(self) -> None:
        plain_numbers(self)
        counts = (
            "total_steps", "environments", "minibatches", "epochs", "evaluate_every",
            "validation_episodes", "checkpoint_every",
        )  # fmt: skip
        for name in counts:
            check_number(name, getattr(self, name), is_count, "an integer >= 1")
        for name in ("learning_rate", "max_gradient_norm", "adam_epsilon", "reward_scale"):
            check_number(name, getattr(self, name), lambda x: x > 0.0, "finite and > 0")
        for name in ("entropy_weight", "value_weight"):
            check_number(name, getattr(self, name), lambda x: x >= 0.0, "finite and >= 0")
        check_number("goal_share", self.goal_share, lambda x: 0.0 < x <= 1.0, "in (0, 1]")
        check_number("gamma", self.gamma, lambda x: 0.0 < x <= 1.0, "in (0, 1]")
        check_number("gae_lambda", self.gae_lambda, lambda x: 0.0 <= x <= 1.0, "in [0, 1]")
        check_number("clip_range", self.clip_range, lambda x: 0.0 < x < 1.0, "in (0, 1)")
        check_number("log_std_init", self.log_std_init, lambda x: -10.0 <= x <= 2.0, "in [-10, 2]")
        check_widths(self.hidden)
        Layout(self.observation, self.obstacle_slots or 0)
        if self.environments % self.minibatches:
            raise ValueError(
                f"minibatches must divide environments = {self.environments}, "
                f"not {self.minibatches}"
            )

    @classmethod
    def suited_to(cls, source: Source) -> PPOConfig:
        """What was measured to work: the defaults for one scenario, another choice for a family."""
        return cls(**FAMILY) if isinstance(source, Family) else cls()

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**dataclasses.asdict(self), "hidden": list(self.hidden)}

    def iterations(self, steps_per_episode: int) -> int:
        """How many rollouts `total_steps` takes, rounded up."""
        return -(-self.total_steps // (self.environments * steps_per_episode))


#: What learning a family takes beside the defaults: other worlds every episode, seen from the car.
FAMILY: dict[str, Any] = {
    "total_steps": 4_000_000,
    "environments": 512,
    "goal_share": 0.03,
    "hidden": (128, 128),
    "observation": "egocentric",
    "evaluate_every": 10,
    "validation_episodes": 2048,
}


def plain_numbers(config: Any) -> None:
    """Make NumPy's scalars in a configuration Python's numbers, which its files can hold."""
    object.__setattr__(config, "hidden", tuple(config.hidden))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, tuple):
            object.__setattr__(config, field.name, tuple(map(_plain, value)))
        else:
            object.__setattr__(config, field.name, _plain(value))


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def is_count(value: Any) -> bool:
    """Whether it is an integer, at least 1."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def check_widths(hidden: tuple[int, ...]) -> None:
    """Raises ValueError unless all are integers, at least 1."""
    for i, width in enumerate(hidden):
        check_number(f"hidden[{i}]", width, is_count, "an integer >= 1")


def check_number(name: str, value: Any, good: Callable[[Any], bool], allowed: str) -> None:
    """Raises ValueError, naming the field, unless it is a finite number that is good."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not (number and math.isfinite(value) and good(value)):
        raise ValueError(f"{name} must be {allowed}, not {value!r}")

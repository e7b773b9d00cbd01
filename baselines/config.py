"""What a training run is made of, as data (SPEC §6)."""

from __future__ import annotations

import dataclasses
import math
from typing import Any


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (Schulman et al. 2017), as measured to work here (SPEC §6).

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

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(self.hidden))
        counts = (
            "total_steps", "environments", "minibatches", "epochs", "evaluate_every",
            "validation_episodes", "checkpoint_every",
        )  # fmt: skip
        for name in counts:
            _check(name, getattr(self, name), _is_count, "an integer >= 1")
        for name in ("learning_rate", "max_gradient_norm", "adam_epsilon", "reward_scale"):
            _check(name, getattr(self, name), lambda x: x > 0.0, "finite and > 0")
        for name in ("entropy_weight", "value_weight"):
            _check(name, getattr(self, name), lambda x: x >= 0.0, "finite and >= 0")
        _check("gamma", self.gamma, lambda x: 0.0 < x <= 1.0, "in (0, 1]")
        _check("gae_lambda", self.gae_lambda, lambda x: 0.0 <= x <= 1.0, "in [0, 1]")
        _check("clip_range", self.clip_range, lambda x: 0.0 < x < 1.0, "in (0, 1)")
        _check("log_std_init", self.log_std_init, lambda x: -10.0 <= x <= 2.0, "in [-10, 2]")
        for i, width in enumerate(self.hidden):
            _check(f"hidden[{i}]", width, _is_count, "an integer >= 1")
        if self.environments % self.minibatches:
            raise ValueError(
                f"minibatches must divide environments = {self.environments}, "
                f"not {self.minibatches}"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**dataclasses.asdict(self), "hidden": list(self.hidden)}

    def iterations(self, steps_per_episode: int) -> int:
        """How many rollouts `total_steps` takes, rounded up."""
        return -(-self.total_steps // (self.environments * steps_per_episode))


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def _check(name: str, value: Any, good: Any, allowed: str) -> None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not (number and math.isfinite(value) and good(value)):
        raise ValueError(f"{name} must be {allowed}, not {value!r}")

"""What training by pathwise gradients is made of, as data."""

from __future__ import annotations

import dataclasses
from typing import Any

from slipcar.baselines.config import check_number, check_widths, is_count, plain_numbers
from slipcar.envs import Family
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source


@dataclasses.dataclass(frozen=True)
class PathwiseConfig:
    """Adam on the mean cost of fresh paths.

    Attributes:
        iterations: gradient steps.
        paths: whole episodes behind each gradient.
        learning_rate: Adam's largest step size; it rises over the first iterations and falls to
            zero along half a cosine.
        warm_up: iterations over which it rises.
        max_gradient_norm: gradients are scaled down to this norm.
        hidden: widths of the hidden layers (ReLU).
        evaluate_every: iterations between evaluations.
        validation_episodes: episodes of one evaluation; their noise is always the same.
        observation: what the policy sees: `features`, `egocentric` or `state`.
        obstacle_slots: how many obstacles it sees; None shows all that a family's worlds may have,
            and none of a single scenario's, which are always the same.
        goal_share: share of the goal weight that training begins with, in (0, 1]; it rises to 1
            over the first half of training (:mod:`slipcar.baselines.easing`).

    Raises:
        ValueError: naming the field, the bad value and what is allowed.
    """

    iterations: int = 1500
    paths: int = 1024
    learning_rate: float = 3e-3
    warm_up: int = 50
    max_gradient_norm: float = 1.0
    hidden: tuple[int, ...] = (64, 64)
    evaluate_every: int = 25
    validation_episodes: int = 4096
    observation: str = "features"
    obstacle_slots: int | None = None
    goal_share: float = 1.0

    def __post_init__(self) -> None:
        plain_numbers(self)
        for name in ("iterations", "paths", "warm_up", "evaluate_every", "validation_episodes"):
            check_number(name, getattr(self, name), is_count, "an integer >= 1")
        for name in ("learning_rate", "max_gradient_norm"):
            check_number(name, getattr(self, name), lambda x: x > 0.0, "finite and > 0")
        check_number("goal_share", self.goal_share, lambda x: 0.0 < x <= 1.0, "in (0, 1]")
        check_widths(self.hidden)
        Layout(self.observation, self.obstacle_slots or 0)

    @classmethod
    def suited_to(cls, source: Source) -> PathwiseConfig:
        """What was measured to work: the defaults for one scenario, another choice for a family."""
        return cls(**FAMILY) if isinstance(source, Family) else cls()

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**dataclasses.asdict(self), "hidden": list(self.hidden)}


#: What learning a family takes beside the defaults.
FAMILY: dict[str, Any] = {
    "iterations": 1200,
    "goal_share": 0.1,
    "hidden": (128, 128),
    "observation": "egocentric",
    "validation_episodes": 2048,
}

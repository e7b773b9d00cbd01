"""What imitating the planner is made of, as data."""

from __future__ import annotations

import dataclasses
from typing import Any

from slipcar.baselines.config import check_number, check_widths, is_count, plain_numbers
from slipcar.envs import Family
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source


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
        plain_numbers(self)
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

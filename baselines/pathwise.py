"""Train a policy by pathwise gradients: descent on the expected cost, through the simulation.

    J(θ) = E[ cost(path) ],    u_k = bounds · clip(π_θ(o_k), −1, 1)
    ∂J/∂θ ≈ mean over paths of ∂cost/∂θ,    by backpropagation through all steps of a path

The noise of a path does not depend on the controls, and the equations of the car are known and
differentiable, so a path tells not only what it cost, as PPO is told, but how to lower it.
Collisions have no such gradient; they count by the obstacle cost alone.

    policy = train_pathwise("paper", seed=0, folder="runs/pathwise")

torch is imported when training starts and at no other time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from slipcar.baselines.config import check_number, check_widths, is_count
from slipcar.baselines.policy import ACTION_DIM, Policy
from slipcar.baselines.ppo import Progress
from slipcar.envs import Family
from slipcar.envs.observation import Layout
from slipcar.envs.options import layout_for
from slipcar.envs.sources import Source, base_of, source_of
from slipcar.envs.validate import checked_int


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
        object.__setattr__(self, "hidden", tuple(self.hidden))
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


def train_pathwise(
    scenario: Source | str = "paper",
    config: PathwiseConfig | None = None,
    *,
    seed: int = 0,
    folder: str | Path | None = None,
    progress: bool = True,
    callback: Callable[[Progress], None] | None = None,
    initial: Policy | None = None,
) -> Policy:
    """Train a policy by pathwise gradients; the same arguments give the same weights, to the bit.

    Every `evaluate_every` iterations it is scored on the validation episodes that PPO is scored
    on; the policy with the lowest cost there is returned.

    Args:
        scenario: a scenario or a name, or a family or `"family:NAME"`; the `control_bounds` scale
            the actions, and its start must be certain.
        config: None is `PathwiseConfig.suited_to(scenario)`.
        seed: non-negative; sets first weights, worlds and noise.
        folder: where `policy` (the returned one) and `last` go when training is done; None keeps
            nothing.
        progress: whether to show a progress bar.
        callback: called after each iteration; an exception from it stops training.
        initial: a policy to start from, with the layers and observations of `config`; its own
            steps and seconds count in the history.

    Raises:
        ValueError: for a bad argument, or if `initial` does not fit.
        ImportError: without torch, saying what to install.
    """
    source = source_of(scenario)
    base_of(source).action_scale  # noqa: B018  raises now if it is unbounded
    if base_of(source).start_deviation.any():
        raise ValueError(
            "pathwise training needs a certain start, not start_deviation "
            f"{base_of(source).start_deviation.tolist()}; train with PPO instead"
        )
    config = PathwiseConfig.suited_to(source) if config is None else config
    layout = layout_for(source, config.observation, config.obstacle_slots)
    seed = checked_int("seed", seed, at_least=0)
    try:
        from slipcar.baselines.pathwise_training import train
    except ImportError as error:
        raise ImportError(
            f"training needs torch and tqdm ({error}): pip install 'slipcar[rl]'"
        ) from error
    sizes = (layout.size, *config.hidden, ACTION_DIM)
    if initial is not None and (initial.layout, initial.sizes) != (layout, sizes):
        raise ValueError(
            f"the initial policy sees {initial.layout} with layers {initial.sizes}, and the "
            f"configuration has {layout} with {sizes}: they must be equal"
        )
    place = None if folder is None else Path(folder)
    return train(
        source, layout, config, seed,
        initial=initial, folder=place, progress=progress, callback=callback,
    )  # fmt: skip

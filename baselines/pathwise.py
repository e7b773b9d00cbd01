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

from collections.abc import Callable
from pathlib import Path

from slipcar.baselines.pathwise_config import PathwiseConfig
from slipcar.baselines.policy import ACTION_DIM, Policy
from slipcar.baselines.progress import Progress
from slipcar.envs.extras import install
from slipcar.envs.options import layout_for
from slipcar.envs.sources import Source, base_of, source_of
from slipcar.envs.validate import checked_int


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
        raise ImportError(f"training needs torch and tqdm ({error}): {install('rl')}") from error
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

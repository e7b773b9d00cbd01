"""`slipcar train`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from slipcar.baselines import PPOConfig
from slipcar.evaluation.cli_inputs import ScenarioOption, console, read_scenario


def train(
    *,
    scenario: ScenarioOption = "paper",
    seed: int = 0,
    folder: Path = Path("runs/ppo"),
    resume: bool = True,
    config: Annotated[PPOConfig, tyro.conf.arg(name="")] = PPOConfig(),  # noqa: B008  frozen
) -> int:
    """Train a PPO policy; it never sees a plan.

    Three million steps take a minute or two on one core and need torch and
    Stable-Baselines3 (pip install 'slipcar[rl]'). Weights (safetensors), their description
    (JSON), checkpoints and tensorboard events go into the folder; an interrupted run continues
    from its last checkpoint.

        slipcar train
        slipcar train --seed 3 --folder runs/seed3 --total-steps 1000000
        slipcar compare --policy runs/ppo

    Calls slipcar.baselines.train_ppo.

    Args:
        scenario: which world.
        seed: of weights, noise and exploration, at least 0.
        folder: where everything goes.
        resume: continue from a checkpoint in the folder.
        config: how to train.
    """
    from slipcar.baselines import train_ppo
    from slipcar.evaluation import evaluate

    world = read_scenario(scenario)
    policy = train_ppo(world, dataclasses.replace(config), seed=seed, folder=folder, resume=resume)
    result = evaluate(policy, world)
    low, high = result.collision_interval
    console().print(
        f"{result.episodes:,} fresh episodes: cost {result.total:.3f} ± {result.total_se:.3f}, "
        f"collisions {result.collision_rate:.2%} [{low:.2%}, {high:.2%}], position RMS "
        f"{result.position_rms:.3f} m\npolicy in {folder}",
        markup=False,
    )
    return 0

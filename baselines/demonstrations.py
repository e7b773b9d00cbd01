"""What a planner does, as examples to learn from: observations and the actions it takes there.

    u_k = ū_k + K_k (x_k − x̄_k),      driven with noise on the actions, recorded without

The noise leads the car to states beside the plan, so the examples show how to come back from them.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode

from slipcar.envs import Family, Scenario, SlipCarVectorEnv
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source, most_obstacles
from slipcar.planner import plan

#: First number of a family's worlds that are planned: none of validation or of the held-out test.
TEACHING_SEED = 2_000_000_000


@dataclasses.dataclass(frozen=True)
class Demonstrations:
    """Examples, one row each.

    Attributes:
        observations: (rows, d) float32.
        actions: (rows, 2) float32, in [−1, 1].
        steps: environment steps that recording them took.
        failures: plans that did not converge; their worlds are left out.
    """

    observations: np.ndarray
    actions: np.ndarray
    steps: int
    failures: int


def demonstrate(
    source: Source, layout: Layout, *, worlds: int, episodes: int, noise: float, seed: int
) -> Demonstrations:
    """Plan with feedback, drive along the plans, and record.

    Args:
        source: a scenario, or a family.
        layout: of the observations.
        worlds: how many of a family to plan, at least 1; a scenario is one world.
        episodes: in all, shared out among the worlds.
        noise: standard deviation of the noise on actions, >= 0.
        seed: of worlds and noise, non-negative.

    Raises:
        ValueError: if no plan converges.
    """
    if isinstance(source, Family):
        first = TEACHING_SEED + seed * worlds
        planned = [source.sample(first + i) for i in range(worlds)]
    else:
        planned = [source]
    teachers = [teacher for world in planned if (teacher := _teacher(world)) is not None]
    if not teachers:
        raise ValueError(f"there is nothing to learn from: none of {len(planned)} plans converged")
    which = np.arange(episodes) % len(teachers)
    each = [teachers[i].world for i in which]
    env = SlipCarVectorEnv(
        episodes,
        max(each, key=most_obstacles),
        layout.kind,
        layout.slots,
        autoreset_mode=AutoresetMode.DISABLED,
    )
    several = {"scenario": each} if isinstance(source, Family) else None
    observation, _ = env.reset(seed=seed, options=several)
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0xDE30]))
    mean, controls, gains = (np.array(a) for a in zip(*(t.numbers for t in teachers), strict=True))
    scale = each[0].action_scale
    seen, done = [], []
    for k in range(each[0].nodes - 1):
        deviation = env.states - mean[which, k]
        action = (controls[which, k] + np.einsum("emn,en->em", gains[which, k], deviation)) / scale
        seen.append(observation)
        done.append(np.clip(action, -1.0, 1.0).astype(np.float32))
        played = action + noise * rng.standard_normal(action.shape)
        observation, *_ = env.step(np.clip(played, -1.0, 1.0).astype(np.float32))
    rows = np.concatenate(seen), np.concatenate(done)
    return Demonstrations(*rows, steps=len(rows[0]), failures=len(planned) - len(teachers))


class _Teacher(NamedTuple):
    """What is needed of a plan: a plan itself keeps every iteration, half a megabyte."""

    world: Scenario
    numbers: tuple[np.ndarray, np.ndarray, np.ndarray]


def _teacher(world: Scenario) -> _Teacher | None:
    """Mean, controls and gains of the plan with feedback, or None if it did not converge."""
    found = plan(world, feedback=True)
    if not found.status.ok or found.gains is None:
        return None
    return _Teacher(world, (found.mean, found.controls, found.gains))

"""Increments in float32 against float64: the same worlds, noise and actions through both.

Two obstacles whose rims are equally far may change places in an observation. Observations are
compared where both show the same obstacles in the same order; the others are counted.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.envs import SlipCarVectorEnv
from slipcar.envs.observation import LAYOUTS, SLOT

_SEED = 7


def rows(paths: int) -> list[dict[str, Any]]:
    """The largest differences over `paths` paths, a row for each source of worlds."""
    return [
        differences("paper", "features", paths),
        differences("family:random", "egocentric", paths),
    ]


def differences(source: str, observation: str, paths: int) -> dict[str, Any]:
    """Largest differences between both over whole episodes with random actions.

    Actions are a constant of the path plus noise, so that paths leave the start in all directions
    and meet obstacles; both environments are given the same.
    """
    fleets = [
        SlipCarVectorEnv(paths, scenario=source, observation=observation, dtype=dtype)
        for dtype in ("float32", "float64")
    ]
    rng = np.random.default_rng(_SEED)
    held = rng.uniform(-0.7, 0.7, (paths, 2))
    for fleet in fleets:
        fleet.reset(seed=0)
    worst = dict.fromkeys(("observation", "state", "reward", "clearance"), 0.0)
    radii = slice(len(LAYOUTS[observation]) + SLOT.index("radius"), None, len(SLOT))
    returns, reordered, farthest = np.zeros((2, paths)), 0, 0.0
    infos: list[dict[str, Any]] = []
    over = np.zeros(paths, dtype=bool)
    while not over.all():
        actions = (held + rng.uniform(-0.3, 0.3, (paths, 2))).astype(np.float32)
        stepped = [fleet.step(actions) for fleet in fleets]
        seen = [step[0] for step in stepped]
        rewards = np.stack([step[1] for step in stepped])
        infos = [step[4] for step in stepped]
        over = stepped[1][2]
        returns += rewards
        states = [fleet.states for fleet in fleets]
        farthest = max(farthest, float(np.abs(states[1][:, :2]).max()))
        alike = (seen[0][:, radii] == seen[1][:, radii]).all(axis=1)
        reordered += int(np.count_nonzero(~alike))
        for name, found in (
            ("observation", np.abs(seen[0] - seen[1])[alike]),
            ("state", np.abs(states[0] - states[1])),
            ("reward", np.abs(rewards[0] - rewards[1]) / np.maximum(1.0, np.abs(rewards[1]))),
            ("clearance", np.abs(infos[0]["clearance"] - infos[1]["clearance"])),
        ):
            worst[name] = max(worst[name], float(np.max(found)))
    collided = [info["collision"] for info in infos]
    return {
        "worlds": source,
        "paths": paths,
        "farthest [m]": farthest,
        "state [m, rad]": worst["state"],
        "observation": worst["observation"],
        "reordered": reordered,
        "reward (relative above 1)": worst["reward"],
        "return (relative)": float(np.max(np.abs(returns[0] - returns[1]) / np.abs(returns[1]))),
        "clearance [m]": worst["clearance"],
        "collisions": int(collided[1].sum()),
        "in one only": int((collided[0] != collided[1]).sum()),
    }

"""Learned policies by the names that the page shows: those that are shipped, one of each kind."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar import baselines
from slipcar.baselines import Policy
from slipcar.envs import Scenario
from slipcar.envs.observation import observe
from slipcar.evaluation.learned import NAMES

_WORLDS = {"paper": "the paper's world", "random": "random worlds"}


@functools.cache
def policy_names() -> dict[str, tuple[str, str]]:
    """Name -> method and world, of :func:`slipcar.baselines.shipped_runs`."""
    return {
        f"{NAMES.get(method, method)}, trained on {said}": (method, world)
        for world, said in _WORLDS.items()
        for method in baselines.shipped_methods(world)
    }


@functools.cache
def policy(name: str) -> Policy:
    """The first shipped training of that name."""
    method, world = policy_names()[name]
    return baselines.shipped_runs(method, world)[0]


def driven_by(name: str, scenario: Scenario) -> Callable[[float, np.ndarray], np.ndarray]:
    """The policy as a control law in physical units, (t, x (paths, 5)) -> u (paths, 2).

    Raises:
        ValueError: if the scenario has no control bounds that an action could be scaled by.
    """
    learned, scale = policy(name), scenario.action_scale

    def control(t: float, x: np.ndarray) -> np.ndarray:
        seen: Any = observe(scenario, learned.observation, t, x, learned.obstacle_slots)
        return learned.predict(seen)[0] * scale

    return control

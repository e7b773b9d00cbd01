"""`info` of a vector environment: arrays with a mask each, as Gymnasium lays them out."""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.envs.transition import Moved

_NAMES = ("effort", "obstacle", "goal", "cost", "collision", "clearance", "control", "is_success")
_MASKS = tuple(f"_{name}" for name in _NAMES)


def step_info(
    u: np.ndarray,
    moved: Moved,
    goal: np.ndarray,
    success: np.ndarray,
    distance: np.ndarray,
    fresh: np.ndarray | None,
    here: np.ndarray | None = None,
) -> dict[str, Any]:
    """What `SlipCarEnv` tells of a step, for many.

    Args:
        u: controls, (2, num_envs).
        moved: what the step led to.
        goal: goal cost, (num_envs,).
        success: (num_envs,).
        distance: smallest distance so far, nodes from the first step on, (num_envs,).
        fresh: which have not taken a step, or None if all have.
        here: for whom this is told, or None for all.
    """
    clearance, inside = distance.copy(), moved.distance < 0.0
    if fresh is not None:
        clearance[fresh], inside[fresh] = moved.distance[fresh], False
    values = {
        "effort": moved.effort,
        "obstacle": moved.obstacle,
        "goal": goal,
        "cost": inside.astype(distance.dtype),
        "collision": distance < 0.0,
        "clearance": clearance,
        "control": u.T,
        "is_success": success,
    }
    there = np.ones(len(distance), dtype=bool) if here is None else here.copy()
    return values | dict.fromkeys(_MASKS, there)


def info_at_start(
    now: np.ndarray, so_far: np.ndarray, fresh: np.ndarray, here: np.ndarray
) -> dict[str, Any]:
    """What is told at a reset.

    Args:
        now: distance to the nearest rim where the cars are, (num_envs,).
        so_far: smallest distance so far, (num_envs,).
        fresh: which have not taken a step.
        here: which have been reset.
    """
    count = len(now)
    still = Moved(None, np.zeros_like(now), np.zeros_like(now), now, None)
    never = np.zeros(count, dtype=bool)
    return step_info(np.zeros((2, count)), still, np.zeros(count), never, so_far, fresh, here)


def restarted(
    info: dict[str, Any], fresh: dict[str, Any], last: np.ndarray, over: np.ndarray
) -> dict[str, Any]:
    """SAME_STEP: where an episode is over, `info` tells of the next and `final_info` of it.

    Args:
        info: of the step.
        fresh: of the new episodes.
        last: observations after the step.
        over: where episodes ended, (num_envs,).
    """
    final = np.full(len(over), None, dtype=object)
    ended = np.flatnonzero(over)
    for i, observation in zip(ended, last[ended], strict=True):
        final[i] = observation
    return {
        **{k: _choose(over, fresh[k], info[k]) for k in info},
        "final_obs": final,
        "_final_obs": over.copy(),
        "final_info": {k: _choose(over, v, np.zeros_like(v)) for k, v in info.items()},
        "_final_info": over.copy(),
    }


def _choose(mask: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)

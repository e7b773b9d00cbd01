"""One control step of the stochastic car, batched: the core behind all faces.

The environment, the vector environment and the evaluation all call :func:`transition` and
:func:`control_from_action`, so they agree path for path.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slipcar.envs.car import CONTROL_DIM
from slipcar.envs.integrate import euler_maruyama
from slipcar.envs.scenario import Scenario


@dataclasses.dataclass(frozen=True)
class Transition:
    """What one control step led to.

    Attributes:
        state: x_{k+1}, (..., 5).
        effort: dt ‖u_k‖², (...,).
        obstacle: dt λ Σ_o max(0, c_o(x_{k+1}))², (...,).
        distance: signed distance of x_{k+1} to the nearest rim [m], (...,).
    """

    state: Any
    effort: Any
    obstacle: Any
    distance: Any


def transition(scenario: Scenario, x: Any, u: Any, noise: Any) -> Transition:
    """Advance states x (..., 5) under controls u (..., 2) with noise (..., substeps, 3)."""
    dt = scenario.dt
    state = euler_maruyama(x, u, dt, noise, scenario.slip.tolist())
    return Transition(
        state=state,
        effort=dt * scenario.control_power(u),
        obstacle=dt * scenario.obstacle_power(state),
        distance=scenario.signed_distance(state),
    )


def control_from_action(
    scenario: Scenario, action: ArrayLike, batch: tuple[int, ...] = ()
) -> np.ndarray:
    """Control in physical units: the action clipped to [−1, 1] times the control bounds.

    Args:
        scenario: gives the bounds.
        action: (*batch, 2), finite.
        batch: expected leading shape.

    Returns:
        (*batch, 2) float64 [m/s², rad/s²].

    Raises:
        ValueError: for a wrong shape or a non-finite entry, naming its index.
    """
    array = np.asarray(action, dtype=np.float64)
    if array.shape != (*batch, CONTROL_DIM):
        raise ValueError(f"action must have shape {(*batch, CONTROL_DIM)}, not {array.shape}")
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(
            f"action{list(index)} is {array[index]}; actions must be finite "
            "(they are clipped to [-1, 1])"
        )
    return np.clip(array, -1.0, 1.0) * scenario.action_scale


def draw_noise(
    rng: np.random.Generator, scenario: Scenario, substeps: int, out: np.ndarray | None = None
) -> np.ndarray:
    """All standard normal variates of one episode, (N−1, substeps, 3).

    Drawing an episode at once makes a path depend on its generator alone, not on how many
    environments run beside it, and is cheaper than drawing step by step.
    """
    return rng.standard_normal((scenario.nodes - 1, substeps, 3), out=out)

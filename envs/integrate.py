"""Euler–Maruyama, and the refinement that ties coarse and fine paths to one Brownian motion.

    x⁺ = x + h b(x, u) + √h σ(x) ξ,     ξ ~ N(0, I),   h = dt / substeps

Strong order: 1/2 for general diffusions. With slip alone it is 1, because σ depends on (v, ω)
alone and the noise never reaches them: the Milstein correction (σ·∇)σ vanishes identically.
Constant noise on the pose changes nothing in that. Constant noise on v and ω does: then they are
noisy, and their noise does not commute with the slip.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from slipcar.envs import car
from slipcar.envs.arrays import Functions, array_namespace, functions_of

#: Five, two or three components, side by side: a sequence, or the rows of an array.
Components: TypeAlias = Any

#: Strong order of convergence of the slipping car (see the module's docstring).
STRONG_ORDER = 1.0


def increments(
    x: Components,
    u: Components,
    dt: Any,
    root_dt: Any,
    noise: Components,
    slip: Components,
    process: Sequence[tuple[int, Any]],
    functions: Functions,
) -> list[Any]:
    """What one Euler–Maruyama step adds to the state, on components (:mod:`slipcar.envs.arrays`).

    Args:
        x: the five components of the state.
        u: the two of the control.
        dt: h [s].
        root_dt: √h.
        noise: standard normal variates: three for the slip, then one for each pair of `process`.
        slip: (α², β²).
        process: pairs (component of the state, standard deviation per √s).
        functions: for this kind of component.
    """
    theta, v, omega = x[2], x[3], x[4]
    # Both are linear in what is scaled here, so that h and √h cost next to nothing.
    cos, sin = functions.cos(theta), functions.sin(theta)
    added = list(car.rates(dt * v, dt * omega, cos, sin, dt * u[0], dt * u[1]))
    position, heading = car.slip_rates(v, omega, root_dt * slip[0], root_dt * slip[1])
    added[0] = added[0] + position * noise[0]
    added[1] = added[1] + position * noise[1]
    added[2] = added[2] + heading * noise[2]
    for (i, deviation), variate in zip(process, noise[car.NOISE_DIM :], strict=True):
        added[i] = added[i] + root_dt * deviation * variate
    return added


def added_up(x: Components, added: Components) -> list[Any]:
    """X + added, component by component."""
    return [before + change for before, change in zip(x, added, strict=True)]


def euler_maruyama(
    x: Any, u: Any, dt: float, noise: Any, slip: Any, process: Sequence[tuple[int, float]] = ()
) -> Any:
    """Advance one control interval of length `dt`, the control held constant.

    Args:
        x: states at the node, (..., 5).
        u: controls, (..., 2).
        dt: length of the interval [s].
        noise: standard normal variates, (..., substeps, 3 + p); their number sets the substeps.
        slip: (α², β²).
        process: p pairs (component of the state, standard deviation per √s) of constant noise.

    Returns:
        States at the next node, (..., 5).
    """
    xp = array_namespace(x, u, noise)
    substeps, columns = noise.shape[-2:]
    h = dt / substeps
    state: Components = [x[..., i] for i in range(car.STATE_DIM)]
    control = [u[..., i] for i in range(car.CONTROL_DIM)]
    functions = functions_of(state[0])
    for j in range(substeps):
        variates = [noise[..., j, i] for i in range(columns)]
        added = increments(state, control, h, h**0.5, variates, slip, process, functions)
        state = added_up(state, added)
    return together(xp, state)


def together(xp: Any, x: Components) -> Any:
    """Components as one array (..., 5)."""
    return xp.asarray(x) if isinstance(x[0], float) else xp.stack(list(x), axis=-1)


def coarsen(noise: np.ndarray, factor: int) -> np.ndarray:
    """Standard normal variates of the same Brownian path on a grid `factor` times coarser.

    Args:
        noise: (..., steps, 3), one row per fine step.
        factor: how many fine steps make a coarse one; must divide `steps`.

    Returns:
        (..., steps / factor, 3), again standard normal.

    Raises:
        ValueError: if `factor` does not divide the number of steps.
    """
    steps = noise.shape[-2]
    if factor < 1 or steps % factor:
        raise ValueError(f"factor must be a positive divisor of the {steps} steps, not {factor}")
    grouped = noise.reshape(*noise.shape[:-2], steps // factor, factor, noise.shape[-1])
    return grouped.sum(axis=-2) / np.sqrt(factor)

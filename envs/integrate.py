"""Euler–Maruyama, and the refinement that ties coarse and fine paths to one Brownian motion.

    x⁺ = x + h b(x, u) + √h σ(x) ξ,     ξ ~ N(0, I),   h = dt / substeps

Strong order: 1/2 for general diffusions. Here it is 1, because σ depends on (v, ω) alone
and the noise never reaches them: the Milstein correction (σ·∇)σ vanishes identically.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.envs import car
from slipcar.envs.arrays import array_namespace

#: Strong order of convergence for this car (see the module's docstring).
STRONG_ORDER = 1.0


def euler_maruyama(x: Any, u: Any, dt: float, noise: Any, slip: Any) -> Any:
    """Advance one control interval of length `dt`, the control held constant.

    Args:
        x: states at the node, (..., 5).
        u: controls, (..., 2).
        dt: length of the interval [s].
        noise: standard normal variates, (..., substeps, 3); their number sets the substeps.
        slip: (α², β²).

    Returns:
        States at the next node, (..., 5).
    """
    xp = array_namespace(x, u, noise)
    substeps = noise.shape[-2]
    h = dt / substeps
    root = h**0.5
    for j in range(substeps):
        increment = root * car.slip_intensity(x, slip) * noise[..., j, :]
        moved = x + h * car.drift(x, u)
        x = xp.concat([moved[..., :3] + increment, moved[..., 3:]], axis=-1)
    return x


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

"""The terms of :mod:`.ball` compiled with numba, for :mod:`.compiled`.

After a change here remove the `__pycache__` of that module too: numba's cache on disk looks at
the file of the function that was called, not at those of the functions it calls.
"""

from __future__ import annotations

import numba
import numpy as np

Array = np.ndarray


@numba.njit(cache=True, fastmath=False)
def add_spheres(
    R: Array, r: Array, center: Array, radius: float, kappa: float, on: Array, turn: Array,
    press: Array,
) -> None:  # fmt: skip
    """Add what the held spheres contribute to R and r; see `ball.terms`."""
    K, m = r.shape
    for k in range(K):
        if on[k]:
            across = press[k] / radius
            for i in range(m):
                r[k, i] += (press[k] - kappa * radius) * turn[k, i]
                for j in range(m):
                    block = (kappa - across) * turn[k, i] * turn[k, j]
                    if i == j:
                        block += across
                    R[k, i, j] += block
                    r[k, i] -= block * center[k, j]


@numba.njit(cache=True, fastmath=False)
def move_spheres(
    e: Array, R: Array, center: Array, radius: float, kappa: float, settled: float, on: Array,
    turn: Array, press: Array,
) -> bool:  # fmt: skip
    """Spheres that the controls lie on, in place; whether they had settled. See `ball.at`."""
    K, m = e.shape
    same = True
    u = np.empty(m)
    for k in range(K):
        size, along, weight = 0.0, 0.0, 0.0
        for i in range(m):
            u[i] = e[k, i] - center[k, i]
            size += u[i] * u[i]
            along += turn[k, i] * u[i]
        size = np.sqrt(size)
        if on[k]:
            new = press[k] + kappa * (along - radius)
            now = new > 0.0
        else:
            now = size > radius
            for i in range(m):
                for j in range(m):
                    weight += u[i] * R[k, i, j] * u[j]
            new = weight / (size * size) * (size - radius) if now else 0.0
        if not now:
            new = 0.0
        same = same and now == on[k] and abs(new - press[k]) <= settled * kappa * radius
        on[k], press[k] = now, new
        for i in range(m):
            direction = u[i] / size if now else 0.0
            same = same and abs(direction - turn[k, i]) <= settled
            turn[k, i] = direction
    return same

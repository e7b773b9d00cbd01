"""What users' classes share: constant diffusions, lines from start to goal, distances to balls."""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray


def constant(x: Array, sigma: Any) -> Array:
    """A diffusion (n, d) that is the same everywhere, at states (..., n)."""
    sigma = np.asarray(sigma, dtype=float)
    return np.broadcast_to(sigma, (*x.shape[:-1], *sigma.shape))


def pushes(n: int, entries: dict[int, float]) -> Array:
    """σ (n, d): one Brownian motion for each state that is pushed, by its index."""
    sigma = np.zeros((n, len(entries)))
    for column, (state, size) in enumerate(entries.items()):
        sigma[state, column] = size
    return sigma


def line(start: Array, goal: Array, nodes: int) -> Array:
    """States on the line from start to goal, (nodes, n)."""
    return start + np.linspace(0.0, 1.0, nodes)[:, None] * (goal - start)


def distances(x: Array, centres: Array) -> Array:
    """From the first components of states (..., n) to centres (k, 2 or 3): (..., k)."""
    offset = x[..., None, : centres.shape[1]] - centres
    return np.sqrt(np.sum(offset * offset, axis=-1))

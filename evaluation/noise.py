"""The Brownian paths of an evaluation: episode i depends on (seed, i) alone.

Episodes come in aligned blocks of :data:`BLOCK`. Block b has a generator of its own, seeded by
(seed, b), from which the variates of one control step of all its episodes are drawn at a time.
Every controller therefore meets the same paths, however many episodes are asked for, however
they are batched, and on however many workers; and no path need be kept in memory.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slipcar.envs.car import NOISE_DIM

#: Episodes in a block: enough to hide Python's overhead, few enough to stay in the cache.
BLOCK = 1024


def block_generator(seed: int, block: int) -> np.random.Generator:
    """Generator of one block, from the entropy (seed, block)."""
    return np.random.default_rng(np.random.SeedSequence((seed, block)))


def block_noise(seed: int, block: int, steps: int, substeps: int = 1) -> Iterator[np.ndarray]:
    """Standard normal variates of a block, one control step after the other.

    Args:
        seed: of the evaluation, >= 0.
        block: which block, >= 0.
        steps: control steps, N − 1.
        substeps: Euler–Maruyama steps in each.

    Yields:
        (BLOCK, substeps, 3); row r belongs to episode `block * BLOCK + r`.
    """
    rng = block_generator(seed, block)
    for _ in range(steps):
        yield rng.standard_normal((BLOCK, substeps, NOISE_DIM))

"""The Brownian paths of an evaluation: episode i depends on (seed, i) alone.

Episodes come in aligned blocks of :data:`BLOCK`. Block b has a generator of its own, seeded by
(seed, b), from which the variates of one control step of all its episodes are drawn at a time.
Every controller therefore meets the same paths, however many episodes are asked for, however
they are batched, and on however many workers; and no path need be kept in memory.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slipcar.envs.scenario import Scenario

#: Episodes in a block: enough to hide Python's overhead, few enough to stay in the cache.
BLOCK = 1024
#: Which stream of a block deviations of the start are drawn from.
_START = 0x57A7


def block_generator(seed: int, block: int) -> np.random.Generator:
    """Generator of one block, from the entropy (seed, block)."""
    return np.random.default_rng(np.random.SeedSequence((seed, block)))


def block_noise(
    seed: int, block: int, scenario: Scenario, substeps: int = 1
) -> Iterator[np.ndarray]:
    """Standard normal variates of a block, one control step after the other.

    Args:
        seed: of the evaluation, >= 0.
        block: which block, >= 0.
        scenario: says how many steps there are and how many Brownian motions.
        substeps: Euler–Maruyama steps in each control interval.

    Yields:
        (BLOCK, substeps, 3 + p); row r belongs to episode `block * BLOCK + r`.
    """
    rng = block_generator(seed, block)
    for _ in range(scenario.nodes - 1):
        yield rng.standard_normal((BLOCK, substeps, scenario.noise_dim))


def block_starts(seed: int, block: int, scenario: Scenario) -> np.ndarray:
    """x(0) of a block's episodes, (BLOCK, 5).

    Deviations have a stream of their own, so the noise is the same with and without them.
    """
    starts = np.repeat(scenario.start[None], BLOCK, axis=0)
    if scenario.start_deviation.any():
        rng = np.random.default_rng(np.random.SeedSequence((seed, block, _START)))
        starts += scenario.start_deviation * rng.standard_normal(starts.shape)
    return starts

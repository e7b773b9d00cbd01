"""What chance decides about an episode: its world, its start and its noise, in this order.

All of it is made of one run of random words (:mod:`slipcar.envs.noise`), for one car here and for
many in :mod:`slipcar.envs.vector`: the same words give the same episode.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slipcar.envs import noise
from slipcar.envs.car import STATE_DIM
from slipcar.envs.families import Draw, Family
from slipcar.envs.scenario import Scenario
from slipcar.envs.sources import Source, base_of, words_for_world

#: Words for the deviation of the start.
_START_WORDS = (STATE_DIM + 1) // 2


class Episode(NamedTuple):
    """One episode.

    Attributes:
        scenario: its world.
        start: x(0), (5,).
        noise: standard normal variates, (N − 1, substeps, 3 + p).
    """

    scenario: Scenario
    start: np.ndarray
    noise: np.ndarray


class Episodes(NamedTuple):
    """Many episodes of one source.

    Attributes:
        drawn: the worlds, or None where the source is one scenario.
        deviations: standard normal variates of the start, (rows, 5), or None where it is certain.
        noise: standard normal variates of the first and of the second half of the steps,
            (2, ⌈(N − 1)/2⌉, substeps, 3 + p, rows) float32; see :func:`halves`.
    """

    drawn: Draw | None
    deviations: np.ndarray | None
    noise: np.ndarray


def halves(steps: int) -> int:
    """Steps in either half of an episode: a word gives a variate to a step of each."""
    return (steps + 1) // 2


def words_for_episode(source: Source, substeps: int) -> int:
    """Random words that an episode takes."""
    base = base_of(source)
    start = _START_WORDS if base.start_deviation.any() else 0
    return words_for_world(source) + start + halves(base.nodes - 1) * substeps * base.noise_dim


def read_episodes(
    source: Source, words: np.ndarray, substeps: int, out: np.ndarray | None = None
) -> Episodes:
    """Episodes from random words, one row each.

    Args:
        source: a scenario or a family.
        words: (rows, `words_for_episode`) uint64.
        substeps: Euler–Maruyama steps in each control interval.
        out: where the noise goes, contiguous.
    """
    base, rows = base_of(source), len(words)
    drawn = deviations = None
    if isinstance(source, Family):
        drawn, words = source.draw(words[:, : source.words]), words[:, source.words :]
    if base.start_deviation.any():
        pairs = noise.normals(words[:, :_START_WORDS])
        deviations = np.concatenate(list(pairs))[:STATE_DIM].T
        words = words[:, _START_WORDS:]
    shape = (2, halves(base.nodes - 1), substeps, base.noise_dim, rows)
    if out is None:
        out = np.empty(shape, dtype=np.float32)
    noise.normals(words, out.reshape(2, -1, rows))
    return Episodes(drawn, deviations, out)


def draw_episode(rng: np.random.Generator, source: Source, substeps: int) -> Episode:
    """One episode from a generator."""
    words = noise.draw_words(rng, words_for_episode(source, substeps))
    scenario = source
    if isinstance(source, Family):
        scenario = source.world(words[: source.words])
    assert isinstance(scenario, Scenario)
    _, deviations, variates = read_episodes(source, words[None], substeps)
    start = scenario.start
    if deviations is not None:
        start = start + scenario.start_deviation * deviations[0]
    steps = scenario.nodes - 1
    return Episode(scenario, start, np.concatenate(list(variates[..., 0]))[:steps])

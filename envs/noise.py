"""Where an episode's randomness comes from: words drawn from a generator, made into numbers.

An episode takes a fixed number of 64-bit words from its generator, in order. What is made of them
are functions of the words alone, so a path depends on its seed, and not on how many run beside it
or how far ahead words were fetched: a fleet fetches many episodes' words at a time
(:class:`Tapes`), for a call of a generator takes longer than the words themselves.

Standard normal variates come in float32 from the Box–Muller transform, two from a word: NumPy
computes it eight or sixteen at a time, in a third of the time of its ziggurat. They reach ± 6.8,
and beyond it lies 1e-11 of the normal law.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding

#: Words made into variates at a time, so that they stay in the cache.
_TOGETHER = 2**14
#: Words fetched ahead for all generators together, 128 MiB at most, and episodes for one.
_WORDS_AHEAD, _EPISODES_AHEAD = 2**24, 16


def draw_words(rng: np.random.Generator, count: int) -> np.ndarray:
    """`count` words of 64 random bits, (count,) uint64."""
    if isinstance(rng.bit_generator, np.random.PCG64):  # Gymnasium's, and five times as fast so
        return rng.bit_generator.random_raw(count)
    return rng.integers(0, 2**64, size=count, dtype=np.uint64)


def uniforms(words: np.ndarray) -> np.ndarray:
    """Uniform variates in [0, 1) from words of any shape, float64."""
    return (words >> np.uint64(11)) * 2.0**-53


def normals(words: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Standard normal variates by Box and Muller: √(−2 ln a) (cos 2πb, sin 2πb).

    Args:
        words: (rows, w) uint64; the two halves of each are a and b.
        out: (2, w, rows) float32, contiguous.

    Returns:
        `out`: the cosines, then the sines; side by side those of one column of words, because
        that is what a step of many cars needs.
    """
    rows, width = words.shape
    if out is None:
        out = np.empty((2, width, rows), dtype=np.float32)
    together = max(1, _TOGETHER // max(1, width))
    for first in range(0, rows, together):
        here = slice(first, first + together)
        halves = np.ascontiguousarray(words[here].T).view(np.uint32)
        radius = halves[:, 0::2].astype(np.float32)
        # (i + ½) 2⁻³²: never 0, and near it a float32 is precise; 1 at the other end is allowed.
        radius += np.float32(0.5)
        radius *= np.float32(2.0**-32)
        np.log(radius, out=radius)
        radius *= np.float32(-2.0)
        np.sqrt(radius, out=radius)
        angle = halves[:, 1::2].astype(np.float32)
        angle *= np.float32(math.tau * 2.0**-32)
        np.multiply(radius, np.cos(angle), out=out[0, :, here])
        np.multiply(radius, np.sin(angle, out=angle), out=out[1, :, here])
    return out


class Tapes:
    """The words of many generators, each read in order, fetched ahead.

    Args:
        count: how many generators.
    """

    def __init__(self, count: int) -> None:
        self._rngs: list[np.random.Generator | None] = [None] * count
        self._words = np.empty((count, 0), dtype=np.uint64)
        self._read = np.zeros(count, dtype=np.int64)

    def start(self, i: int, rng: np.random.Generator) -> None:
        """Read from another generator from now on."""
        self._rngs[i] = rng
        self._read[i] = self._words.shape[1]

    def take(self, here: np.ndarray, count: int) -> np.ndarray:
        """The next `count` words of the generators `here` (indices), (len(here), count)."""
        short = here[self._read[here] + count > self._words.shape[1]]
        if len(short):
            self._fetch(short, count)
        first = int(self._read[here[0]])
        if (self._read[here] == first).all():
            everyone = len(here) == len(self._words)
            rows = self._words[:, first : first + count]
            taken = rows if everyone else rows[here]
        else:
            columns = self._read[here][:, None] + np.arange(count)
            taken = self._words[here[:, None], columns]
        self._read[here] += count
        return taken

    def _fetch(self, short: np.ndarray, count: int) -> None:
        """Move what is unread to the front of the rows `short` and fill them up."""
        ahead = min(_EPISODES_AHEAD, max(1, _WORDS_AHEAD // (count * len(self._words))))
        if self._words.shape[1] < count:
            self._widen(count * ahead)
        width = self._words.shape[1]
        for i, read in zip(short.tolist(), self._read[short].tolist(), strict=True):
            rng = self._rngs[i]
            if rng is None:  # never seeded: from the system's entropy
                rng = self._rngs[i] = seeding.np_random()[0]
            row = self._words[i]
            if read == width:
                row[:] = draw_words(rng, width)
            else:
                row[: width - read] = row[read:].copy()
                row[width - read :] = draw_words(rng, read)
        self._read[short] = 0

    def _widen(self, width: int) -> None:
        """Longer rows; what is unread stays at their ends."""
        old, grown = self._words, width - self._words.shape[1]
        self._words = np.empty((len(old), width), dtype=np.uint64)
        self._words[:, grown:] = old
        self._read += grown


def generators(
    seed: int | Sequence[int | None] | None, count: int
) -> list[np.random.Generator | None]:
    """One generator for each of `count` environments, seeded as Gymnasium seeds a single one.

    From None (which leaves all as they are), from an int s (s + i), or as given.

    Raises:
        ValueError: for anything else.
        gymnasium.error.Error: for a negative seed.
    """
    if seed is None:
        return [None] * count
    if isinstance(seed, numbers.Integral) and not isinstance(seed, bool):
        seeds: list[Any] = [int(seed) + i for i in range(count)]
    else:
        seeds = list(seed) if isinstance(seed, (Sequence, np.ndarray)) else []
        whole = [s is None or isinstance(s, numbers.Integral) for s in seeds]
        if len(seeds) != count or not all(whole) or isinstance(seed, str):
            raise ValueError(f"seed must be None, an int or {count} of them, not {seed!r}")
    return [None if s is None else seeding.np_random(int(s))[0] for s in seeds]

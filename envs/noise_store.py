"""The variates of a fleet's running episodes, from which each step takes its own."""

from __future__ import annotations

import numpy as np

from slipcar.envs.episode import halves


class NoiseStore:
    """Standard normal variates of episodes, in halves (:func:`slipcar.envs.episode.halves`).

    Attributes:
        array: (2, half, substeps, columns, count) float32.

    Args:
        count: how many episodes run side by side.
        steps: control steps of each, N − 1.
        substeps: Euler–Maruyama steps in each.
        columns: Brownian motions, 3 + p.
    """

    def __init__(self, count: int, steps: int, substeps: int, columns: int) -> None:
        self._count, self._substeps = count, substeps
        self._everyone = np.arange(count)
        self.array: np.ndarray = np.empty((2, 0, 0, 0, 0), dtype=np.float32)
        self.fit(steps, columns)

    @property
    def half(self) -> int:
        """Steps in either half."""
        return self.array.shape[1]

    @property
    def columns(self) -> int:
        """Brownian motions."""
        return self.array.shape[3]

    def fit(self, steps: int, columns: int) -> None:
        """Room for episodes of just so many steps and motions; what was there is lost."""
        shape = (2, halves(steps), self._substeps, columns, self._count)
        if self.array.shape != shape:
            self.array = np.zeros(shape, dtype=np.float32)

    def put(
        self,
        here: np.ndarray,
        noise: np.ndarray,
        where: list[int],
        columns: int,
        kept: list[int],
    ) -> None:
        """New noise for some, beside that of others, which may be longer or have more columns.

        Args:
            here: which episodes, indices.
            noise: in halves, (2, half, substeps, c, len(here)).
            where: to which columns its own belong, c of them.
            columns: how many there are in all.
            kept: to which columns belong what was there before.
        """
        half = max(self.half, noise.shape[1])
        if (half, columns) != (self.half, self.columns):
            old = self._whole(self.array)
            self.fit(2 * half, columns)
            self._give(self._everyone, old, kept)
        self._give(here, self._whole(noise), where)

    def give(self, here: np.ndarray, noise: np.ndarray, where: list[int]) -> None:
        """Noise from outside for some.

        Args:
            here: which episodes, indices.
            noise: (len(here), steps, substeps, c).
            where: to which columns its own belong, c of them.
        """
        self._give(here, np.moveaxis(noise, 0, -1), where)

    def common(self, k: int) -> np.ndarray:
        """Variates of step k of all, indexed [substep, column, episode]."""
        half, k = divmod(k, self.half)
        return self.array[half, k]

    def each(self, steps: np.ndarray) -> np.ndarray:
        """Variates of step `steps[i]` of episode i, indexed [substep, column, episode]."""
        half, k = np.divmod(np.minimum(steps, 2 * self.half - 1), self.half)
        return np.moveaxis(self.array[half, k, :, :, self._everyone], 0, -1)

    @staticmethod
    def _whole(noise: np.ndarray) -> np.ndarray:
        return np.concatenate(list(noise))

    def _give(self, here: np.ndarray, noise: np.ndarray, where: list[int]) -> None:
        """Noise (steps, substeps, c, len(here)), each half for itself."""
        for block, first in zip(self.array, (0, self.half), strict=True):
            part = noise[first : first + self.half]
            for column, source in zip(where, np.moveaxis(part, 2, 0), strict=True):
                block[: len(part), :, column][..., here] = source

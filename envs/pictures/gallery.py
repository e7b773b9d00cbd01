"""The episodes of a vector environment as pictures: their trails so far, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.envs.pictures.tiles import MOST, Tiles

if TYPE_CHECKING:
    from slipcar.envs.scenario import Scenario

SHOWN = 16  #: sub-environments in a window


class Gallery:
    """Keeps the trails of a vector environment's episodes, and draws them.

    Args:
        count: sub-environments.
        human: a window with the first 16; otherwise all are drawn off screen.
        fps: frames per second of the window.

    Attributes:
        shown: how many are drawn, the first ones.

    Raises:
        ValueError: for more than 64 off screen.
    """

    def __init__(self, count: int, *, human: bool, fps: int) -> None:
        if count > MOST and not human:
            raise ValueError(
                f"render_mode='rgb_array' draws a picture of each sub-environment: num_envs must "
                f"be at most {MOST} for it, not {count}"
            )
        self.shown = min(count, SHOWN) if human else count
        self._human, self._fps = human, fps
        self._trails: list[list[np.ndarray]] = [[] for _ in range(self.shown)]
        self._tiles: Tiles | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles draw anew: pygame's surfaces cannot be copied."""
        return {**vars(self), "_tiles": None}

    def record(self, states: np.ndarray, started: np.ndarray, *, moved: bool) -> None:
        """Take down where the cars are now.

        Args:
            states: of at least the first `shown` sub-environments, (≥ shown, 5).
            started: numbers of those whose episodes begin here, (j,).
            moved: whether all others have taken a step; if not, they are where they were.
        """
        begins = set(np.asarray(started).tolist())
        for i, trail in enumerate(self._trails):
            if i in begins:
                trail.clear()
            elif not moved:
                continue
            trail.append(np.array(states[i], dtype=np.float64))

    def draw(self, scenarios: Sequence[Scenario], collided: np.ndarray) -> np.ndarray | None:
        """All tiles in one picture, of the size made for the first scenarios drawn.

        Args:
            scenarios: the worlds now, at least `shown`.
            collided: whether each path has met an obstacle so far, (≥ shown,).

        Returns:
            (H, W, 3) uint8; None for a window.
        """
        worlds = scenarios[: self.shown]
        if self._tiles is None:
            self._tiles = Tiles(worlds, human=self._human, fps=self._fps)
        for i, world in enumerate(worlds):
            self._tiles.enter(i, world)
        trails = [np.stack(trail) for trail in self._trails]
        return self._tiles.draw(trails, collided=collided[: self.shown])

    def frames(
        self, scenarios: Sequence[Scenario], collided: np.ndarray
    ) -> tuple[np.ndarray, ...] | None:
        """One picture for each sub-environment, as Gymnasium's wrappers expect; None for a window.

        All are of one size; see `draw`.
        """
        picture = self.draw(scenarios, collided)
        return None if picture is None or self._tiles is None else self._tiles.cut(picture)

    def close(self) -> None:
        """Close the window, if any."""
        if self._tiles is not None:
            self._tiles.close()

"""Many worlds at once: a grid of small scenes, one for each sub-environment.

Needs pygame (the extra `plot`), imported when the first grid is made.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.envs.overlay import Overlay
from slipcar.envs.pictures import sprites
from slipcar.envs.pictures.canvas import Canvas, import_pygame
from slipcar.envs.pictures.scene import Scene
from slipcar.envs.pictures.view import aspect

if TYPE_CHECKING:
    from slipcar.envs.scenario import Scenario

MOST = 64  #: tiles in one picture
_LARGEST = 1200  # [px]: longest side of a picture
_WIDEST, _FLATTEST, _TALLEST = 512, 0.5, 1.5  # a tile's width [px], its height over its width
_GAP, _BAR = 6, 3  # [px]
_GROUND, _BADGE = (226, 227, 222), (255, 255, 252)


class Tiles:
    """Draws up to 64 scenes in a near-square grid, off screen or in a window.

    Every tile has the same size, a number in its corner, a bar at its foot that grows with the
    episode's time, and a red frame once its car has met an obstacle.

    Args:
        scenarios: what to draw, one for each tile. The tiles' shape is made for them.
        human: open a window; otherwise pictures come back as arrays.
        fps: frames per second of the window.

    Attributes:
        size: width and height of the whole picture [px], divisible by 16 for codecs.
        tile: width and height of a tile [px], even.
        columns: tiles in a row.
        rows: rows of tiles.

    Raises:
        ValueError: for no scenario or more than 64.
        DependencyNotInstalled: without pygame.
        gymnasium.error.Error: if a window is asked for where there is no display.
    """

    def __init__(self, scenarios: Sequence[Scenario], *, human: bool = False, fps: int = 8) -> None:
        count = len(scenarios)
        if not 1 <= count <= MOST:
            raise ValueError(f"a picture has 1 to {MOST} tiles, not {count}")
        self._pygame = pygame = import_pygame()
        pygame.font.init()
        self._font = pygame.font.Font(None, 18)
        self.columns = math.ceil(math.sqrt(count))
        self.rows = math.ceil(count / self.columns)
        shape = float(np.median([aspect(scenario) for scenario in scenarios]))
        self.tile = _tile_size(self.columns, self.rows, min(max(shape, _FLATTEST), _TALLEST))
        used = [
            n * (length + _GAP) + _GAP
            for n, length in zip((self.columns, self.rows), self.tile, strict=True)
        ]
        self.size = (16 * math.ceil(used[0] / 16), 16 * math.ceil(used[1] / 16))
        self._canvas = Canvas(self.size, human=human, fps=fps)
        self._canvas.surface.fill(_GROUND)
        # In the middle of what rounding to codec blocks leaves.
        self._corners = [
            (
                (self.size[0] - used[0]) // 2 + _GAP + column * (self.tile[0] + _GAP),
                (self.size[1] - used[1]) // 2 + _GAP + row * (self.tile[1] + _GAP),
            )
            for row in range(self.rows)
            for column in range(self.columns)
        ][:count]
        self._places = [self._canvas.surface.subsurface(c, self.tile) for c in self._corners]
        self._badges = [self._badge(i) for i in range(count)]
        self._scenes = [self._scene(scenario) for scenario in scenarios]

    def __len__(self) -> int:
        return len(self._places)

    def enter(self, index: int, scenario: Scenario) -> None:
        """Draw another world in a tile from now on; nothing happens if it is the same object.

        Raises:
            ValueError: if there is no such tile.
        """
        if not 0 <= index < len(self):
            raise ValueError(f"tiles are numbered 0 to {len(self) - 1}, not {index}")
        if scenario is not self._scenes[index].scenario:
            self._scenes[index] = self._scene(scenario)

    def draw(
        self,
        trails: Sequence[np.ndarray],
        *,
        collided: Sequence[bool] | np.ndarray,
        overlays: Sequence[Overlay | None] | None = None,
        times: Sequence[float] | None = None,
    ) -> np.ndarray | None:
        """One picture of all tiles.

        Args:
            trails: of each tile, states from its episode's start to now, (k, 5), k ≥ 1.
            collided: whether each path has met an obstacle so far.
            overlays: what each tile's controller means to do, if it says.
            times: since each episode's start [s]; by default the trails end at nodes.

        Returns:
            (H, W, 3) uint8 off screen; None for a window, also once its user has closed it.

        Raises:
            ValueError: if there is not one of each for every tile.
        """
        given = {"trails": trails, "collided": collided, "overlays": overlays, "times": times}
        for name, values in given.items():
            if values is not None and len(values) != len(self):
                raise ValueError(
                    f"{name} must be {len(self)}, one for each tile, not {len(values)}"
                )
        if self._canvas.closed:
            return None
        for i, (place, scene) in enumerate(zip(self._places, self._scenes, strict=True)):
            overlay = None if overlays is None else overlays[i]
            hit = bool(collided[i])
            scene.draw(place, trails[i], collided=hit, overlay=overlay)
            t = (len(trails[i]) - 1) * scene.scenario.dt if times is None else times[i]
            self._decorate(i, t / scene.scenario.horizon, hit)
        return self._canvas.hand_out()

    def cut(self, picture: np.ndarray) -> tuple[np.ndarray, ...]:
        """The tiles of a picture (H, W, 3), one array each: what a `VectorEnv` renders."""
        width, height = self.tile
        return tuple(picture[y : y + height, x : x + width].copy() for x, y in self._corners)

    def close(self) -> None:
        """Close the window, if any; drawing afterwards does nothing."""
        self._canvas.close()

    def _scene(self, scenario: Scenario) -> Scene:
        return Scene(self._pygame, scenario, self.tile, self._canvas.surface)

    def _decorate(self, index: int, progress: float, collided: bool) -> None:
        place, (width, height) = self._places[index], self.tile
        colour = sprites.CRASH if collided else sprites.FAINT
        elapsed = round(width * min(max(progress, 0.0), 1.0))
        place.fill(colour, (0, height - _BAR, elapsed, _BAR))
        if collided:
            self._pygame.draw.rect(place, colour, (0, 0, width, height), width=_BAR)
        place.blit(self._badges[index], (0, 0))

    def _badge(self, index: int) -> Any:
        text = self._font.render(str(index), True, sprites.INK)
        badge = self._pygame.Surface((text.get_width() + 12, 20), 0, self._canvas.surface)
        badge.fill(_GROUND)
        badge.blit(text, text.get_rect(center=badge.get_rect().center))
        return badge


def _tile_size(columns: int, rows: int, shape: float) -> tuple[int, int]:
    """Width and height of the largest tiles of this shape that fit, even."""
    wide = (_LARGEST - _GAP) / columns - _GAP
    tall = (_LARGEST - _GAP) / rows - _GAP
    width = min(wide, tall / shape, _WIDEST)
    return 2 * int(width / 2), 2 * int(width * shape / 2)

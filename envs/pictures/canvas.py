"""Something to draw on: pixels that NumPy and pygame share, handed out or shown in a window.

Needs pygame (the extra `plot`), imported when the first canvas is made. Off screen
no display is needed.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled, Error

from slipcar.envs.extras import install


class Canvas:
    """A picture in the making.

    Args:
        size: width and height [px].
        human: open a window of that size; otherwise pictures are handed out as arrays.
        fps: frames per second of the window.

    Attributes:
        surface: what pygame draws on.
        closed: whether a window was closed, by its user or by `close`; nothing is shown then.

    Raises:
        DependencyNotInstalled: without pygame.
        gymnasium.error.Error: if a window is asked for where there is no display.
    """

    def __init__(self, size: tuple[int, int], *, human: bool, fps: int) -> None:
        self._pygame = pygame = import_pygame()
        # Three bytes a pixel, as the frames are: handing one out is a copy and nothing else.
        self._pixels = np.zeros((size[1], size[0], 3), dtype=np.uint8)
        self.surface = pygame.image.frombuffer(self._pixels, size, "RGB")
        self.closed = False
        self._fps = fps
        self._window: Any = None
        if human:
            self._open(size)

    def hand_out(self) -> np.ndarray | None:
        """The picture, (H, W, 3) uint8, the caller's to keep; None where a window shows it."""
        if self._window is None:
            return None if self.closed else self._pixels.copy()
        pygame = self._pygame
        # A user who closes the window wants it gone, not the episode stopped or stuck.
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            return None
        self._window.blit(self.surface, (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)
        return None

    def close(self) -> None:
        """Close the window, if any; nothing is handed out afterwards."""
        self.closed = True
        if self._window is not None:
            self._window = None
            self._pygame.display.quit()

    def _open(self, size: tuple[int, int]) -> None:
        pygame = open_display()
        try:
            self._window = pygame.display.set_mode(size)
        except pygame.error as error:
            raise _no_display(str(error)) from error
        pygame.display.set_caption("slipcar")
        self._clock = pygame.time.Clock()


def open_display() -> Any:
    """Pygame with its display open: one that somebody sees, or that was asked for.

    Raises:
        DependencyNotInstalled: without pygame.
        gymnasium.error.Error: without a display.
    """
    pygame = import_pygame()
    try:
        pygame.display.init()
    except pygame.error as error:
        raise _no_display(str(error)) from error
    driver = pygame.display.get_driver()
    # Where there is no display, SDL takes one of these without a word.
    if driver in ("offscreen", "dummy") and os.environ.get("SDL_VIDEODRIVER") != driver:
        pygame.display.quit()
        raise _no_display("no screen is attached")
    return pygame


def _no_display(reason: str) -> Error:
    return Error(f"render_mode='human' found no display ({reason}); use render_mode='rgb_array'")


def import_pygame() -> Any:
    """Pygame, or an error that says how to get it.

    Raises:
        DependencyNotInstalled: without pygame.
    """
    try:
        import pygame
    except ImportError as error:
        raise DependencyNotInstalled(f"rendering needs pygame: {install('plot')}") from error
    return pygame

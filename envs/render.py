"""`rgb_array` and `human`: the scene with a line of numbers under it.

Needs pygame (the extra `plot`), imported when the first screen is made. Frames
for `rgb_array` are drawn off screen and need no display.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slipcar.envs.overlay import MASS, Overlay
from slipcar.envs.pictures import sprites
from slipcar.envs.pictures.canvas import Canvas, import_pygame
from slipcar.envs.pictures.scene import Scene
from slipcar.envs.pictures.view import View, aspect

if TYPE_CHECKING:
    from slipcar.envs.scenario import Scenario

WIDTH, MIN_HEIGHT, MAX_HEIGHT, STRIP = 640, 320, 768, 48  # [px], all divisible by 16 for codecs


class Screen:
    """Draws the scene of one scenario at a time, off screen or in a window.

    Args:
        scenario: what to draw; the picture's height is made for it.
        human: open a window; otherwise frames come back as arrays.
        fps: frames per second of the window.

    Attributes:
        size: width and height of every frame [px].

    Raises:
        DependencyNotInstalled: without pygame.
        gymnasium.error.Error: if a window is asked for where there is no display.
    """

    def __init__(self, scenario: Scenario, *, human: bool, fps: int) -> None:
        self._pygame = pygame = import_pygame()
        pygame.font.init()
        self._font = pygame.font.Font(None, 23)
        self._small = pygame.font.Font(None, 18)
        wanted = min(max(WIDTH * aspect(scenario), MIN_HEIGHT), MAX_HEIGHT)
        self._scene_size = (WIDTH, int(16 * round(wanted / 16)))
        self.size = (WIDTH, self._scene_size[1] + STRIP)
        self._canvas = Canvas(self.size, human=human, fps=fps)
        self._upper = self._canvas.surface.subsurface((0, 0), self._scene_size)
        self.enter(scenario)

    @property
    def scenario(self) -> Scenario:
        """The world that is drawn."""
        return self._scene.scenario

    @property
    def view(self) -> View:
        """Where metres land on pixels."""
        return self._scene.view

    def enter(self, scenario: Scenario) -> None:
        """Draw another world from now on, in frames of the same size."""
        self._scene = Scene(self._pygame, scenario, self._scene_size, self._canvas.surface)
        self._draw_empty_strip()

    def draw(
        self,
        trail: np.ndarray,
        *,
        collided: bool,
        overlay: Overlay | None = None,
        time: float | None = None,
    ) -> np.ndarray | None:
        """One frame.

        Args:
            trail: states from the episode's start to now, (k, 5), k ≥ 1.
            collided: whether the path has met an obstacle so far.
            overlay: what the controller means to do, if it says. Drawn once as long as it is
                the same object.
            time: since the episode's start [s]; by default the trail's end is a node.

        Returns:
            (H, W, 3) uint8 off screen; None for a window, also once its user has closed it.
        """
        if self._canvas.closed:
            return None
        self._scene.draw(self._upper, trail, collided=collided, overlay=overlay)
        if overlay is not None:
            self._draw_legend(overlay)
        t = (len(trail) - 1) * self.scenario.dt if time is None else time
        self._draw_status(t, trail[-1], collided)
        return self._canvas.hand_out()

    def close(self) -> None:
        """Close the window, if any; drawing afterwards does nothing."""
        self._canvas.close()

    def _draw_legend(self, overlay: Overlay) -> None:
        text = "plan" if overlay.covariances is None else f"plan and {MASS:.0%} region"
        self._upper.fill(sprites.PAPER, (6, 5, 38 + self._small.size(text)[0], 20))
        self._pygame.draw.line(self._upper, sprites.PLAN, (12, 14), (30, 14), 2)
        sprites.write(self._upper, self._small, text, (36, 15), sprites.PLAN)

    def _draw_status(self, t: float, x: np.ndarray, collided: bool) -> None:
        surface, row = self._canvas.surface, self._scene_size[1] + STRIP // 2
        surface.blit(self._strip, (0, self._scene_size[1]))
        v, omega = np.round(x[3:], 2) + 0.0  # no minus before 0.00
        for left, text in (
            (16, f"t  {t:.2f} s"),
            (110, f"v  {v:+.2f} m/s"),
            (240, f"ω  {omega:+.2f} rad/s"),
        ):
            sprites.write(surface, self._font, text.replace("-", "−"), (left, row), sprites.INK)
        if collided:
            sprites.write(surface, self._font, "collision", (386, row), sprites.CRASH)

    def _draw_empty_strip(self) -> None:
        """The ground of the status line, with the scale of the trail's colours."""
        pygame = self._pygame
        self._strip = strip = pygame.Surface((WIDTH, STRIP), 0, self._canvas.surface)
        strip.fill(sprites.STRIP_FILL)
        pygame.draw.line(strip, sprites.EDGE, (0, 0), (WIDTH, 0))
        left, width, row = WIDTH - 150, 70, STRIP // 2
        for i, colour in enumerate(sprites.speed_colours(np.linspace(0.0, 1.0, width))):
            pygame.draw.line(strip, colour, (left + i, row - 3), (left + i, row + 3))
        sprites.write(strip, self._small, "0", (left - 12, row), sprites.FAINT)
        text = f"{self._scene.top_speed:g} m/s"
        sprites.write(strip, self._small, text, (left + width + 6, row), sprites.FAINT)

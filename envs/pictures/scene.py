"""One world seen from above: obstacles with their clearance rings, start, goal, car and trail.

The body is drawn for the eye alone: a collision is the car's *centre* inside a bare radius,
so the white dot on its roof is what must stay out of the discs. What does not move is drawn
once, at three times the resolution; of a trail that grows, only what is new.
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.envs.overlay import Overlay
from slipcar.envs.pictures import sprites
from slipcar.envs.pictures.overlay_drawing import draw_overlay
from slipcar.envs.pictures.view import CAR_LENGTH, View, grid_step

if TYPE_CHECKING:
    from slipcar.envs.scenario import Scenario

_OVERSAMPLING = 3


class Scene:
    """Draws one scenario at one size, on a surface of the same size.

    Args:
        pygame: the module.
        scenario: what to draw.
        size: width and height [px].
        like: a surface whose pixel format those drawn on have.

    Attributes:
        scenario: what is drawn.
        view: where metres land on pixels.
        top_speed: the end of the trail's colour scale [m/s].
    """

    def __init__(self, pygame: Any, scenario: Scenario, size: tuple[int, int], like: Any) -> None:
        self._pygame = pygame
        self.scenario = scenario
        self.view = View.of(scenario, *size)
        # Peak speed of a car that accelerates half the way and brakes the other half,
        # rounded up to 0.5 m/s.
        distance = math.dist(scenario.goal[:2], scenario.start[:2])
        self.top_speed = max(0.5, math.ceil(4.0 * distance / scenario.horizon) / 2.0)
        self._font = pygame.font.Font(None, 18)
        self._car_length = max(14 if self.view.small else 20, round(CAR_LENGTH * self.view.scale))
        self._background = pygame.Surface(size, 0, like)
        self._draw_background()
        # Background with the overlay; the same with the trail but for its last stretch.
        self._overlay: Overlay | None = None
        self._ground = self._background.copy()
        self._layer = self._background.copy()
        self._settled = np.empty((0, 5))
        self._hits = np.empty((0, 2))

    def draw(
        self, surface: Any, trail: np.ndarray, *, collided: bool, overlay: Overlay | None = None
    ) -> None:
        """Draw the world as it is now.

        Args:
            surface: of this scene's size; everything on it is drawn over.
            trail: states from the episode's start to now, (k, 5), k ≥ 1.
            collided: whether the path has met an obstacle so far.
            overlay: what the controller means to do, if it says.
        """
        self._settle(trail[:-1], overlay)
        surface.blit(self._layer, (0, 0))
        ends = self.view.pixels(trail[-2:, :2])
        if len(trail) > 1:
            self._draw_stretch(surface, trail[-2:], ends)
        for x, y in self._hits.tolist():
            self._draw_cross(surface, x, y)
        self._draw_car(surface, ends[-1], float(trail[-1, 2]), collided)

    # --------------------------------------------------------------------------- what moves

    def _settle(self, nodes: np.ndarray, overlay: Overlay | None) -> None:
        """Bring the layer up to these nodes (k, 5), from what it holds if that is their start."""
        known = len(self._settled)
        anew = overlay is not self._overlay
        if anew:
            self._overlay = overlay
            self._ground.blit(self._background, (0, 0))
            if overlay is not None:
                draw_overlay(
                    self._pygame, self._ground, self.view, overlay, nodes=self.scenario.nodes
                )
        if anew or not np.array_equal(self._settled, nodes[:known], equal_nan=True):
            self._layer.blit(self._ground, (0, 0))
            self._hits = self._hits[:0]
            known = 0
        if len(nodes) == known:
            self._settled = self._settled[:known]
            return
        points = self.view.pixels(nodes[max(known - 1, 0) :, :2])
        self._draw_stretch(self._layer, nodes[max(known - 1, 0) :], points)
        hit = self.scenario.signed_distance(nodes[known:]) < 0.0
        self._hits = np.vstack([self._hits, points[-len(hit) :][hit]])
        self._settled = nodes.copy()

    def _draw_stretch(self, surface: Any, trail: np.ndarray, points: np.ndarray) -> None:
        """A piece of the trail: states (k, 5) and their pixels (k, 2)."""
        line = self._pygame.draw.aaline
        along = np.diff(points, axis=0)
        length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / length
        speeds = 0.5 * np.abs(trail[1:, 3] + trail[:-1, 3])
        colours = sprites.speed_colours(speeds / self.top_speed)
        # pygame's wide lines are jagged; smooth thin ones, side by side, are not. Stretch by
        # stretch, so that a trail drawn in pieces is the trail drawn at once.
        offsets = np.array((-0.8, 0.8, 0.0) if self.view.small else (-1.2, 1.2, -0.4, 0.4))
        shift = offsets[:, None] * normal[:, None]  # (k − 1, offsets, 2)
        starts = (points[:-1, None] + shift).tolist()
        ends = (points[1:, None] + shift).tolist()
        for colour, first, last in zip(colours, starts, ends, strict=True):
            for start, end in zip(first, last, strict=True):
                line(surface, colour, start, end)

    def _draw_cross(self, surface: Any, x: float, y: float) -> None:
        half = 2.5 if self.view.small else 4.0
        for dx in (-half, half):
            for shift in (-0.5, 0.5):
                self._pygame.draw.aaline(
                    surface, sprites.CRASH, (x - dx + shift, y - half), (x + dx + shift, y + half)
                )

    def _draw_car(self, surface: Any, point: np.ndarray, heading: float, collided: bool) -> None:
        colour = sprites.CRASH if collided else sprites.CAR
        inside = np.clip(point, 14.0, [self.view.width - 14.0, self.view.height - 14.0])
        if np.abs(point - inside).max() > 28.0:  # out of sight: point to where it is
            self._draw_pointer(surface, inside, point - inside, colour)
            return
        car = _sprite(self._pygame, self._car_length, colour, False)
        sprites.blit_turned(self._pygame, surface, car, point, heading)

    def _draw_pointer(
        self, surface: Any, at: np.ndarray, towards: np.ndarray, colour: tuple
    ) -> None:
        forward = towards / np.hypot(*towards)
        side = np.array([-forward[1], forward[0]])
        corners = [
            at + 11.0 * forward,
            at - 7.0 * forward + 8.0 * side,
            at - 7.0 * forward - 8.0 * side,
        ]
        self._pygame.draw.polygon(surface, colour, [tuple(c) for c in corners])

    # --------------------------------------------------------------------- what stands still

    def _draw_background(self) -> None:
        pygame, view, scenario = self._pygame, self.view, self.scenario
        surface = self._background
        fine = pygame.Surface((view.width * _OVERSAMPLING, view.height * _OVERSAMPLING), 0, surface)
        fine.fill(sprites.PAPER)
        metre = view.scale * _OVERSAMPLING
        centres = view.pixels(scenario.obstacles[:, :2]) * _OVERSAMPLING
        radii = scenario.obstacles[:, 2] * metre
        if scenario.clearance > 0.0:
            for centre, ring in zip(centres, radii + scenario.clearance * metre, strict=True):
                sprites.dashed_circle(pygame, fine, sprites.RING, centre, ring, _OVERSAMPLING)
        rim = _OVERSAMPLING if self.view.small else 2 * _OVERSAMPLING - 1
        for centre, size in zip(centres, radii, strict=True):
            pygame.draw.circle(fine, sprites.OBSTACLE, centre, size)
            pygame.draw.circle(fine, sprites.OBSTACLE_RIM, centre, size, width=rim)
        pygame.transform.smoothscale(fine, (view.width, view.height), surface)
        self._draw_grid(surface)
        length = self._car_length
        for state, colour, name in (
            (scenario.start, sprites.START, "start"),
            (scenario.goal, sprites.GOAL, "goal"),
        ):
            at = view.pixels(state[:2])
            ghost = _sprite(pygame, length, colour, True)
            sprites.blit_turned(pygame, surface, ghost, at, float(state[2]))
            if not self.view.small:
                label = self._font.render(name, True, colour)
                surface.blit(label, label.get_rect(center=(at[0], at[1] + 0.5 * length + 11)))

    def _draw_grid(self, surface: Any) -> None:
        """Lines every metre (every 2, 5, 10, ... in large worlds), blended with what is there."""
        pygame, view = self._pygame, self.view
        step = grid_step(view.scale)
        far = np.array([view.left, view.bottom]) + np.array([view.width, view.height]) / view.scale
        lines = pygame.Surface((view.width, view.height), pygame.SRCALPHA, 32)
        for axis, first in enumerate((view.left, view.bottom)):
            for value in np.arange(math.ceil(first / step), far[axis] / step) * step:
                at = view.pixels(np.where(np.arange(2) == axis, value, [view.left, view.bottom]))
                x, y = at.tolist()
                ends = ((x, 0), (x, view.height)) if axis == 0 else ((0, y), (view.width, y))
                pygame.draw.line(lines, sprites.GRID, *ends)
                text = f"{value:g}".replace("-", "−") if axis or value else "0 m"
                spot = (x + 4, view.height - 9) if axis == 0 else (4, y - 8)
                # The corner belongs to x.
                if not self.view.small and (axis == 0 or 10 < spot[1] < view.height - 24):
                    sprites.write(lines, self._font, text, spot, sprites.FAINT)
        surface.blit(lines, (0, 0))


@functools.lru_cache(maxsize=64)
def _sprite(pygame: Any, length: int, colour: tuple, ghost: bool) -> Any:
    return sprites.car_sprite(pygame, length, colour, ghost)

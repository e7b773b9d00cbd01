"""The scene as pixels: obstacles with their clearance rings, start, goal, car and trail.

The body is drawn for the eye alone: a collision is the car's *centre* inside a bare radius,
so the white dot on its roof is what must stay out of the discs. What does not move is drawn
once, at three times the resolution, and copied into every frame.

Needs pygame (`pip install "slipcar[plot]"`), imported when the first screen is made. Frames
for `rgb_array` are drawn off screen and need no display.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import DependencyNotInstalled, Error

from slipcar.envs.cost import signed_distance

if TYPE_CHECKING:
    from slipcar.envs.scenario import Scenario

WIDTH, MIN_HEIGHT, MAX_HEIGHT, STRIP = 640, 320, 768, 48  # [px], all divisible by 16 for codecs
CAR_LENGTH, CAR_WIDTH = 0.30, 0.17  # [m]
_MIN_CAR_PIXELS = 20.0
_OVERSAMPLING = 3

_PAPER, _STRIP_FILL, _EDGE = (251, 251, 248), (242, 242, 238), (214, 216, 212)
_INK, _FAINT, _GRID = (45, 52, 60), (140, 146, 152), (0, 0, 0, 18)
_OBSTACLE, _OBSTACLE_RIM, _RING = (222, 196, 184), (166, 104, 80), (196, 140, 118)
_GOAL, _START, _CAR, _CRASH = (38, 145, 92), (150, 156, 162), (32, 96, 178), (206, 44, 48)
_SPEED_STOPS = np.array([(250, 190, 70), (232, 98, 90), (148, 52, 142), (46, 28, 110)], dtype=float)


@dataclasses.dataclass(frozen=True)
class View:
    """Where metres land on pixels: equal scales, y up.

    Attributes:
        left: x of the left edge [m].
        bottom: y of the lower edge [m].
        scale: pixels per metre.
        height: of the scene, without the status strip [px]; its width is `WIDTH`.
    """

    left: float
    bottom: float
    scale: float
    height: int

    @staticmethod
    def of(scenario: Scenario) -> View:
        """The view that shows start, goal and every clearance ring, with a margin."""
        centres = np.vstack([scenario.start[:2], scenario.goal[:2], scenario.obstacles[:, :2]])
        reach = np.full(len(centres), CAR_LENGTH)
        reach[2:] = scenario.obstacles[:, 2] + scenario.clearance
        low = (centres - reach[:, None]).min(axis=0)
        high = (centres + reach[:, None]).max(axis=0)
        margin = max(0.2, 0.06 * float((high - low).max()))
        extent = high - low + 2.0 * margin
        wanted = WIDTH * extent[1] / extent[0]
        height = int(16 * round(min(max(wanted, MIN_HEIGHT), MAX_HEIGHT) / 16))
        scale = float(min(WIDTH / extent[0], height / extent[1]))
        middle = 0.5 * (low + high)
        left, bottom = middle - 0.5 * np.array([WIDTH, height]) / scale
        return View(float(left), float(bottom), scale, height)

    def pixels(self, positions: np.ndarray) -> np.ndarray:
        """Pixel coordinates (..., 2) of positions (..., 2) [m], finite and not absurdly far.

        A car may leave the view; pygame takes no coordinates beyond the range of a C int.
        """
        far = 4.0 * max(WIDTH, self.height)
        x = (positions[..., 0] - self.left) * self.scale
        y = self.height - (positions[..., 1] - self.bottom) * self.scale
        return np.clip(np.nan_to_num(np.stack([x, y], axis=-1)), -far, far)


class Screen:
    """Draws the scene of one scenario, off screen or in a window.

    Args:
        scenario: what to draw.
        human: open a window; otherwise frames come back as arrays.
        fps: frames per second of the window.

    Raises:
        DependencyNotInstalled: without pygame.
        gymnasium.error.Error: if a window is asked for where there is no display.
    """

    def __init__(self, scenario: Scenario, *, human: bool, fps: int) -> None:
        self._pygame = pygame = _import_pygame()
        self.scenario = scenario
        self.view = View.of(scenario)
        self.size = (WIDTH, self.view.height + STRIP)
        self._fps = fps
        # Peak speed of a car that accelerates half the way and brakes the other half,
        # rounded up to 0.5 m/s: the end of the trail's colour scale.
        distance = math.dist(scenario.goal[:2], scenario.start[:2])
        self.top_speed = max(0.5, math.ceil(4.0 * distance / scenario.horizon) / 2.0)
        pygame.font.init()
        self._font = pygame.font.Font(None, 23)
        self._small = pygame.font.Font(None, 18)
        self._canvas = pygame.Surface(self.size, 0, 32)
        length = max(_MIN_CAR_PIXELS, CAR_LENGTH * self.view.scale)
        self._cars = {
            False: _car_sprite(pygame, length, _CAR),
            True: _car_sprite(pygame, length, _CRASH),
        }
        self._background = self._draw_background(length)
        self._window: Any = None
        self._closed = False
        if human:
            self._open_window()

    # ------------------------------------------------------------------------------- frames

    def draw(self, trail: np.ndarray, *, collided: bool) -> np.ndarray | None:
        """One frame.

        Args:
            trail: states from the episode's start to now, (k, 5), k ≥ 1.
            collided: whether the path has met an obstacle so far.

        Returns:
            (H, W, 3) uint8 off screen; None for a window, also once its user has closed it.
        """
        if self._closed:
            return None
        self._canvas.blit(self._background, (0, 0))
        self._canvas.set_clip((0, 0, WIDTH, self.view.height))
        self._draw_trail(trail)
        self._draw_car(trail[-1], collided)
        self._canvas.set_clip(None)
        self._draw_status(trail, collided)
        if self._window is not None:
            self._show()
            return None
        raw = self._pygame.image.tobytes(self._canvas, "RGB")
        return np.frombuffer(raw, np.uint8).reshape(self.size[1], self.size[0], 3).copy()

    def close(self) -> None:
        """Close the window, if any; drawing afterwards does nothing."""
        self._closed = True
        if self._window is not None:
            self._window = None
            self._pygame.display.quit()

    def _open_window(self) -> None:
        pygame = self._pygame
        try:
            pygame.display.init()
            self._window = pygame.display.set_mode(self.size)
        except pygame.error as error:
            raise Error(
                f"render_mode='human' found no display ({error}); use render_mode='rgb_array'"
            ) from error
        pygame.display.set_caption("slipcar")
        self._clock = pygame.time.Clock()

    def _show(self) -> None:
        pygame = self._pygame
        # A user who closes the window wants it gone, not the episode stopped or stuck.
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            return
        self._window.blit(self._canvas, (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)

    # --------------------------------------------------------------------------- what moves

    def _draw_trail(self, trail: np.ndarray) -> None:
        pygame, canvas = self._pygame, self._canvas
        points = self.view.pixels(trail[:, :2])
        along = np.diff(points, axis=0)
        length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / length
        colours = speed_colours(0.5 * np.abs(trail[1:, 3] + trail[:-1, 3]) / self.top_speed)
        # pygame's wide lines are jagged; smooth thin ones, side by side, are not.
        for offset in (-1.2, 1.2, -0.4, 0.4):
            starts = (points[:-1] + offset * normal).tolist()
            ends = (points[1:] + offset * normal).tolist()
            for colour, start, end in zip(colours, starts, ends, strict=True):
                pygame.draw.aaline(canvas, colour, start, end)
        hit = signed_distance(trail, self.scenario.obstacles) < 0.0
        for x, y in points[hit].tolist():
            for dx in (-4.0, 4.0):
                for shift in (-0.5, 0.5):
                    pygame.draw.aaline(
                        canvas, _CRASH, (x - dx + shift, y - 4.0), (x + dx + shift, y + 4.0)
                    )

    def _draw_car(self, x: np.ndarray, collided: bool) -> None:
        point = self.view.pixels(x[:2])
        inside = np.clip(point, 14.0, [WIDTH - 14.0, self.view.height - 14.0])
        if np.abs(point - inside).max() > 28.0:  # out of sight: point to where it is
            self._draw_pointer(inside, point - inside, _CRASH if collided else _CAR)
            return
        self._blit_turned(self._canvas, self._cars[collided], point, float(x[2]))

    def _draw_pointer(self, at: np.ndarray, towards: np.ndarray, colour: tuple) -> None:
        forward = towards / np.hypot(*towards)
        side = np.array([-forward[1], forward[0]])
        corners = [
            at + 11.0 * forward,
            at - 7.0 * forward + 8.0 * side,
            at - 7.0 * forward - 8.0 * side,
        ]
        self._pygame.draw.polygon(self._canvas, colour, [tuple(c) for c in corners])

    def _draw_status(self, trail: np.ndarray, collided: bool) -> None:
        t = (len(trail) - 1) * self.scenario.dt
        v, omega = np.round(trail[-1, 3:], 2) + 0.0  # no minus before 0.00
        row = self.view.height + STRIP // 2
        for left, text in (
            (16, f"t  {t:.2f} s"),
            (110, f"v  {v:+.2f} m/s"),
            (240, f"ω  {omega:+.2f} rad/s"),
        ):
            self._write(self._canvas, self._font, text.replace("-", "−"), (left, row), _INK)
        if collided:
            self._write(self._canvas, self._font, "collision", (386, row), _CRASH)

    # --------------------------------------------------------------------- what stands still

    def _draw_background(self, car_length: float) -> Any:
        pygame, view = self._pygame, self.view
        fine = pygame.Surface((WIDTH * _OVERSAMPLING, view.height * _OVERSAMPLING), 0, 32)
        fine.fill(_PAPER)
        metre = view.scale * _OVERSAMPLING
        centres = view.pixels(self.scenario.obstacles[:, :2]) * _OVERSAMPLING
        radii = self.scenario.obstacles[:, 2] * metre
        if self.scenario.clearance > 0.0:
            for centre, ring in zip(centres, radii + self.scenario.clearance * metre, strict=True):
                _dashed_circle(pygame, fine, _RING, centre, ring)
        for centre, size in zip(centres, radii, strict=True):
            pygame.draw.circle(fine, _OBSTACLE, centre, size)
            pygame.draw.circle(fine, _OBSTACLE_RIM, centre, size, width=2 * _OVERSAMPLING - 1)
        scene = pygame.transform.smoothscale(fine, (WIDTH, view.height))
        background = pygame.Surface(self.size, 0, 32)
        background.fill(_STRIP_FILL)
        background.blit(scene, (0, 0))
        self._draw_grid(background)
        for state, colour, name in (
            (self.scenario.start, _START, "start"),
            (self.scenario.goal, _GOAL, "goal"),
        ):
            at = view.pixels(state[:2])
            ghost = _car_sprite(self._pygame, car_length, colour, ghost=True)
            self._blit_turned(background, ghost, at, float(state[2]))
            label = self._small.render(name, True, colour)
            background.blit(label, label.get_rect(center=(at[0], at[1] + 0.5 * car_length + 8)))
        pygame.draw.line(background, _EDGE, (0, view.height), (WIDTH, view.height))
        self._draw_speed_scale(background)
        return background

    def _draw_grid(self, surface: Any) -> None:
        """Lines every metre (every 2, 5, 10, ... in large worlds), blended with what is there."""
        pygame, view = self._pygame, self.view
        step = grid_step(view.scale)
        far = np.array([view.left + WIDTH / view.scale, view.bottom + view.height / view.scale])
        overlay = pygame.Surface((WIDTH, view.height), pygame.SRCALPHA, 32)
        for axis, first in enumerate((view.left, view.bottom)):
            for value in np.arange(math.ceil(first / step), far[axis] / step) * step:
                at = view.pixels(np.where(np.arange(2) == axis, value, [view.left, view.bottom]))
                x, y = at.tolist()
                ends = ((x, 0), (x, view.height)) if axis == 0 else ((0, y), (WIDTH, y))
                pygame.draw.line(overlay, _GRID, *ends)
                text = f"{value:g}".replace("-", "−") if axis or value else "0 m"
                spot = (x + 4, view.height - 9) if axis == 0 else (4, y - 8)
                if axis == 0 or 10 < spot[1] < view.height - 24:  # the corner belongs to x
                    self._write(overlay, self._small, text, spot, _FAINT)
        surface.blit(overlay, (0, 0))

    def _draw_speed_scale(self, surface: Any) -> None:
        left, width, row = WIDTH - 150, 70, self.view.height + STRIP // 2
        for i, colour in enumerate(speed_colours(np.linspace(0.0, 1.0, width))):
            self._pygame.draw.line(surface, colour, (left + i, row - 3), (left + i, row + 3))
        self._write(surface, self._small, "0", (left - 12, row), _FAINT)
        self._write(
            surface, self._small, f"{self.top_speed:g} m/s", (left + width + 6, row), _FAINT
        )

    def _write(self, surface: Any, font: Any, text: str, at: tuple, colour: tuple) -> None:
        image = font.render(text, True, colour)
        surface.blit(image, image.get_rect(midleft=at))

    def _blit_turned(self, surface: Any, sprite: Any, at: np.ndarray, heading: float) -> None:
        angle = math.degrees(heading) if math.isfinite(heading) else 0.0
        turned = self._pygame.transform.rotozoom(sprite, math.fmod(angle, 360.0), 0.5)
        surface.blit(turned, turned.get_rect(center=at.tolist()))


def speed_colours(fraction: np.ndarray) -> list[tuple[int, int, int]]:
    """Colours of speeds given as fractions of the top speed, (k,), slow is amber, fast indigo."""
    position = np.clip(np.nan_to_num(fraction), 0.0, 1.0) * (len(_SPEED_STOPS) - 1)
    stops = np.arange(len(_SPEED_STOPS))
    channels = [np.interp(position, stops, _SPEED_STOPS[:, c]) for c in range(3)]
    return [(int(r), int(g), int(b)) for r, g, b in zip(*channels, strict=True)]


def grid_step(scale: float) -> float:
    """Distance between grid lines [m]: 1, 2, 5, 10, ..., at least 40 pixels apart."""
    step = 1.0
    for factor in (2.0, 2.5, 2.0) * 100:
        if step * scale >= 40.0:
            break
        step *= factor
    return step


def _dashed_circle(pygame: Any, surface: Any, colour: tuple, centre: Any, radius: float) -> None:
    dashes = max(12, int(math.tau * radius / (12.0 * _OVERSAMPLING)))
    for i in range(dashes):
        angles = math.tau / dashes * (i + np.linspace(0.0, 0.55, 6))
        rim = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        half = 0.6 * _OVERSAMPLING
        corners = np.vstack([centre + (radius + half) * rim, centre + (radius - half) * rim[::-1]])
        pygame.draw.polygon(surface, colour, corners.tolist())


def _car_sprite(pygame: Any, length: float, colour: tuple, ghost: bool = False) -> Any:
    """The car heading along +x, twice as large as it is shown, on a transparent ground."""
    unit = 8.0 * length  # eight times oversampled, then halved twice for smooth edges
    width = unit * CAR_WIDTH / CAR_LENGTH
    size = (int(1.25 * unit), int(1.25 * unit))
    cx, cy = 0.5 * size[0], 0.5 * size[1]
    clear = (*colour, 0)
    sprite = pygame.Surface(size, pygame.SRCALPHA, 32)
    sprite.fill(clear)

    def box(x: float, y: float, w: float, h: float, fill: tuple, radius: float) -> None:
        """Rounded rectangle; centre and size in units of length (x, w) and width (y, h)."""
        rect = pygame.Rect(0, 0, round(w * unit), round(h * width))
        rect.center = (round(cx + x * unit), round(cy + y * width))
        pygame.draw.rect(sprite, fill, rect, border_radius=round(radius * width))

    def glass(x_rear: float, x_front: float, h_rear: float, h_front: float, fill: tuple) -> None:
        corners = [(x_rear, -h_rear), (x_front, -h_front), (x_front, h_front), (x_rear, h_rear)]
        pygame.draw.polygon(sprite, fill, [(cx + x * unit, cy + y * width) for x, y in corners])

    if ghost:
        box(0.0, 0.0, 1.0, 1.0, (*colour, 255), 0.32)
        box(0.0, 0.0, 0.9, 0.82, (*colour, 70), 0.24)
        glass(0.06, 0.24, 0.30, 0.38, (*colour, 255))
    else:
        dark = tuple(int(0.62 * c) for c in colour)
        for x in (-0.28, 0.28):
            for y in (-0.46, 0.46):
                box(x, y, 0.2, 0.2, (40, 40, 44, 255), 0.06)
        box(0.0, 0.0, 1.0, 0.9, (*dark, 255), 0.32)
        box(0.0, 0.0, 0.94, 0.8, (*colour, 255), 0.28)
        glass(0.10, 0.26, 0.26, 0.34, (226, 238, 248, 255))
        glass(-0.34, -0.24, 0.30, 0.25, (*dark, 255))
        for y in (-0.27, 0.27):
            box(0.44, y, 0.06, 0.16, (255, 236, 150, 255), 0.06)
        pygame.draw.circle(sprite, (255, 255, 255, 255), (cx, cy), 0.1 * width)
    return pygame.transform.smoothscale(sprite, (int(size[0] / 4), int(size[1] / 4)))


def _import_pygame() -> Any:
    try:
        import pygame
    except ImportError as error:
        raise DependencyNotInstalled(
            'rendering needs pygame: pip install "slipcar[plot]"'
        ) from error
    return pygame

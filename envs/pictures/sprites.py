"""Colours, and the small things that are drawn: cars, dashed circles, text."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from slipcar.envs.pictures.view import CAR_LENGTH, CAR_WIDTH

PAPER, STRIP_FILL, EDGE = (251, 251, 248), (242, 242, 238), (214, 216, 212)
INK, FAINT, GRID = (45, 52, 60), (140, 146, 152), (0, 0, 0, 18)
OBSTACLE, OBSTACLE_RIM, RING = (222, 196, 184), (166, 104, 80), (196, 140, 118)
GOAL, START, CAR, CRASH = (38, 145, 92), (150, 156, 162), (32, 96, 178), (206, 44, 48)
PLAN, TUBE_ALPHA, ELLIPSE = (0, 128, 138), 34, (112, 186, 190)
_SPEED_STOPS = np.array([(250, 190, 70), (232, 98, 90), (148, 52, 142), (46, 28, 110)], dtype=float)


def speed_colours(fraction: np.ndarray) -> list[tuple[int, int, int]]:
    """Colours of speeds given as fractions of the top speed, (k,), slow is amber, fast indigo."""
    position = np.clip(np.nan_to_num(fraction), 0.0, 1.0) * (len(_SPEED_STOPS) - 1)
    stops = np.arange(len(_SPEED_STOPS))
    channels = [np.interp(position, stops, _SPEED_STOPS[:, c]) for c in range(3)]
    return [(int(r), int(g), int(b)) for r, g, b in zip(*channels, strict=True)]


def write(surface: Any, font: Any, text: str, at: tuple[float, float], colour: tuple) -> None:
    """Text whose left edge's middle is at a pixel."""
    image = font.render(text, True, colour)
    surface.blit(image, image.get_rect(midleft=at))


def dashed_circle(
    pygame: Any, surface: Any, colour: tuple, centre: Any, radius: float, pixel: float
) -> None:
    """A thin dashed circle; `pixel` is the size of a picture's pixel on this finer surface."""
    dashes = max(12, int(math.tau * radius / (12.0 * pixel)))
    for i in range(dashes):
        angles = math.tau / dashes * (i + np.linspace(0.0, 0.55, 6))
        rim = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        half = 0.6 * pixel
        corners = np.vstack([centre + (radius + half) * rim, centre + (radius - half) * rim[::-1]])
        pygame.draw.polygon(surface, colour, corners.tolist())


def blit_turned(pygame: Any, surface: Any, sprite: Any, at: np.ndarray, heading: float) -> None:
    """A sprite of :func:`car_sprite` with its centre at a pixel (2,), turned to a heading [rad]."""
    angle = math.degrees(heading) if math.isfinite(heading) else 0.0
    turned = pygame.transform.rotozoom(sprite, math.fmod(angle, 360.0), 0.5)
    surface.blit(turned, turned.get_rect(center=at.tolist()))


def car_sprite(pygame: Any, length: float, colour: tuple, ghost: bool = False) -> Any:
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

"""Recorded episodes as moving pictures: a GIF, numbered frames, or a window.

Needs pygame and pillow (`pip install 'slipcar[plot]'`), imported when a picture is made.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slipcar.envs.scenario import Scenario
from slipcar.envs.slip_car import RENDER_FPS

_PAUSE = 6  # frames that an episode's last picture stays


def frames(scenario: Scenario, states: np.ndarray) -> Iterator[np.ndarray]:
    """Pictures of recorded episodes, one after the other.

    Args:
        scenario: the world.
        states: (episodes, N, 5).

    Yields:
        (H, W, 3) uint8.
    """
    for picture in _draw(scenario, states, human=False):
        assert picture is not None
        yield picture


def show(scenario: Scenario, states: np.ndarray) -> None:
    """Play recorded episodes in a window, at the speed they happened."""
    for _ in _draw(scenario, states, human=True):
        pass


def save_gif(path: Path, scenario: Scenario, states: np.ndarray) -> Path:
    """Write recorded episodes as a GIF that repeats; returns its path.

    Raises:
        ValueError: if `path` does not end in .gif.
    """
    from PIL import Image

    if path.suffix != ".gif":
        raise ValueError(f"a GIF's name ends in .gif, not {path.name!r}")
    pictures = [Image.fromarray(frame) for frame in frames(scenario, states)]
    # One palette for all frames: with one each, the colours flicker.
    palette = pictures[len(pictures) // 2].quantize(128)
    indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    path.parent.mkdir(parents=True, exist_ok=True)
    indexed[0].save(
        path,
        save_all=True,
        append_images=indexed[1:],
        duration=round(1000 * scenario.dt),
        loop=0,
        optimize=True,
    )
    return path


def save_frames(folder: Path, scenario: Scenario, states: np.ndarray) -> list[Path]:
    """Write every picture as a PNG, `frame_00000.png` and so on; returns their paths."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for i, frame in enumerate(frames(scenario, states)):
        path = folder / f"frame_{i:05d}.png"
        Image.fromarray(frame).save(path)
        written.append(path)
    return written


def _draw(scenario: Scenario, states: np.ndarray, human: bool) -> Iterator[np.ndarray | None]:
    from slipcar.envs.render import Screen

    fps = max(1, round(1.0 / scenario.dt)) if human else RENDER_FPS
    screen = Screen(scenario, human=human, fps=fps)
    try:
        for path in states:
            hit = scenario.signed_distance(path) < 0.0
            for k in [*range(len(path)), *[len(path) - 1] * _PAUSE]:
                yield screen.draw(path[: k + 1], collided=bool(hit[1 : k + 1].any()))
    finally:
        screen.close()

"""Recorded episodes as moving pictures: an MP4, a GIF, numbered frames, or a window.

Between the nodes the car moves straight from state to state: Euler–Maruyama says no more.

Needs pygame, pillow for GIFs and frames (the extra `plot`), and imageio-ffmpeg for
MP4s (`video`); each is imported when a picture is made.
"""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from slipcar.envs.extras import install
from slipcar.evaluation.recording import Recording

#: Pictures per second of a film that moves smoothly; three for each node of the paper's case.
FPS = 24
_PAUSE = 0.75  # [s] that an episode's last picture stays
# Colours said to be what they are, or players guess; the index first, so that browsers play while
# they load.
_ENCODING = [
    *(
        "-vf",
        "scale=out_color_matrix=bt709:out_range=tv,setparams=colorspace=bt709:"
        "color_primaries=bt709:color_trc=bt709:range=tv",
    ),
    *("-crf", "18", "-movflags", "+faststart"),
]
_SLACK = 1e-9  # [1]: nearer than this share of an interval to a node is at the node


def frames(
    recording: Recording, *, fps: int | None = None, tiled: bool = False, human: bool = False
) -> Iterator[np.ndarray]:
    """Pictures of recorded episodes, one after the other.

    Args:
        recording: what to draw.
        fps: pictures per second of the episode's time; None draws one at each node.
        tiled: all episodes side by side rather than one after the other.
        human: show them in a window, at the speed they happened, instead of yielding them.

    Yields:
        (H, W, 3) uint8, all of one size.

    Raises:
        ValueError: for more than 64 tiles.
        DependencyNotInstalled: without pygame.
        gymnasium.error.Error: where there is no display for a window.
    """
    draw = _tiled if tiled else _in_turn
    for picture in draw(recording, times(recording, fps), human, _rate(recording, fps)):
        if picture is not None:
            yield picture


def length(recording: Recording, *, fps: int | None = None, tiled: bool = False) -> int:
    """How many pictures :func:`frames` yields."""
    return len(times(recording, fps)) * (1 if tiled else len(recording.states))


def times(recording: Recording, fps: int | None) -> np.ndarray:
    """When an episode's pictures are of [s], the pause at its end included."""
    scenario = recording.scenario
    if fps is None:
        moving = scenario.times
    else:
        moving = np.append(
            np.arange(0.0, scenario.horizon - 0.5 / fps, 1.0 / fps), scenario.times[-1]
        )
    pause = round(_PAUSE * _rate(recording, fps))
    return np.append(moving, np.full(pause, scenario.times[-1]))


def show(recording: Recording, *, tiled: bool = False) -> None:
    """Play recorded episodes in a window, at the speed they happened."""
    for _ in frames(recording, fps=FPS, tiled=tiled, human=True):
        pass


def save_video(path: Path, pictures: Iterable[np.ndarray], fps: int = FPS) -> Path:
    """Write pictures as an H.264 film that any player and browser plays; returns its path.

    The file is there when it is whole: it is written beside its place and renamed.

    Args:
        path: ends in .mp4; its folder is made if it is missing.
        pictures: (H, W, 3) uint8, all of one size, H and W even.
        fps: pictures per second.

    Raises:
        ValueError: for another suffix, no picture, or an odd size.
        ImportError: without imageio-ffmpeg.
        OSError: if the file cannot be written.
    """
    check_suffix(path, ".mp4", "a film")
    ffmpeg = import_ffmpeg()
    pictures = iter(pictures)
    first = next(pictures, None)
    if first is None:
        raise ValueError("a film needs at least one picture")
    height, width = first.shape[:2]
    if height % 2 or width % 2:
        raise ValueError(f"a film's pictures must have an even size, not {width} x {height}")
    with _beside(path) as temporary:
        writer = ffmpeg.write_frames(
            str(temporary),
            (width, height),
            fps=fps,
            codec="libx264",
            pix_fmt_out="yuv420p",  # what players other than ffmpeg's know
            macro_block_size=2,
            quality=None,
            output_params=_ENCODING,
            ffmpeg_log_level="error",
        )
        writer.send(None)
        try:
            for picture in itertools.chain([first], pictures):
                writer.send(np.ascontiguousarray(picture))
        finally:
            writer.close()
        if not temporary.exists():
            raise OSError(f"ffmpeg wrote no {path}")
    return path


def save_gif(path: Path, pictures: Iterable[np.ndarray], fps: float) -> Path:
    """Write pictures as a GIF that repeats; returns its path. Whole or absent, as `save_video`.

    Raises:
        ValueError: if `path` does not end in .gif, or there is no picture.
        OSError: if the file cannot be written.
    """
    from PIL import Image

    check_suffix(path, ".gif", "a GIF")
    pictures = iter(pictures)
    first = list(itertools.islice(pictures, 64))
    if not first:
        raise ValueError("a GIF needs at least one picture")
    # One palette for all frames: with one each, the colours flicker.
    palette = Image.fromarray(_typical(first)).quantize(192)

    def indexed(picture: np.ndarray) -> Any:
        return Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)

    with _beside(path) as temporary:
        indexed(first[0]).save(
            temporary,
            save_all=True,
            append_images=map(indexed, itertools.chain(first[1:], pictures)),
            duration=round(1000 / fps),
            loop=0,
            optimize=True,
        )
    return path


def save_frames(folder: Path, pictures: Iterable[np.ndarray]) -> list[Path]:
    """Write every picture as a PNG, `frame_00000.png` and so on; returns their paths."""
    from PIL import Image

    written = []
    for i, picture in enumerate(pictures):
        path = folder / f"frame_{i:05d}.png"
        with _beside(path) as temporary:
            Image.fromarray(picture).save(temporary)
        written.append(path)
    return written


def check_suffix(path: Path, suffix: str, what: str) -> None:
    """Raises ValueError unless a file's name ends as it should."""
    if path.suffix != suffix:
        raise ValueError(f"{what}'s name ends in {suffix}, not {path.name!r}")


def import_ffmpeg() -> Any:
    """imageio-ffmpeg, or an ImportError that says how to get it."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ImportError(f"films need imageio-ffmpeg: {install('video')}") from error
    return imageio_ffmpeg


def _rate(recording: Recording, fps: int | None) -> int:
    return max(1, round(1.0 / recording.scenario.dt)) if fps is None else fps


def _in_turn(
    recording: Recording, at: np.ndarray, human: bool, fps: int
) -> Iterator[np.ndarray | None]:
    from slipcar.envs.render import Screen

    screen = Screen(recording.scenario, human=human, fps=fps)
    try:
        for i, t in itertools.product(range(len(recording.states)), at.tolist()):
            node, trail = _until(recording, i, t)
            yield screen.draw(
                trail,
                collided=recording.collided(i, node),
                overlay=recording.overlay(i, node),
                time=t,
            )
    finally:
        screen.close()


def _tiled(
    recording: Recording, at: np.ndarray, human: bool, fps: int
) -> Iterator[np.ndarray | None]:
    from slipcar.envs.pictures.tiles import Tiles

    episodes = range(len(recording.states))
    tiles = Tiles([recording.scenario] * len(episodes), human=human, fps=fps)
    try:
        for t in at.tolist():
            node, _ = _until(recording, 0, t)
            yield tiles.draw(
                [_until(recording, i, t)[1] for i in episodes],
                collided=[recording.collided(i, node) for i in episodes],
                overlays=[recording.overlay(i, node) for i in episodes],
                times=[t] * len(episodes),
            )
    finally:
        tiles.close()


def _until(recording: Recording, episode: int, t: float) -> tuple[int, np.ndarray]:
    """The last node at or before a time, and the trail up to that time, (k, 5)."""
    path, dt = recording.states[episode], recording.scenario.dt
    node = min(int(t / dt + _SLACK), len(path) - 1)
    share = t / dt - node
    if share <= _SLACK or node == len(path) - 1:
        return node, path[: node + 1]
    here = path[node] + share * (path[node + 1] - path[node])
    return node, np.vstack([path[: node + 1], here])


def _typical(pictures: list[np.ndarray]) -> np.ndarray:
    """A picture with the colours of all; that of a collision, which may come later, included."""
    from slipcar.envs.pictures.sprites import CRASH

    chosen = np.unique(np.linspace(0, len(pictures) - 1, 4).round().astype(int))
    some = np.concatenate([pictures[i] for i in chosen])
    some[:16] = CRASH
    return some


@contextlib.contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """A file to write instead of `path`, which becomes it if all goes well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The process id keeps two runs that write the same file from sharing a temporary one.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename != str(temporary):
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)

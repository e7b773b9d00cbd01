"""`slipcar simulate`."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from slipcar.evaluation.commands.inputs import (
    CONTROLLER_HELP,
    OwnScenarioOption,
    console,
    read_controller,
    read_scenario,
)

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from slipcar.evaluation.metrics import EpisodeMetrics
    from slipcar.evaluation.recording import Recording

_DEFAULT = "feedback"
_MOST_FILMED = 50
_LONG = 100  # pictures; more get a progress bar


def simulate(
    driver: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(
            metavar="CONTROLLER",
            help=CONTROLLER_HELP,
            help_behavior_hint=f"(default: {_DEFAULT})",
        ),
    ] = None,
    *,
    controller: Annotated[
        str | None,
        tyro.conf.arg(metavar="CONTROLLER", help="the same, as an option", help_behavior_hint=""),
    ] = None,
    scenario: OwnScenarioOption = None,
    episodes: int = 5,
    seed: int = 0,
    trust: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    figure: Path | None = None,
    video: Path | None = None,
    gif: Path | None = None,
    frames: Path | None = None,
    human: bool = False,
    tiled: bool = False,
    overlay: bool = True,
) -> int:
    """Drive a few episodes and print each; draw them, film them, or watch them.

    Controllers: scp (stochastic SCP, open loop), feedback (the same plan, tracked),
    planned-feedback (planned with its gains), receding (replans at every step),
    deterministic (variance weight 0, open loop), straight (ignores obstacles), ppo.

        slipcar simulate --controller receding --video out.mp4
        slipcar simulate scp --episodes 16 --tiled --video scp.mp4
        slipcar simulate ppo --episodes 3 --gif ppo.gif
        slipcar simulate scp --episodes 100 --figure paths.png
        slipcar simulate plan.npz --human

    Calls slipcar.evaluation.evaluate and sample_paths: episode i of a seed meets the same
    Brownian path here and in `slipcar compare`.

    Args:
        driver: who drives.
        controller: who drives.
        scenario: which world.
        episodes: how many, at least 1; at most 50 to be filmed.
        seed: of the Brownian paths, at least 0.
        trust: load a Stable-Baselines3 model, which runs whatever code is in the file.
        figure: draw all paths to this .png, .pdf or .svg (needs matplotlib).
        video: film the episodes, H.264 in an .mp4 (needs pygame and imageio-ffmpeg:
            slipcar[plot,video]).
        gif: film the episodes, one picture at each node (needs pygame and pillow).
        frames: write every picture of the GIF as a PNG into this folder.
        human: play them in a window (needs pygame and a display).
        tiled: film the episodes side by side rather than one after the other.
        overlay: draw what the controller means to do, where it has a plan: the path, and the
            region the car is in with probability 95 %.
    """
    from slipcar.evaluation import evaluate, sample_paths

    out = console()
    if driver is not None and controller is not None and driver != controller:
        raise ValueError(f"who drives, {driver!r} or --controller {controller!r}?")
    named = driver or controller or _DEFAULT
    filmed = video is not None or gif is not None or frames is not None or human
    if tiled and not filmed:
        raise ValueError("--tiled needs --video, --gif, --frames or --human: it lays out a film")
    _check_files(figure, video, gif, frames)
    if filmed:
        _check_pictures(episodes, video is not None)
    world = None if scenario is None else read_scenario(scenario)
    drives, world = read_controller(named, world, trust)
    result = evaluate(drives, world, episodes, seed)
    out.print(episodes_table(result.metrics))
    out.print(
        f"{result.metrics.collision.sum()} of {episodes} episodes collide; mean cost "
        f"{result.total:.3f}",
        markup=False,
    )
    if figure is not None:
        from slipcar.evaluation.figures import saved as plots

        states, _ = sample_paths(drives, world, episodes, seed)
        drawn = plots.paths_figure(world, states, f"{named}, seed {seed}")
        figure.parent.mkdir(parents=True, exist_ok=True)
        with plots.style():
            drawn.savefig(figure, dpi=150)
        out.print(f"figure in {figure}", markup=False)
    if filmed:
        from slipcar.evaluation.recording import record

        recording = record(drives, world, episodes, seed, overlay=overlay)
        for line in _film(recording, video, gif, frames, human, tiled):
            out.print(line, markup=False)
    return 0


def _check_files(
    figure: Path | None, video: Path | None, gif: Path | None, frames: Path | None
) -> None:
    """Complain of names and folders before the work, not after it."""
    from slipcar.evaluation.film import check_suffix

    if figure is not None and figure.suffix not in (".png", ".pdf", ".svg"):
        raise ValueError(f"a figure's name ends in .png, .pdf or .svg, not {figure.name!r}")
    if gif is not None:
        check_suffix(gif, ".gif", "a GIF")
    if video is not None:
        check_suffix(video, ".mp4", "a film")
    for path in (figure, video, gif, frames):
        if path is None:
            continue
        folder = path if path is frames else path.parent
        if path is not frames and path.is_dir():
            raise ValueError(f"{path} is a folder, not a file to write")
        while not folder.exists() and folder != folder.parent:  # what is missing will be made
            folder = folder.parent
        if not folder.is_dir():
            raise ValueError(f"cannot write {path}: {folder} is no folder")
        if not os.access(folder, os.W_OK):
            raise ValueError(f"cannot write {path}: no permission to write to {folder}")


def _check_pictures(episodes: int, video: bool) -> None:
    from gymnasium.error import DependencyNotInstalled

    from slipcar.envs.pictures.canvas import import_pygame
    from slipcar.evaluation.film import import_ffmpeg

    if episodes > _MOST_FILMED:
        raise ValueError(f"episodes must be at most {_MOST_FILMED} to be filmed, not {episodes}")
    try:
        import_pygame()
    except DependencyNotInstalled as error:  # Gymnasium's own, no ImportError
        raise ImportError(str(error)) from error
    if video:
        import_ffmpeg()


def _film(
    recording: Recording,
    video: Path | None,
    gif: Path | None,
    frames: Path | None,
    human: bool,
    tiled: bool,
) -> Iterator[str]:
    from gymnasium.error import Error

    from slipcar.evaluation import film

    def pictures(fps: int | None) -> Iterable[np.ndarray]:
        count = film.length(recording, fps=fps, tiled=tiled)
        return _with_bar(film.frames(recording, fps=fps, tiled=tiled), count)

    if video is not None:
        yield f"film in {film.save_video(video, pictures(film.FPS))}"
    if gif is not None:
        rate = 1.0 / recording.scenario.dt
        yield f"film in {film.save_gif(gif, pictures(None), rate)}"
    if frames is not None:
        yield f"{len(film.save_frames(frames, pictures(None)))} frames in {frames}"
    if human:
        try:
            film.show(recording, tiled=tiled)
        except Error as error:  # Gymnasium's own: there is no display
            raise ValueError(str(error)) from error


def _with_bar(pictures: Iterable[np.ndarray], count: int) -> Iterable[np.ndarray]:
    """The pictures themselves, behind a progress bar if they are many and someone is watching."""
    from rich.console import Console
    from rich.progress import track

    quiet = count <= _LONG or not sys.stderr.isatty()
    console = Console(stderr=True)
    return track(pictures, "filming", total=count, console=console, transient=True, disable=quiet)


def episodes_table(metrics: EpisodeMetrics, most: int = 20) -> Table:
    """One line an episode, the first `most` of them."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    headers = (
        "episode", "total", "effort", "obstacle", "goal", "collision", "clearance [m]",
        "position error [m]",
    )  # fmt: skip
    for header in headers:
        table.add_column(Text(header), justify="right")
    for i in range(min(most, len(metrics))):
        table.add_row(
            str(i),
            *(
                f"{getattr(metrics, name)[i]:.3f}"
                for name in ("total", "effort", "obstacle", "goal")
            ),
            "yes" if metrics.collision[i] else "no",
            f"{metrics.clearance[i]:.3f}",
            f"{metrics.position_error[i]:.3f}",
        )
    if len(metrics) > most:
        table.caption = f"and {len(metrics) - most} more"
    return table

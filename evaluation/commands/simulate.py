"""`slipcar simulate`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from slipcar.evaluation.commands.checks import (
    FIGURES,
    check_display,
    check_figures,
    check_file,
    check_folder,
)
from slipcar.evaluation.commands.inputs import (
    CONTROLLER_HELP,
    OwnScenarioOption,
    read_controller,
    read_scenario,
)
from slipcar.evaluation.commands.output import Output, OutputOption
from slipcar.evaluation.report.layout import Fitted
from slipcar.evaluation.report.table import Field, table_of_records

if TYPE_CHECKING:
    import numpy as np

    from slipcar.envs.scenario import Scenario
    from slipcar.evaluation.metrics import EpisodeMetrics, Result
    from slipcar.evaluation.recording import Recording

_DEFAULT = "feedback"
_MOST_FILMED = 50
_MOST_LISTED = 20
_COSTS = ("total", "effort", "obstacle", "goal")
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
    output: OutputOption = Output(),  # noqa: B008  frozen
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
            the extras plot and video).
        gif: film the episodes, one picture at each node (needs pygame and pillow).
        frames: write every picture of the GIF as a PNG into this folder.
        human: play them in a window (needs pygame and a display).
        tiled: film the episodes side by side rather than one after the other.
        overlay: draw what the controller means to do, where it has a plan: the path, and the
            region the car is in with probability 95 %.
        output: what is printed.
    """
    from slipcar.evaluation import evaluate, sample_paths

    if driver is not None and controller is not None and driver != controller:
        raise ValueError(f"who drives, {driver!r} or --controller {controller!r}?")
    named = driver or controller or _DEFAULT
    filmed = video is not None or gif is not None or frames is not None or human
    if tiled and not filmed:
        raise ValueError("--tiled needs --video, --gif, --frames or --human: it lays out a film")
    _check_files(figure, video, gif, frames)
    if filmed:
        _check_pictures(episodes, video is not None)
    if human:
        check_display()
    world = None if scenario is None else read_scenario(scenario)
    drives, world = read_controller(named, world, trust)
    result = evaluate(drives, world, episodes, seed)
    written: list[str] = []
    try:
        if figure is not None:
            states, _ = sample_paths(drives, world, episodes, seed)
            _draw(world, states, f"{named}, seed {seed}", figure)
            written.append(f"figure in {figure}")
        if filmed:
            from slipcar.evaluation.recording import record

            recording = record(drives, world, episodes, seed, overlay=overlay)
            quiet = output.quiet or not sys.stderr.isatty()
            written += _film(recording, video, gif, frames, tiled, quiet)
    finally:
        _print(output, result, written)
    if human:
        from slipcar.evaluation import film

        film.show(recording, tiled=tiled)
    return 0


def _print(output: Output, result: Result, written: list[str]) -> None:
    out, metrics = output.console(), result.metrics
    out.print(episodes_table(metrics))
    if len(metrics) > _MOST_LISTED:
        out.print(f"and {len(metrics) - _MOST_LISTED} more")
    out.print()
    out.print(
        f"{metrics.collision.sum()} of {len(metrics)} episodes collide; mean cost "
        f"{result.total:.3f}",
        markup=False,
    )
    for line in written:
        out.print(line, markup=False, soft_wrap=True)
    episodes = metrics.to_dict() | {"total": metrics.total}
    output.data({"summary": result.summary(), "episodes": episodes})


def _draw(world: Scenario, states: np.ndarray, title: str, path: Path) -> None:
    from slipcar.evaluation.figures import saved as plots

    drawn = plots.paths_figure(world, states, title)
    path.parent.mkdir(parents=True, exist_ok=True)
    with plots.style():
        drawn.savefig(path, dpi=150)


def _check_files(
    figure: Path | None, video: Path | None, gif: Path | None, frames: Path | None
) -> None:
    """Complain of names, folders and packages before the work, not after it."""
    from slipcar.evaluation.film import check_suffix

    check_file(figure, FIGURES, "a figure")
    if gif is not None:
        check_suffix(gif, ".gif", "a GIF")
    if video is not None:
        check_suffix(video, ".mp4", "a film")
    for path in (video, gif):
        check_file(path)
    if frames is not None:
        check_folder(frames)
    check_figures(figure is not None)


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
    tiled: bool,
    quiet: bool,
) -> Iterator[str]:
    from slipcar.evaluation import film

    def pictures(fps: int | None) -> Iterable[np.ndarray]:
        count = film.length(recording, fps=fps, tiled=tiled)
        shown = film.frames(recording, fps=fps, tiled=tiled)
        return shown if quiet or count <= _LONG else _with_bar(shown, count)

    if video is not None:
        yield f"film in {film.save_video(video, pictures(film.FPS))}"
    if gif is not None:
        rate = 1.0 / recording.scenario.dt
        yield f"film in {film.save_gif(gif, pictures(None), rate)}"
    if frames is not None:
        yield f"{len(film.save_frames(frames, pictures(None)))} frames in {frames}"


def _with_bar(pictures: Iterable[np.ndarray], count: int) -> Iterable[np.ndarray]:
    """The pictures themselves, behind a progress bar."""
    from rich.console import Console
    from rich.progress import track

    return track(pictures, "filming", total=count, console=Console(stderr=True), transient=True)


def episodes_table(metrics: EpisodeMetrics, most: int = _MOST_LISTED) -> Fitted:
    """One line an episode, the first `most` of them."""
    fields: tuple[Field, ...] = (
        *((name, lambda i, name=name: getattr(metrics, name)[i], ".3f") for name in _COSTS),
        ("collision", lambda i: "yes" if metrics.collision[i] else "no", ""),
        ("clearance [m]", lambda i: metrics.clearance[i], ".3f"),
        ("position error [m]", lambda i: metrics.position_error[i], ".3f"),
    )
    episodes = range(min(most, len(metrics)))
    return Fitted(table_of_records("episode", fields, episodes, first=0))

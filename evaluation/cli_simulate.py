"""`slipcar simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from slipcar.evaluation.cli_inputs import (
    CONTROLLERS,
    OwnScenarioOption,
    console,
    read_controller,
    read_scenario,
)

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from slipcar.envs.scenario import Scenario
    from slipcar.evaluation.metrics import EpisodeMetrics

_CONTROLLER_HELP = (
    f"who drives: {', '.join(CONTROLLERS)}; or a plan's .npz file (with its feedback gains if it "
    "has some), or a policy's .safetensors file or folder"
)
_MOST_FILMED = 50


def simulate(
    controller: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(metavar="CONTROLLER", help=_CONTROLLER_HELP)
    ] = "feedback",
    *,
    scenario: OwnScenarioOption = None,
    episodes: int = 5,
    seed: int = 0,
    figure: Path | None = None,
    gif: Path | None = None,
    frames: Path | None = None,
    human: bool = False,
) -> int:
    """Drive a few episodes and print each; draw them, film them, or watch them.

    Controllers: scp (stochastic SCP, open loop), feedback (the same plan, tracked),
    deterministic (variance weight 0, open loop), straight (ignores obstacles), ppo.

        slipcar simulate ppo --episodes 3 --gif ppo.gif
        slipcar simulate scp --episodes 100 --figure paths.png
        slipcar simulate plan.npz --human

    Calls slipcar.evaluation.evaluate and sample_paths: episode i of a seed meets the same
    Brownian path here and in `slipcar compare`.

    Args:
        controller: who drives.
        scenario: which world.
        episodes: how many, at least 1.
        seed: of the Brownian paths, at least 0.
        figure: draw all paths to this .png, .pdf or .svg (needs matplotlib).
        gif: film the episodes (needs pygame and pillow).
        frames: write every picture as a PNG into this folder (needs pygame and pillow).
        human: play them in a window (needs pygame and a display).
    """
    from slipcar.evaluation import evaluate, sample_paths

    out = console()
    if figure is not None and figure.suffix not in (".png", ".pdf", ".svg"):
        raise ValueError(f"a figure's name ends in .png, .pdf or .svg, not {figure.name!r}")
    if gif is not None and gif.suffix != ".gif":
        raise ValueError(f"a GIF's name ends in .gif, not {gif.name!r}")
    filmed = gif is not None or frames is not None or human
    if filmed and episodes > _MOST_FILMED:
        raise ValueError(f"episodes must be at most {_MOST_FILMED} to be filmed, not {episodes}")
    driver, world = read_controller(
        controller, None if scenario is None else read_scenario(scenario)
    )
    result = evaluate(driver, world, episodes, seed)
    out.print(episodes_table(result.metrics))
    out.print(
        f"{result.metrics.collision.sum()} of {episodes} episodes collide; mean cost "
        f"{result.total:.3f}",
        markup=False,
    )
    if figure is not None or filmed:
        states, _ = sample_paths(driver, world, episodes, seed)
    if figure is not None:
        from slipcar.evaluation import plots

        drawn = plots.paths_figure(world, states, f"{controller}, seed {seed}")
        figure.parent.mkdir(parents=True, exist_ok=True)
        with plots.style():
            drawn.savefig(figure, dpi=150)
        out.print(f"figure in {figure}", markup=False)
    if filmed:
        for line in _film(world, states, gif, frames, human):
            out.print(line, markup=False)
    return 0


def _film(
    world: Scenario, states: np.ndarray, gif: Path | None, frames: Path | None, human: bool
) -> list[str]:
    from gymnasium.error import Error

    from slipcar.evaluation import film

    said = []
    try:
        if gif is not None:
            said.append(f"film in {film.save_gif(gif, world, states)}")
        if frames is not None:
            said.append(f"{len(film.save_frames(frames, world, states))} frames in {frames}")
        if human:
            film.show(world, states)
    except Error as error:  # Gymnasium's own: pygame is missing, or there is no display
        raise ValueError(str(error)) from error
    return said


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

"""`slipcar dataset`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from slipcar.envs.observation import KINDS, Layout
from slipcar.evaluation.commands.checks import check_folder
from slipcar.evaluation.commands.inputs import (
    CONTROLLER_HELP,
    CONTROLLERS,
    OwnScenarioOption,
    read_controller,
    read_scenario,
)
from slipcar.evaluation.commands.output import Output, OutputOption
from slipcar.evaluation.progress import Bars


def dataset(
    controller: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(metavar="CONTROLLER", help=CONTROLLER_HELP)
    ],
    *,
    dataset_id: Annotated[str, tyro.conf.arg(name="id", metavar="NAMESPACE/NAME-v0")],
    scenario: OwnScenarioOption = None,
    episodes: int = 1000,
    seed: int = 0,
    observation: Annotated[str, tyro.conf.arg(metavar="|".join(KINDS))] = "features",
    obstacle_slots: int = 0,
    exploration_noise: float = 0.0,
    trust: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    folder: Path | None = None,
    overwrite: bool = False,
    author: str | None = None,
    code_permalink: str | None = None,
    description: str | None = None,
    output: OutputOption = Output(),  # noqa: B008  frozen
) -> int:
    """Write episodes of any controller as a Minari dataset, to learn from offline.

    Episode i of a seed is driven along the same Brownian path as by `slipcar compare`, and
    stored as the environment would have returned it: observations, actions, rewards, infos.
    The dataset appears when it is complete. Needs Minari (pip install 'slipcar[data]').

        slipcar dataset feedback --id slipcar/paper/feedback-v0
        slipcar dataset ppo --exploration-noise 0.1 --id slipcar/paper/ppo-noisy-v0
        slipcar dataset receding --scenario random:7 --observation egocentric --id mine/seven-v0

    Calls slipcar.evaluation.dataset.write_dataset.

    Args:
        controller: who drives.
        dataset_id: what minari.load_dataset is to find it by.
        scenario: which world.
        episodes: how many, at least 1.
        seed: of the Brownian paths and the exploration, at least 0.
        observation: which kind is stored, whatever the controller looks at.
        obstacle_slots: how many obstacles it shows, the nearest first.
        exploration_noise: standard deviation of normal noise on each action, which lies in
            [-1, 1]; what is stored is the sum, clipped.
        trust: load a Stable-Baselines3 model, which runs whatever code is in the file.
        folder: where Minari keeps datasets; by default MINARI_DATASETS_PATH if that is set,
            else ~/.minari/datasets.
        overwrite: replace a dataset of this id.
        author: who made it.
        code_permalink: where the code that made it can be read.
        description: what others should know of it.
        output: what is printed.
    """
    from slipcar.evaluation.dataset import check_request, write_dataset
    from slipcar.evaluation.episodes import checked_recording
    from slipcar.evaluation.statistics import standard_error

    out = output.console()
    world = None if scenario is None else read_scenario(scenario)
    Layout(observation, obstacle_slots)  # all that can be checked before any planning
    checked_recording(episodes, seed, exploration_noise)
    check_folder(check_request(dataset_id, folder, overwrite))
    driver, world = read_controller(controller, world, trust)
    with Bars({"recording": episodes}, not output.quiet) as bars:
        written = write_dataset(
            driver,
            world,
            dataset_id,
            episodes,
            seed,
            observation=observation,
            obstacle_slots=obstacle_slots,
            exploration_noise=exploration_noise,
            folder=folder,
            overwrite=overwrite,
            algorithm_name=CONTROLLERS.get(controller, Path(controller).name),
            author=author,
            code_permalink=code_permalink,
            description=description,
            progress=lambda more: bars.advance("recording", more),
        )
    returns = written.returns
    out.print(
        f"{written.episodes:,} episodes, {written.steps:,} steps: mean return "
        f"{returns.mean():.3f} ± {standard_error(returns):.3f}, worst {returns.min():.3f}, "
        f"collisions {written.collision_rate:.2%}\n"
        f"dataset {written.dataset_id} in {written.path}",
        markup=False,
        soft_wrap=True,
    )
    if folder is not None:
        out.print(
            f"minari.load_dataset finds it with MINARI_DATASETS_PATH={folder.resolve()}",
            markup=False,
            soft_wrap=True,
        )
    if written.failures:
        out.print(f"solves behind the controller that failed: {written.failures}", markup=False)
    output.data(
        {
            "id": written.dataset_id,
            "path": str(written.path),
            "episodes": written.episodes,
            "steps": written.steps,
            "mean_return": returns.mean(),
            "mean_return_se": standard_error(returns),
            "worst_return": returns.min(),
            "collision_rate": written.collision_rate,
            "failures": written.failures,
        }
    )
    status = getattr(driver, "status", None)
    return 0 if status is None or status.ok else 1

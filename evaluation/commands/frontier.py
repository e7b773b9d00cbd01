"""`slipcar frontier`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from slipcar.evaluation.commands.checks import check_figures, check_folder
from slipcar.evaluation.commands.inputs import ScenarioOption, read_scenario
from slipcar.evaluation.commands.output import Output, OutputOption, finish
from slipcar.evaluation.frontier import EPISODES, PRICES, RECEDING_EPISODES, RECEDING_PRICES


def frontier(
    *,
    scenario: ScenarioOption = "paper",
    episodes: int = EPISODES,
    seed: int = 0,
    folder: Annotated[Path, tyro.conf.arg(aliases=["--out"])] = Path("results/frontier"),
    prices: tuple[float, ...] = PRICES,
    receding_prices: tuple[float, ...] = RECEDING_PRICES,
    receding_episodes: int = RECEDING_EPISODES,
    policy: Path | None = None,
    substeps: int = 1,
    workers: int = 1,
    figures: bool = True,
    resume: bool = True,
    output: OutputOption = Output(),  # noqa: B008  frozen
) -> int:
    """Show what safety costs: effort and total cost against collision rate, in one picture.

    A plan at a price of risk nu minimises its expected cost plus nu times the probability of
    hitting something. Rising prices make a curve: for plans in open loop, for plans with feedback
    and for a receding horizon that replans at every step. The paper's plans, one of them tracked
    by an LQR, and PPO are points beside the curves; all meet the same Brownian paths. Prints a
    table and writes table.md, .csv, .tex, results.json, frontier.png and .pdf into the folder.
    Finished points are kept there: run it again after an interruption and it continues.

        slipcar frontier
        slipcar frontier --scenario slalom --episodes 20000 --workers 2
        slipcar frontier --prices 0 10 100 1000 10000 --receding-prices 10 --out results/mine

    A rate of which nothing was observed is drawn as an upper limit. To plan for one risk, not a
    price: slipcar.planner.plan(scenario, risk=0.01, feedback=True). Calls
    slipcar.evaluation.frontier.frontier.

    Args:
        scenario: which world.
        episodes: per point, at least 1. To see a rate p takes several times 1/p of them.
        seed: of the Brownian paths, at least 0. The same seed gives the same table.
        folder: where tables, figure and finished points go.
        prices: of risk, for open loop and feedback [cost per unit of probability]; 0 leaves the
            risk out. Costs set the scale: the paper's plan costs 4.4.
        receding_prices: the same for the receding horizon.
        receding_episodes: per point of the receding horizon, which takes most of the time.
        policy: a trained policy (.safetensors file or folder) instead of the shipped one.
        substeps: Euler-Maruyama steps in each control interval. With more than one, prices are of
            the risk on the path.
        workers: processes that share each point's episodes; the numbers do not depend on it.
        figures: draw the figure as well (needs matplotlib).
        resume: reuse finished points found in the folder.
        output: what is printed.
    """
    from slipcar.baselines import load_policy
    from slipcar.evaluation.frontier import frontier as trace_frontier
    from slipcar.evaluation.report import frontier as report_frontier

    check_folder(folder)
    check_figures(figures, "--no-figures")
    try:
        done = trace_frontier(
            read_scenario(scenario),
            episodes,
            seed,
            prices=prices,
            receding_prices=receding_prices,
            receding_episodes=receding_episodes,
            policy=None if policy is None else load_policy(policy),
            substeps=substeps,
            n_jobs=workers,
            folder=folder,
            resume=resume,
            progress=not output.quiet,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"finished points are kept in {folder}; run the command again to continue"
        ) from None
    shown = report_frontier.document(done)
    finish(output, lambda: done.save(folder, figures=figures), shown.terminal, shown.notes)
    if output.json:
        print(shown.to_json(), end="")
    return 1 if done.comparison.errors else 0

"""`slipcar compare`."""

from __future__ import annotations

from pathlib import Path

from slipcar.evaluation.cli_inputs import ScenarioOption, console, read_scenario


def compare(
    *,
    scenario: ScenarioOption = "paper",
    episodes: int = 10_000,
    seed: int = 0,
    folder: Path = Path("results/compare"),
    variance_weight: float = 1.0,
    policy: Path | None = None,
    substeps: int = 1,
    workers: int = 1,
    figures: bool = True,
    resume: bool = True,
) -> int:
    """Compare SCP, feedback, receding horizons and PPO over the same Brownian paths.

    Ten rows: a driver that takes the straight line and ignores obstacles, deterministic SCP
    and stochastic SCP (open loop), stochastic SCP with feedback and PPO (closed loop); then,
    beyond the paper, a plan whose risk is at most 1 % (open loop), plans whose feedback is
    planned along, one of them with a risk of at most 0.1 %, and receding horizons, without and
    with margins against risk (closed loop). Prints a table and writes table.md, .csv, .tex,
    results.json and the figures into the folder. Finished rows are kept there: run it again
    after an interruption and it continues.

        slipcar compare
        slipcar compare --scenario slalom --episodes 100000 --workers 2
        slipcar compare --policy runs/mine/policy.safetensors --folder results/mine

    Calls slipcar.evaluation.compare with the rows of slipcar.evaluation.rows.default_rows.

    Args:
        scenario: which world.
        episodes: per row, at least 1. The error of a rate falls as 1/sqrt(episodes).
        seed: of the Brownian paths, at least 0. The same seed gives the same table.
        folder: where tables, figures and finished rows go.
        variance_weight: weight of the integral of tr Sigma in stochastic SCP [1/(m2 s)].
        policy: a trained policy (.safetensors file or folder) instead of the shipped one.
        substeps: Euler-Maruyama steps in each control interval.
        workers: processes that share each row's episodes; the numbers do not depend on it.
        figures: draw the figures as well (needs matplotlib).
        resume: reuse finished rows found in the folder.
    """
    from slipcar.baselines import load_policy
    from slipcar.evaluation import compare as compare_controllers
    from slipcar.evaluation import report
    from slipcar.evaluation.rollout import check_counts
    from slipcar.evaluation.rows import REFERENCE, default_rows

    out = console()
    world = read_scenario(scenario)
    check_counts(episodes, seed, substeps, None, workers)  # before any planning
    rows, notes = default_rows(
        world,
        variance_weight=variance_weight,
        policy=None if policy is None else load_policy(policy),
    )
    try:
        done = compare_controllers(
            rows,
            world,
            episodes,
            seed,
            reference=REFERENCE,
            substeps=substeps,
            n_jobs=workers,
            folder=folder,
            resume=resume,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"finished rows are kept in {folder}; run the command again to continue"
        ) from None
    out.print(report.terminal(done))
    for note in notes:
        out.print(note, markup=False)
    with out.status("writing tables and drawing figures ..."):
        written = done.save(folder, figures=figures)
    out.print(f"{len(written)} files in {folder}:", markup=False)
    for path in written:
        out.print(f"  {path}", markup=False, soft_wrap=True)
    return 1 if done.errors else 0

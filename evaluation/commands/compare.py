"""`slipcar compare`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from slipcar.evaluation.commands.checks import check_figures, check_folder
from slipcar.evaluation.commands.inputs import PaperScenarioOption, read_maker, read_scenario
from slipcar.evaluation.commands.output import Output, OutputOption, finish, program
from slipcar.evaluation.executors import LostWorkersError

if TYPE_CHECKING:
    from slipcar.evaluation.report.document import Document

_MORE = (
    "All tables are in {folder}/table.md; --all-tables prints them here, `{program} report "
    "{folder}` makes a page of them."
)
_Controllers = tyro.conf.UseAppendAction[
    Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME=]SOURCE")]
]


def compare(
    *,
    suite: Literal["paper", "random", "slip", "horizon"] = "paper",
    scenario: PaperScenarioOption = None,
    episodes: int | None = None,
    resolution: Annotated[
        str | None, tyro.conf.arg(metavar="PERCENT", help_behavior_hint="(optional)")
    ] = None,
    seed: int = 0,
    folder: Path | None = None,
    controller: _Controllers = (),
    rows: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = (),
    reference: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    trust: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    variance_weight: float = 1.0,
    policy: Path | None = None,
    substeps: int = 1,
    workers: int = 1,
    cluster: str | None = None,
    time_limit: float = 300.0,
    figures: bool = True,
    resume: bool = True,
    all_tables: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    output: OutputOption = Output(),  # noqa: B008  frozen
) -> int:
    """Compare planners and policies over the same Brownian paths: one table and its figures.

    The suites:

    paper: one scenario. A driver that ignores obstacles, deterministic and stochastic SCP (open
    loop), stochastic SCP with feedback, learned policies (all their trainings), a plan with a
    risk of at most 1 %, plans whose feedback is planned along, and receding horizons.

    random: 100 held-out worlds; planners plan each, policies were trained on others.

    slip: the paper's scenario from dry to ten times as slippery. Where do the methods cross?

    horizon: plans with few and many nodes, driven in a finer simulation.

    Prints the main table and what it says, after table.md (all tables), .csv, .tex, document.json
    and the figures are in the folder. Finished work is kept there: after an interruption the same
    command continues, and a changed option costs only what it touches. `slipcar report` makes a
    page of all folders.

        slipcar compare
        slipcar compare --suite random --workers 2
        slipcar compare --controller mine=my_module:controller
        slipcar compare --rows "*SCP*" PPO --reference PPO
        slipcar compare --scenario slalom --resolution 0.1%
        slipcar compare --suite slip --cluster dask://scheduler:8786

    Calls slipcar.evaluation.compare or slipcar.evaluation.suites.suite.run_suite.

    Args:
        suite: which worlds.
        scenario: which world, in the suite paper.
        episodes: of each row in each world, at least 1; by default 10000 in paper, 512 in each
            world of random, 4096 elsewhere.
        resolution: half width that the 95 % intervals of the collision rates are to have, such as
            0.1%: each row of the suite paper then drives as many episodes as its rate needs. With
            --episodes, rows whose interval is wider are named.
        seed: of the Brownian paths, at least 0. The same seed gives the same table.
        folder: where tables, figures and finished work go; results/compare for the suite paper,
            results/SUITE for the others.
        controller: a row of your own, may be given several times: module:object, file.py:object, a
            Stable-Baselines3 model.zip (with --trust), plan.npz, policy.safetensors, or the name
            of an installed one; docs/controllers.md shows each in ten lines.
        rows: only these of the usual rows: whole names or patterns with * and ?, in quotes, case
            ignored. Nothing else is planned.
        reference: row that paired differences are taken against; stochastic SCP by default, or
            the first row if it is not among them.
        trust: load Stable-Baselines3 models, which runs whatever code is in the file.
        variance_weight: weight of the integral of tr Sigma in stochastic SCP [1/(m2 s)].
        policy: a trained policy (.safetensors file or folder) instead of the shipped ones.
        substeps: Euler-Maruyama steps in each control interval. With more than one the table
            nears the SDE, and has rows whose risk is promised on the path, beside those that
            promise it at nodes.
        workers: processes on this machine that share the work; the numbers do not depend on it.
        cluster: who does the work instead: dask (a Dask cluster of so many workers on this
            machine), dask://HOST:PORT or dask+tls://HOST:PORT (a running scheduler).
        time_limit: seconds that 1024 episodes of a row may take before it counts as failed.
        figures: draw the figures as well (needs matplotlib).
        resume: reuse finished work found in the folder.
        all_tables: print all tables: tails, paired differences, training noise, times, ...
        output: what is printed.
    """
    from slipcar.evaluation.rollout import checked_counts

    fine = None if resolution is None else percentage("--resolution", resolution)
    checked_counts(1 if episodes is None else episodes, seed, substeps, workers)
    if not time_limit > 0.0:
        raise ValueError(f"--time-limit must be > 0 seconds, not {time_limit:g}")
    place = folder or Path("results") / ("compare" if suite == "paper" else suite)
    check_folder(place)
    check_figures(figures, "--no-figures")
    common: dict[str, Any] = {
        "n_jobs": workers,
        "cluster": cluster,
        "folder": place,
        "resume": resume,
        "time_limit": time_limit,
        "progress": not output.quiet,
    }
    try:
        if suite == "paper":
            return _paper(
                output,
                all_tables,
                scenario="paper" if scenario is None else scenario,
                controllers=controller,
                trust=trust,
                rows=rows,
                reference=reference,
                variance_weight=variance_weight,
                policy=policy,
                figures=figures,
                options={
                    "episodes": episodes,
                    "seed": seed,
                    "resolution": fine,
                    "substeps": substeps,
                    **common,
                },
            )
        fixed = {
            "--scenario": scenario is not None,
            "--resolution": resolution is not None,
            "--variance-weight": variance_weight != 1.0,
            "--policy": policy is not None,
            "--substeps": substeps != 1,
        }
        if given := [name for name, is_given in fixed.items() if is_given]:
            raise ValueError(
                f"{', '.join(given)}: only the suite paper has it; {suite} says so itself"
            )
        return _suite(
            output, all_tables, suite, episodes, seed, controller, trust, rows, reference, figures,
            common,
        )  # fmt: skip
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"finished work is kept in {place}; run the command again to continue"
        ) from None
    except LostWorkersError as error:
        raise OSError(
            f"{error}; finished work is kept in {place}, the same command continues there"
        ) from None


def _paper(
    output: Output,
    all_tables: bool,
    *,
    scenario: str,
    controllers: tuple[str, ...],
    trust: bool,
    rows: tuple[str, ...],
    reference: str | None,
    variance_weight: float,
    policy: Path | None,
    figures: bool,
    options: dict[str, Any],
) -> int:
    from slipcar.baselines import load_policy
    from slipcar.evaluation import compare as compare_controllers
    from slipcar.evaluation import rows as usual
    from slipcar.evaluation.report import comparison as report

    world = read_scenario(scenario)
    own = dict(read_maker(text, trust) for text in controllers)
    learned = None if policy is None else load_policy(policy)
    how: dict[str, Any] = {"variance_weight": variance_weight, "policy": learned}
    how["substeps"] = options["substeps"]
    names = usual.chosen(list(usual.row_makers(world, **how)[0]), rows)
    against = _reference(reference, usual.REFERENCE, [*names, *own])
    check_names(names, list(own), len(controllers))
    with output.busy("planning ..."):
        made, notes = usual.default_rows(world, **how, only=rows)
    done = compare_controllers({**made, **own}, world, reference=against, notes=notes, **options)
    folder = options["folder"]
    finish(
        output,
        lambda: done.save(folder, figures=figures),
        lambda: report.terminal(done, all_tables),
        report.messages(done),
        "" if all_tables else _MORE.format(folder=folder, program=program()),
    )
    if output.json:
        print(report.json_text(done), end="")
    return 1 if done.errors else 0


def _suite(
    output: Output,
    all_tables: bool,
    suite: str,
    episodes: int | None,
    seed: int,
    controllers: tuple[str, ...],
    trust: bool,
    rows: tuple[str, ...],
    reference: str | None,
    figures: bool,
    common: dict[str, Any],
) -> int:
    import dataclasses
    import importlib

    from slipcar.evaluation.rows import chosen
    from slipcar.evaluation.suites.suite import run_suite, save_suite

    module = importlib.import_module(f"slipcar.evaluation.suites.{suite}")
    whole = module.suite() if episodes is None else module.suite(episodes)
    own = dict(read_maker(text, trust) for text in controllers)
    usual = {name: whole.rows[name] for name in chosen(list(whole.rows), rows)}
    check_names(list(usual), list(own), len(controllers))
    against = _reference(reference, whole.reference, [*usual, *own])
    made = dataclasses.replace(whole, rows={**usual, **own}, reference=against)
    result = run_suite(made, seed, **common)
    document: Document = module.document(result)
    folder = common["folder"]
    finish(
        output,
        lambda: save_suite(result, document, folder, figures),
        lambda: document.terminal(None if all_tables else 1),
        document.notes,
        "" if all_tables else _MORE.format(folder=folder, program=program()),
    )
    if output.json:
        print(document.to_json(), end="")
    return 1 if result.errors else 0


def _reference(wanted: str | None, usual: str, names: list[str]) -> str:
    """The row to compare with: the one that is wanted, else the usual one, else the first."""
    if wanted is not None and wanted not in names:
        raise ValueError(f"--reference: no row is called {wanted!r}; the rows are {names}")
    return wanted or (usual if usual in names else names[0])


def check_names(rows: list[str], own: list[str], given: int) -> None:
    """Raises ValueError where two rows have one name."""
    if len(own) < given:
        raise ValueError("--controller: two have the same name; call one of them NAME=...")
    if twice := sorted(set(rows) & set(own)):
        raise ValueError(f"--controller: there is a row {twice[0]!r} already; use another NAME=")


def percentage(option: str, text: str) -> float:
    """A share: "0.1%" or "0.001".

    Raises:
        ValueError: for anything else, or a number outside (0 %, 50 %).
    """
    number, percent, rest = text.strip().partition("%")
    try:
        value = float(number) / (100.0 if percent else 1.0)
    except ValueError:
        value = float("nan")
    if rest.strip() or not 0.0 < value < 0.5:
        raise ValueError(
            f"{option} must be a share between 0 % and 50 %, such as 0.1% or 0.001, not {text!r}"
        )
    return value

"""Suites: the same rows in many worlds, one table and one figure each.

    paper     the paper's scenario (:mod:`slipcar.evaluation.compare`)
    random    100 held-out worlds of a family, every planner plans each of them
    slip      the paper's scenario with α² from 0 to 1: where do the methods cross?
    horizon   plans with few and many nodes, driven in a finer stochastic differential equation

A suite is a list of variants (a world, how finely it is simulated) and of rows (planners that are
made for each world, policies that are not). All variants meet the same seed.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

from slipcar.evaluation.cells import Store
from slipcar.evaluation.executors import open_executor
from slipcar.evaluation.metrics import Result
from slipcar.evaluation.progress import Bars
from slipcar.evaluation.provenance import provenance
from slipcar.evaluation.report.comparison import save_document
from slipcar.evaluation.report.document import Document
from slipcar.evaluation.rollout import checked_counts
from slipcar.evaluation.runs import trainings
from slipcar.evaluation.suites.records import Suite, SuiteResult, Variant
from slipcar.evaluation.sweep import TIME_LIMIT, Job, sweep

__all__ = ["Suite", "SuiteResult", "Variant", "run_suite", "save_suite"]


def run_suite(
    suite: Suite,
    seed: int = 0,
    *,
    n_jobs: int = 1,
    cluster: str | None = None,
    folder: str | Path | None = None,
    resume: bool = True,
    time_limit: float | None = TIME_LIMIT,
    progress: bool = True,
) -> SuiteResult:
    """Drive every row in every variant.

    Args:
        suite: see :mod:`slipcar.evaluation.suites.suite`.
        seed: of the Brownian paths, >= 0; the same in all variants.
        n_jobs: worker processes on this machine; they plan, too. The numbers do not depend on it.
        cluster: None, or a Dask cluster: see :func:`slipcar.evaluation.executors.open_executor`.
        folder: where finished cells are kept, so that an interrupted suite continues; or None.
        resume: whether to reuse finished cells of `folder`.
        time_limit: seconds that a row may take for 1024 episodes; None is no limit.
        progress: whether to show a bar for each row.

    Raises:
        ValueError: for a bad argument.
        OSError: if the cluster does not answer.
        LostWorkersError: if the cluster is gone; finished work is kept.
    """
    episodes, seed, _, n_jobs = checked_counts(suite.episodes, seed, 1, n_jobs)
    suite = dataclasses.replace(suite, episodes=episodes)
    began = time.perf_counter()
    store = Store(folder, resume)
    jobs = [
        Job(
            row=row,
            variant=variant.label,
            training=label,
            controller=one,
            scenario=variant.scenario,
            episodes=suite.episodes,
            seed=seed,
            substeps=variant.substeps,
            time_limit=time_limit,
        )
        for row, controller in suite.rows.items()
        for variant in suite.variants
        for label, one in trainings(controller).items()
    ]
    totals: dict[str, int] = {}
    for job in jobs:
        totals[job.row] = totals.get(job.row, 0) + job.episodes
    with open_executor(n_jobs, cluster) as executor, Bars(totals, progress) as bars:
        swept = sweep(jobs, store, executor, bars)
    found = {
        (row, variant.label): swept.row(row, controller, variant.label)
        for row, controller in suite.rows.items()
        for variant in suite.variants
    }
    return SuiteResult(
        suite=suite,
        seed=seed,
        results={name: row for name, row in found.items() if isinstance(row, Result)},
        errors={name: row for name, row in found.items() if isinstance(row, str)},
        computed=swept.computed,
        warnings=(store.trouble,) if store.trouble else (),
        wall_time=time.perf_counter() - began,
        provenance=provenance(),
    )


def save_suite(
    result: SuiteResult, document: Document, folder: str | Path, figures: bool = True
) -> list[Path]:
    """Write a suite's tables, raw numbers and figure; returns the files written.

    Args:
        result: what came of the suite.
        document: made of it.
        folder: made if it does not exist.
        figures: also draw the figure (needs matplotlib).
    """

    def draw() -> list[Path]:
        from slipcar.evaluation.figures import suites as plot_suites

        figure = plot_suites.FIGURES[result.suite.name](result)
        return plot_suites.save_figure(figure, Path(folder), result.suite.name)

    captions = {figure.stem: figure.caption for figure in document.figures}
    bare = dataclasses.replace(document, figures=())
    return save_document(bare, Path(folder), draw if figures and result.results else None, captions)

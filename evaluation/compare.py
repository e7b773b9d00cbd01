"""`compare` many controllers over the same Brownian paths (docs/comparison.md)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from slipcar.envs.extras import install
from slipcar.envs.scenario import Scenario
from slipcar.envs.validate import checked_float
from slipcar.evaluation.cells import Store
from slipcar.evaluation.comparison_record import ComparisonRecord
from slipcar.evaluation.controller import Controller, check_controller
from slipcar.evaluation.executors import open_executor
from slipcar.evaluation.limits import time_limit
from slipcar.evaluation.metrics import Result
from slipcar.evaluation.noise import BLOCK
from slipcar.evaluation.progress import Bars
from slipcar.evaluation.provenance import provenance
from slipcar.evaluation.report import comparison as report
from slipcar.evaluation.rollout import checked_counts, evaluate
from slipcar.evaluation.runs import Runs, trainings
from slipcar.evaluation.statistics import episodes_for, half_width, rate_interval
from slipcar.evaluation.sweep import TIME_LIMIT, Job, Row, Swept, message, sweep

__all__ = ["Comparison", "compare", "evaluate"]

#: Episodes from which a resolution is turned into a number of episodes, and the most it may ask.
PILOT, MOST = 8 * BLOCK, 4096 * BLOCK


def compare(
    controllers: Mapping[str, Row],
    scenario: Scenario | str,
    episodes: int | None = None,
    seed: int = 0,
    *,
    reference: str | None = None,
    resolution: float | None = None,
    substeps: int = 1,
    n_jobs: int = 1,
    cluster: str | None = None,
    folder: str | Path | None = None,
    resume: bool = True,
    time_limit: float | None = TIME_LIMIT,
    notes: Sequence[str] = (),
    progress: bool = True,
) -> Comparison:
    """Evaluate every controller over the same Brownian paths.

    A controller that raises becomes a row with its message in `errors`; the others go on. With
    a `folder`, work is written there as it is finished, some thousand episodes at a time, so that
    an interrupted comparison continues where it stopped; only what has the same scenario, seed,
    controller, code and versions counts as the same. The numbers depend on neither the workers
    nor the cluster, to the last bit.

    Args:
        controllers: name -> controller; or :class:`slipcar.evaluation.runs.Runs` for a learned
            method with several trainings; or a function of the scenario that makes a controller.
            In the order of the table.
        scenario: a scenario or the name of one.
        episodes: a row, >= 1; None is 10 000, or what `resolution` needs.
        seed: of the Brownian paths, >= 0.
        reference: the row that paired differences are taken against; None takes the first whose
            name contains "SCP", else the first.
        resolution: half width that the 95 % intervals of the collision rates are to have, such as
            0.001. Without `episodes`, each row drives as many as its own rate needs, judged from
            its first 8192; with them, rows whose interval is wider are named in `warnings`.
        substeps: Euler–Maruyama steps in each control interval.
        n_jobs: worker processes on this machine.
        cluster: None, or a Dask cluster: see :func:`slipcar.evaluation.executors.open_executor`.
        folder: where finished work is kept; None keeps it in memory alone.
        resume: whether to reuse finished work of `folder`.
        time_limit: seconds that a row may take for 1024 episodes before it counts as failed; None
            is no limit.
        notes: what readers of the table must be told besides; they come first in `warnings`.
        progress: whether to show a bar for each row.

    Raises:
        ValueError: for a bad argument, before anything is run.
        OSError: if the cluster does not answer.
        LostWorkersError: if the cluster is gone; finished work is kept.
    """
    scenario = Scenario.of(scenario)
    if resolution is not None:
        episodes_for(resolution, 0.0)  # raises now if it is out of range
    fixed = episodes if episodes is not None else None if resolution is not None else 10_000
    counted = checked_counts(PILOT if fixed is None else fixed, seed, substeps, n_jobs)
    _, seed, substeps, n_jobs = counted
    fixed = None if fixed is None else counted.episodes
    if time_limit is not None:
        time_limit = checked_float("time_limit", time_limit, above=0.0)
    if not controllers:
        raise ValueError("compare needs at least one controller, not an empty mapping")
    for name, controller in controllers.items():
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise ValueError(f"a row's name must be a non-empty string in one line, not {name!r}")
        if not isinstance(controller, Runs) and not _is_maker(controller):
            check_controller(controller)
    chosen = _reference(list(controllers), reference)
    began = time.perf_counter()
    store = Store(folder, resume)
    rows, unmade = _made(controllers, scenario, time_limit)
    counts = dict.fromkeys(rows, PILOT if fixed is None else fixed)
    trained = {name: len(trainings(controller)) for name, controller in rows.items()}

    def jobs() -> list[Job]:
        return [
            Job(name, "", label, one, scenario, counts[name], seed, substeps, time_limit)
            for name, controller in rows.items()
            if name in counts
            for label, one in trainings(controller).items()
        ]

    def expected() -> dict[str, int]:
        return {name: counts[name] * trained[name] for name in counts}

    swept = []
    with open_executor(n_jobs, cluster) as executor:
        with Bars(expected(), progress) as bars:
            swept.append(sweep(jobs(), store, executor, bars))
        results, errors = _rows(rows, swept[0])
        if fixed is None and resolution is not None:
            counts = {name: needed(resolution, row) for name, row in results.items()}
            with Bars(expected(), progress) as bars:
                swept.append(sweep(jobs(), store, executor, bars))
            results, more = _rows({name: rows[name] for name in counts}, swept[1])
            errors |= more
    warnings = [*notes, store.trouble] if store.trouble else [*notes]
    if resolution is not None:
        warnings += _too_wide(results, resolution)
    reused = [
        name
        for name in results
        if all(
            (name, "", label) in part.reused for part in swept for label in trainings(rows[name])
        )
    ]
    computed = sum(part.computed for part in swept)
    if folder is not None and resume and computed and (others := store.foreign()):
        warnings.append(
            f"{others} finished cells in {store.folder} belong to other options or another version "
            "and were not used; they may be deleted"
        )
    return Comparison(
        scenario=scenario,
        episodes=max((row.episodes for row in results.values()), default=0),
        seed=seed,
        substeps=substeps,
        reference=chosen,
        controllers={name: rows.get(name, controllers[name]) for name in controllers},
        results=results,
        errors=unmade | errors,
        reused=tuple(reused),
        warnings=tuple(warnings),
        wall_time=time.perf_counter() - began,
        provenance=provenance(),
    )


def _is_maker(controller: Any) -> bool:
    return callable(controller) and not callable(getattr(controller, "predict", None))


def _made(
    controllers: Mapping[str, Row], scenario: Scenario, limit: float | None
) -> tuple[dict[str, Controller | Runs], dict[str, str]]:
    """Rows that can be driven, and messages of those whose making failed."""
    rows: dict[str, Any] = {}
    errors: dict[str, str] = {}
    for name, controller in controllers.items():
        if isinstance(controller, Runs) or not _is_maker(controller):
            rows[name] = controller
            continue
        try:
            with time_limit(limit, "making the controller"):
                rows[name] = controller(scenario)  # type: ignore[operator]
            check_controller(rows[name])
        except (Exception, SystemExit) as error:  # one bad row must not cost the others
            rows.pop(name, None)
            errors[name] = message(error)
    return rows, errors


def needed(resolution: float, row: Result) -> int:
    """Episodes for a row whose interval is to be at most ± `resolution`, in whole blocks.

    The rate is taken to be at the far end of the interval that the episodes so far left of it. Of
    several trainings it is the paths' part alone: more episodes make no other trainings.
    """
    low, high = rate_interval(row.per_path("collision"))
    rate = 0.5 if low < 0.5 < high else high if high <= 0.5 else low
    return min(MOST, max(PILOT, -(-episodes_for(resolution, rate) // BLOCK) * BLOCK))


def _rows(
    controllers: Mapping[str, Controller | Runs], swept: Swept
) -> tuple[dict[str, Result], dict[str, str]]:
    """Results and errors by row."""
    found = {name: swept.row(name, controller) for name, controller in controllers.items()}
    results = {name: row for name, row in found.items() if isinstance(row, Result)}
    return results, {name: row for name, row in found.items() if isinstance(row, str)}


def _too_wide(results: dict[str, Result], resolution: float) -> list[str]:
    """A warning for each row that cannot tell rates apart as finely as was asked for."""
    found = []
    for name, row in results.items():
        low, high = row.collision_interval
        if 0.5 * (high - low) <= resolution:
            continue
        more = needed(resolution, row)
        if half_width(row.collision_rate, row.episodes) <= resolution:
            remedy = "it takes more trainings, not more episodes"
        elif more < MOST:
            remedy = f"{more:,} episodes would do"
        else:
            remedy = f"so fine a claim needs more than {MOST:,} episodes"
        found.append(
            f"{name}: its collision rate is known to ± {50 * (high - low):.2g} %, not to the "
            f"± {100 * resolution:g} % asked for; {remedy}"
        )
    return found


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison(ComparisonRecord):
    """What :func:`compare` returns: its record, and ways to write it.

    Attributes are those of :class:`slipcar.evaluation.comparison_record.ComparisonRecord`.
    """

    def _repr_html_(self) -> str:
        return report.html(self)

    def plot(self, axes: Any = None) -> Any:
        """Draw mean cost against collision rate, with 95 % intervals of both, with matplotlib.

        Args:
            axes: an Axes to draw into; None makes a figure.

        Returns:
            The Axes.

        Raises:
            ImportError: without matplotlib.
            ValueError: if no row finished.
        """
        if not self.results:
            raise ValueError("there is nothing to plot: no row finished")
        try:
            import matplotlib.pyplot as plt

            from slipcar.evaluation.figures.rows import draw_tradeoff
        except ImportError as error:
            raise ImportError(f"plot needs matplotlib ({error}): {install('plot')}") from error
        if axes is None:
            _, axes = plt.subplots(figsize=(8.8, 4.3), layout="constrained")
        draw_tradeoff(axes, self)
        axes.legend(
            title="filled: closed loop, hollow: open loop", alignment="left", fontsize="small",
            loc="upper left", bbox_to_anchor=(1.0, 1.0),
        )  # fmt: skip
        return axes

    def to_markdown(self) -> str:
        """Tables in Markdown with what they mean and where they come from."""
        return report.markdown(self)

    def to_latex(self) -> str:
        """The same as LaTeX (booktabs)."""
        return report.latex(self)

    def to_json(self) -> str:
        """Raw numbers, scenario, seed, options, versions and machine."""
        return report.json_text(self)

    def save(self, folder: str | Path, figures: bool = True) -> list[Path]:
        """Write `table.md`, `table.csv`, `table.tex`, `results.json` and the figures.

        Args:
            folder: made if it does not exist.
            figures: also draw them (PNG and PDF; needs matplotlib).

        Returns:
            The files written.
        """
        return report.save(self, Path(folder), figures)


def _reference(names: list[str], wanted: str | None) -> str:
    if wanted is None:
        return next((name for name in names if "scp" in name.lower()), names[0])
    if wanted not in names:
        raise ValueError(f"unknown reference {wanted!r}; the rows are {names}")
    return wanted

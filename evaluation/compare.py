"""`evaluate` one controller, `compare` many over the same Brownian paths (SPEC §7)."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.metrics import Result
from slipcar.evaluation.provenance import provenance
from slipcar.evaluation.rollout import Controller, check_controller, check_counts, rollout
from slipcar.evaluation.statistics import paired_difference
from slipcar.evaluation.store import load_row, row_key, save_row

if TYPE_CHECKING:
    import pandas as pd

#: Per-episode metrics whose paired differences against the reference row are shown.
DIFFERENCES = {"total_difference": "total", "collision_difference": "collision"}


def evaluate(
    controller: Controller,
    scenario: Scenario | str,
    episodes: int = 10_000,
    seed: int = 0,
    *,
    substeps: int = 1,
    batch_size: int | None = None,
    n_jobs: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Result:
    """Drive many episodes and say what came of them.

    Example:
        >>> from slipcar.evaluation import evaluate
        >>> from slipcar.planner import OpenLoop, plan
        >>> r = evaluate(OpenLoop(plan(scenario)), scenario, episodes=10_000, seed=0)
        >>> r.collision_rate, r.collision_interval, r.total, r.total_se

    Args:
        controller: any object with the `predict` of Stable-Baselines3; see
            :class:`slipcar.evaluation.rollout.Controller` for what else it may offer.
        scenario: a scenario or the name of one.
        episodes: how many, >= 1.
        seed: of the Brownian paths, >= 0; episode i depends on (seed, i) alone.
        substeps: Euler–Maruyama steps in each control interval.
        batch_size: episodes in one task of a worker; the numbers do not depend on it.
        n_jobs: worker processes; the numbers do not depend on it.
        progress: called with the number of episodes finished since the last call.

    Raises:
        ValueError: for a bad argument, or a bad action, naming controller, step and episode.
    """
    began = time.perf_counter()
    done = rollout(
        controller,
        scenario,
        episodes,
        seed,
        substeps=substeps,
        batch_size=batch_size,
        n_jobs=n_jobs,
        progress=progress,
    )
    preparation = getattr(controller, "preparation_time", None)
    return Result(
        metrics=done.metrics,
        seed=seed,
        substeps=substeps,
        closed_loop=bool(getattr(controller, "closed_loop", True)),
        failures=solver_failures(controller) if done.failures is None else done.failures,
        inference_time=done.inference_time,
        preparation_time=float("nan") if preparation is None else float(preparation),
        wall_time=time.perf_counter() - began,
    )


def solver_failures(controller: Controller) -> int:
    """Solves behind a controller that failed: its `failures`, else 1 for an unconverged plan."""
    counted = getattr(controller, "failures", None)
    if counted is not None:
        return int(counted)
    status = getattr(getattr(controller, "plan", None), "status", None)
    return int(status is not None and not status.ok)


def compare(
    controllers: Mapping[str, Controller],
    scenario: Scenario | str,
    episodes: int = 10_000,
    seed: int = 0,
    *,
    reference: str | None = None,
    substeps: int = 1,
    batch_size: int | None = None,
    n_jobs: int = 1,
    folder: str | Path | None = None,
    resume: bool = True,
    progress: bool = True,
) -> Comparison:
    """Evaluate every controller over the same Brownian paths.

    A controller that raises becomes a row with its message in `errors`; the others go on. With
    a `folder`, each finished row is written there at once, so that an interrupted comparison
    continues where it stopped; only the same scenario, seed, episodes, controller and code
    count as the same row.

    Args:
        controllers: name -> controller, in the order of the table.
        scenario: a scenario or the name of one.
        episodes: a row, >= 1.
        seed: of the Brownian paths, >= 0.
        reference: the row that paired differences are taken against; None takes the first whose
            name contains "SCP", else the first.
        substeps: Euler–Maruyama steps in each control interval.
        batch_size: episodes in one task of a worker; the numbers do not depend on it.
        n_jobs: worker processes; the numbers do not depend on it.
        folder: where finished rows are kept; None keeps them in memory alone.
        resume: whether to reuse finished rows of `folder`.
        progress: whether to show a bar for each row.

    Raises:
        ValueError: for a bad argument, before anything is run.
    """
    scenario = Scenario.of(scenario)
    check_counts(episodes, seed, substeps, batch_size, n_jobs)
    if not controllers:
        raise ValueError("compare needs at least one controller, not an empty mapping")
    for name, controller in controllers.items():
        if not isinstance(name, str) or not name.strip():
            raise ValueError(f"a row's name must be a non-empty string, not {name!r}")
        check_controller(controller)
    chosen = _reference(list(controllers), reference)
    began = time.perf_counter()
    results: dict[str, Result] = {}
    errors: dict[str, str] = {}
    reused: list[str] = []
    with _Progress(progress, episodes, max(map(len, controllers))) as show:
        for name, controller in controllers.items():
            key = None
            if folder is not None:
                key = row_key(controller, scenario, episodes, seed, substeps)
            stored = None
            if folder is not None and key is not None and resume:
                stored = load_row(folder, name, key)
            if stored is not None:
                results[name] = stored
                reused.append(name)
                show.row(name, "stored")(episodes)
                continue
            try:
                results[name] = evaluate(
                    controller,
                    scenario,
                    episodes,
                    seed,
                    substeps=substeps,
                    batch_size=batch_size,
                    n_jobs=n_jobs,
                    progress=show.row(name),
                )
            except Exception as error:  # one bad row must not cost the others
                notes = getattr(error, "__notes__", [])
                errors[name] = "; ".join([f"{type(error).__name__}: {error}", *notes])
                show.note("failed")
                continue
            if folder is not None and key is not None:
                save_row(folder, name, key, results[name])
    return Comparison(
        scenario=scenario,
        episodes=episodes,
        seed=seed,
        substeps=substeps,
        reference=chosen,
        controllers=dict(controllers),
        results=results,
        errors=errors,
        reused=tuple(reused),
        wall_time=time.perf_counter() - began,
        provenance=provenance(),
    )


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Rows of controllers over common Brownian paths; what :func:`compare` returns.

    Attributes:
        scenario: the world.
        episodes: a row.
        seed: of the Brownian paths.
        substeps: Euler–Maruyama steps in each control interval.
        reference: name of the row that differences are taken against.
        controllers: name -> controller, in order.
        results: name -> result, of the rows that finished.
        errors: name -> message, of the rows that raised.
        reused: names of the rows that were read from the folder.
        wall_time: seconds the comparison took.
        provenance: versions, machine, date, commit.
    """

    scenario: Scenario
    episodes: int
    seed: int
    substeps: int
    reference: str
    controllers: dict[str, Controller]
    results: dict[str, Result]
    errors: dict[str, str]
    reused: tuple[str, ...]
    wall_time: float
    provenance: dict[str, Any]

    @functools.cached_property
    def frame(self) -> pd.DataFrame:
        """One row a controller, raw numbers in SI units; differences are to `reference`."""
        import pandas as pd

        rows = {}
        for name in self.controllers:
            row: dict[str, Any] = {"error": self.errors.get(name, "")}
            if name in self.results:
                row.update(self.results[name].summary())
                row.update(self._differences(name))
            rows[name] = row
        columns = list(dict.fromkeys(key for row in rows.values() for key in row if key != "error"))
        frame = pd.DataFrame.from_dict(rows, orient="index", columns=[*columns, "error"])
        return frame.rename_axis("controller")

    def _differences(self, name: str) -> dict[str, float]:
        found: dict[str, float] = {}
        for label, metric in DIFFERENCES.items():
            low = mean = high = float("nan")
            if name != self.reference and self.reference in self.results:
                mean, low, high = paired_difference(
                    getattr(self.results[name].metrics, metric),
                    getattr(self.results[self.reference].metrics, metric),
                )
            found.update({label: mean, f"{label}_low": low, f"{label}_high": high})
        return found

    def to_markdown(self) -> str:
        """Tables in Markdown with what they mean and where they come from."""
        from slipcar.evaluation import report

        return report.markdown(self)

    def to_latex(self) -> str:
        """The same as LaTeX (booktabs)."""
        from slipcar.evaluation import report

        return report.latex(self)

    def to_csv(self, path: str | Path | None = None) -> str | None:
        """Raw numbers as CSV: the text, or None after writing it to `path`."""
        return self.frame.to_csv(path)

    def to_json(self) -> str:
        """Raw numbers, scenario, seed, options, versions and machine."""
        from slipcar.evaluation import report

        return report.json_text(self)

    def save(self, folder: str | Path, figures: bool = True) -> list[Path]:
        """Write `table.md`, `table.csv`, `table.tex`, `results.json` and the figures.

        Args:
            folder: made if it does not exist.
            figures: also draw them (PNG and PDF; needs matplotlib, `pip install slipcar[plot]`).

        Returns:
            The files written.
        """
        from slipcar.evaluation import report

        return report.save(self, Path(folder), figures)


def _reference(names: list[str], wanted: str | None) -> str:
    if wanted is None:
        return next((name for name in names if "scp" in name.lower()), names[0])
    if wanted not in names:
        raise ValueError(f"unknown reference {wanted!r}; the rows are {names}")
    return wanted


class _Progress:
    """A bar for each row, or nothing."""

    def __init__(self, shown: bool, episodes: int, width: int) -> None:
        self.episodes = episodes
        self.width = width
        self.bars: Any = None
        if shown:
            from rich import progress
            from rich.console import Console

            self.bars = progress.Progress(
                progress.TextColumn("{task.description}"),
                progress.BarColumn(),
                progress.TextColumn("{task.completed:,.0f} of {task.total:,.0f} episodes"),
                progress.TimeElapsedColumn(),
                progress.TextColumn("{task.fields[note]}"),
                console=Console(stderr=True),
            )

    def __enter__(self) -> _Progress:
        if self.bars is not None:
            self.bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self.bars is not None:
            self.bars.stop()

    def row(self, name: str, note: str = "") -> Callable[[int], None]:
        """What to call with the episodes finished since the last call."""
        if self.bars is None:
            return lambda episodes: None
        self.task = self.bars.add_task(name.ljust(self.width), total=self.episodes, note=note)
        return lambda episodes: self.bars.advance(self.task, episodes)

    def note(self, text: str) -> None:
        """Say something beside the current row's bar."""
        if self.bars is not None:
            self.bars.update(self.task, note=text)

"""Many rows in many worlds: cut into cells, those that are missing computed, all put together.

A job is one controller in one world. Its episodes are cut into cells whose size does not depend
on the workers, so what one run finished any other can use. Cells of all jobs are handed out
together: the last slow row does not wait for the rest.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.cells import Store, cell_key, cell_size, controller_fingerprint
from slipcar.evaluation.controller import Controller
from slipcar.evaluation.executors import Executor, Outcome, run
from slipcar.evaluation.metrics import Result
from slipcar.evaluation.progress import Bars
from slipcar.evaluation.rollout import Measured, Stretch, joined, measure
from slipcar.evaluation.runs import Runs, trainings
from slipcar.evaluation.ticks import Ticks

#: Seconds that 1024 episodes of a row may take; a hundred times what a receding horizon needs.
TIME_LIMIT = 300.0


#: What a row may be: a function of the scenario that makes its controller (a
#: :class:`slipcar.evaluation.makers.Maker`, or a user's own); or brought along, once or in several
#: trainings.
Row = Callable[[Scenario], Controller] | Controller | Runs
#: Of a job: row, variant, training.
Name = tuple[str, str, str]


@dataclasses.dataclass(frozen=True)
class Job:
    """One controller in one world.

    Attributes:
        row: name of the row, and of the progress bar.
        variant: which world, of several; empty where there is one.
        training: which of several trainings of a learned row; empty where there is one.
        controller: who drives; or a function of the scenario that makes it, with `fingerprint()`
            if finished work is to be reused: then workers plan.
        scenario: where.
        episodes: how many, >= 1.
        seed: of the Brownian paths.
        substeps: Euler–Maruyama steps in each control interval.
        time_limit: seconds that 1024 episodes may take; None is no limit.
    """

    row: str
    variant: str
    training: str
    controller: Controller | Callable[[Scenario], Controller]
    scenario: Scenario
    episodes: int
    seed: int
    substeps: int = 1
    time_limit: float | None = TIME_LIMIT

    @property
    def name(self) -> Name:
        """Row, variant and training."""
        return self.row, self.variant, self.training

    def stretches(self) -> list[Stretch]:
        """Its episodes in cells; a controller that is made in the worker is made only once."""
        made_there = not callable(getattr(self.controller, "predict", None))
        size = self.episodes if made_there else cell_size(self.controller)
        return [
            Stretch(
                controller=self.controller,
                scenario=self.scenario,
                first=first,
                episodes=min(size, self.episodes - first),
                seed=self.seed,
                substeps=self.substeps,
                time_limit=self.time_limit,
            )
            for first in range(0, self.episodes, size)
        ]


@dataclasses.dataclass(frozen=True)
class Swept:
    """What came of jobs.

    Attributes:
        results: name of the job -> result, of those that finished.
        errors: name -> message, of those that raised.
        reused: jobs of which every cell was there before.
        computed: cells that were computed.
    """

    results: dict[Name, Result]
    errors: dict[Name, str]
    reused: frozenset[Name]
    computed: int

    def row(self, row: str, controller: Row, variant: str = "") -> Result | str:
        """A row in a variant, all its trainings together; or what the first that failed said."""
        names = [(row, variant, training) for training in trainings(controller)]
        failed = next((self.errors[name] for name in names if name in self.errors), None)
        return failed or Result.of_runs([self.results[name] for name in names])

    def stored(self, row: str, controller: Row, variant: str = "") -> bool:
        """Whether all of such a row was there before."""
        return all((row, variant, training) in self.reused for training in trainings(controller))


@dataclasses.dataclass(frozen=True)
class _Piece:
    """A cell of a job, on its way through the workers."""

    job: Name
    index: int
    key: dict[str, Any] | None
    stretch: Stretch
    ticks: Ticks | None = None
    number: str = ""

    @property
    def cell(self) -> str:
        """Names it among the cells under way."""
        return f"{'|'.join(self.job)}|{self.index}"


def sweep(jobs: Sequence[Job], store: Store, executor: Executor, bars: Bars) -> Swept:
    """Do jobs: take what the store has, compute the rest, and keep each cell as it finishes.

    A job that raises becomes an error, the others go on.

    Raises:
        LostWorkersError: if the cluster is gone; what was finished is in the store.
    """
    done: dict[Name, dict[int, Measured]] = {job.name: {} for job in jobs}
    counts: dict[Name, int] = {}
    failed: dict[Name, dict[int, str]] = {}
    missing: list[_Piece] = []
    for job in jobs:
        stretches = job.stretches()
        fingerprint = controller_fingerprint(job.controller)
        counts[job.name] = len(stretches)
        for index, stretch in enumerate(stretches):
            key = cell_key(stretch, fingerprint)
            found = store.get(key)
            if found is None:
                missing.append(_Piece(job.name, index, key, stretch))
            else:
                done[job.name][index] = found
                bars.advance(job.row, stretch.episodes)
    reused = frozenset(name for name, cells in done.items() if len(cells) == counts[name])

    def wanted() -> Iterator[_Piece]:
        for piece in missing:
            if piece.job not in failed:
                yield piece

    computed = 0
    for piece, measured, error in _computed(wanted(), executor, bars):
        row, *_ = piece.job
        if error is not None:
            failed.setdefault(piece.job, {})[piece.index] = message(error)
            bars.advance(row, 0, piece.cell)
            bars.note(row, "failed")
            continue
        computed += 1
        done[piece.job][piece.index] = measured
        store.put(piece.key, measured)
        bars.advance(row, piece.stretch.episodes, piece.cell)
    # Cells are handed out in order: the first that failed is the same, whoever was quicker.
    errors = {job: found[min(found)] for job, found in failed.items()}
    results = {
        job.name: joined(
            [done[job.name][index] for index in range(counts[job.name])],
            job.scenario,
            job.seed,
            job.substeps,
        )
        for job in jobs
        if job.name not in errors
    }
    return Swept(results, errors, reused, computed)


def _computed(pieces: Iterator[_Piece], executor: Executor, bars: Bars) -> Iterator[Outcome]:
    """Cells as they finish; meanwhile the bars are told how far those under way are."""
    if executor.open is None:

        def here(piece: _Piece) -> Measured:
            return measure(piece.stretch, lambda done: bars.within(piece.job[0], piece.cell, done))

        yield from run(here, pieces, executor)
        return
    with tempfile.TemporaryDirectory(prefix="slipcar-", ignore_cleanup_errors=True) as folder:
        ticks = Ticks(folder) if executor.local else None
        under_way: dict[str, _Piece] = {}

        def handed_out() -> Iterator[_Piece]:
            for number, piece in enumerate(pieces):
                under_way[str(number)] = piece
                yield dataclasses.replace(piece, ticks=ticks, number=str(number))

        def look() -> None:
            for number, episodes in ticks.read() if ticks is not None else ():
                if (piece := under_way.get(number)) is not None:
                    bars.within(piece.job[0], piece.cell, episodes)

        for outcome in run(_measured, handed_out(), executor, look):
            under_way.pop(outcome.task.number, None)
            yield outcome


def _measured(piece: _Piece) -> Measured:
    ticks = piece.ticks
    return measure(piece.stretch, None if ticks is None else ticks.writer(piece.number))


def message(error: BaseException) -> str:
    """An error in one line, with what was noted on its way."""
    told = "; ".join([f"{type(error).__name__}: {error}", *getattr(error, "__notes__", [])])
    return " ".join(told.split())

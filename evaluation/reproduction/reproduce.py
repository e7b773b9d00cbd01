"""`reproduce`: every claim of the paper's §6 beside what we get, and what its text gets wrong.

The paper: Bonalli, Lew, Pavone, Sequential Convex Programming for Non-Linear Stochastic Optimal
Control. Numbers are computed, verdicts follow from them; each row says the line of Python that
gives its number again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.compare import evaluate
from slipcar.evaluation.provenance import provenance
from slipcar.evaluation.report.comparison import tables_are_in
from slipcar.evaluation.reproduction.record import PAPER_EPISODES, ReproductionRecord
from slipcar.evaluation.reproduction.runs import (
    CLEARANCES,
    PLANS,
    SWEEP,
    Rate,
    Run,
    backends,
    compared,
    path_moments,
    played,
    reference_file,
)
from slipcar.evaluation.rollout import checked_counts
from slipcar.planner import plan

if TYPE_CHECKING:
    from slipcar.evaluation.report.document import Document

#: Paths that a rate is measured on.
EPISODES = 100_000


@dataclasses.dataclass(frozen=True, repr=False)
class Reproduction(ReproductionRecord):
    """What :func:`reproduce` returns: its record, and ways to write it.

    Attributes are those of :class:`slipcar.evaluation.reproduction.record.ReproductionRecord`.
    """

    def document(self, figures: bool = True) -> Document:
        """Everything as tables, with or without the figures that :meth:`save` draws."""
        from slipcar.evaluation.reproduction import tables as reproduce_tables

        return reproduce_tables.document(self, figures)

    def save(self, folder: str | Path, figures: bool = True) -> list[Path]:
        """Write tables, raw numbers and figures into a folder.

        Returns:
            The files written.

        Raises:
            ImportError: if figures are wanted and matplotlib is not installed; the tables are
                written all the same.
        """
        folder = Path(folder)
        written = self.document(figures=False).save(folder)
        if figures:
            with tables_are_in(folder):
                from slipcar.evaluation.reproduction import figures as reproduce_figures
            drawn = reproduce_figures.save_all(self, folder)
            written = list(dict.fromkeys([*self.document().save(folder), *drawn]))
        return written


def reproduce(
    episodes: int = EPISODES,
    seed: int = 0,
    *,
    reference: str | Path | None = None,
    n_jobs: int = 1,
    progress: Callable[[str, float], None] | None = None,
) -> Reproduction:
    """Compute every number of the paper's §6, and those that show where its text is wrong.

    Example:
        >>> from slipcar.evaluation.reproduction.reproduce import reproduce
        >>> r = reproduce(episodes=20_000)
        >>> r.document().frames["table"][["paper", "here", "verdict"]]

    Args:
        episodes: paths a plan, >= 1.
        seed: of the Brownian paths, >= 0; the same for all plans.
        reference: JSON file with arrays of the paper's case that were computed elsewhere; None
            takes the checkout's, or does without.
        n_jobs: worker processes; the numbers do not depend on it.
        progress: called with what is next, and the share that is done.

    Raises:
        ValueError: for a bad argument, or a file that is no reference.
        OSError: if the reference cannot be read.
    """
    episodes, seed, _, n_jobs = checked_counts(episodes, seed, 1, n_jobs)
    s = Scenario.named("paper")
    told = reference_file() if reference is None else Path(reference)
    steps = len(PLANS) + len(CLEARANCES) / SWEEP + 4.0
    done = 0.0

    def step(what: str, size: float = 1.0) -> None:
        nonlocal done
        if progress is not None:
            progress(what, done / steps)
        done += size

    step("reference arrays")  # first: a bad file is said at once
    agreement = {} if told is None else compared(s, told)
    runs = {}
    for name in PLANS:
        step(f"plan: {name}")
        runs[name] = Run.of(name, s, episodes, seed, n_jobs)
    ours = runs["ours"].plan
    step(f"{PAPER_EPISODES:,} paths, as the paper")
    paper = evaluate(played(ours, s), s, PAPER_EPISODES, seed, n_jobs=n_jobs)
    step("moments of the paths")
    moments = path_moments(ours, s, episodes, seed)
    sweep = {}
    for clearance in CLEARANCES:
        step(f"clearance {clearance:g} m", 1.0 / SWEEP)
        found = plan(s.replace(clearance=clearance), method="convex")
        paths = max(1, episodes // SWEEP)
        sweep[clearance] = Rate.of(found, s, paths, seed, n_jobs)
    step("solvers")
    solvers = backends(s, ours)
    return Reproduction(
        scenario=s,
        episodes=episodes,
        seed=seed,
        runs=runs,
        paper=paper,
        moments=moments,
        sweep=sweep,
        agreement=agreement,
        solvers=solvers,
        provenance=provenance(),
    )

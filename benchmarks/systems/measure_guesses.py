"""Disturbed guesses: from how many of them `plan` and IPOPT converge, and to what."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .attempts import Attempt, attempt
from .catalogue import SYSTEMS
from .guesses import Guess, disturbed
from .judge import AS_GOOD, judge
from .memory import solved
from .transcription import Programme, Solved

Array = np.ndarray

#: Guesses of each system.
COUNT = 20


@dataclasses.dataclass(frozen=True)
class FromGuesses:
    """One system: an entry for each guess.

    Attributes:
        name: of the system.
        ours: what `plan` made of them.
        theirs: what IPOPT made of them.
        costs: ours, infinite where it is not solved.
        peer_costs: IPOPT's, judged alike.
        best: the least cost seen, from whichever guess and by whom.
    """

    name: str
    ours: list[Attempt]
    theirs: list[Solved]
    costs: Array
    peer_costs: Array
    best: float

    @property
    def limit(self) -> float:
        """What a plan may cost to be as good as the best."""
        return self.best + AS_GOOD * abs(self.best)

    def row(self) -> dict[str, Any]:
        """A row of the table: what failed by its seeds, CONVERGED_INFEASIBLE if it lies."""
        ours, theirs = self.ours, self.theirs
        failed = [seed for seed, cost in enumerate(self.costs) if not np.isfinite(cost)]
        return {
            "system": self.name,
            "guesses": len(ours),
            "converged": int(np.isfinite(self.costs).sum()),
            "IPOPT": int(np.isfinite(self.peer_costs).sum()),
            "certified": sum(a.solved and a.certified for a in ours),
            "within 1 %": int((self.costs <= self.limit).sum()),
            "IPOPT within": int((self.peer_costs <= self.limit).sum()),
            "best": f"{self.best:.6g}",
            "iterations": f"{np.median([a.iterations for a in ours]):.0f}",
            "IPOPT's": f"{np.median([s.iterations for s in theirs]):.0f}",
            "ms": f"{1e3 * np.median([a.seconds for a in ours]):.2f}",
            "worst": f"{1e3 * np.max([a.seconds for a in ours]):.0f}",
            "IPOPT's ms": f"{1e3 * np.median([s.seconds for s in theirs]):.2f}",
            "failed": " ".join(map(str, failed)),
            "how": " ".join(sorted({_reason(ours[seed]) for seed in failed})),
        }


def measure(
    names: Sequence[str], folder: Path, count: int = COUNT, *, own: bool = False
) -> Iterator[FromGuesses]:
    """Each system from the guesses of seeds 0 to count − 1.

    Args:
        names: systems.
        folder: of IPOPT's answers.
        count: guesses.
        own: as the problem's own `initial_guess`; else as `guess=`, and no other beside it.
    """
    for name in names:
        problem = SYSTEMS[name].make()
        programme = Programme(problem)
        first = solved(programme, None, folder)
        attempt(problem)  # compiles
        ours, theirs = [], []
        for seed in range(count):
            guess = disturbed(problem, (first.states, first.controls), seed)
            theirs.append(solved(programme, guess, folder))
            ours.append(_from(name, problem, guess, own=own))
        costs = np.array([a.judged.cost if a.solved else np.inf for a in ours])
        peer_costs = np.array([_worth(problem, answer) for answer in theirs])
        best = min(_worth(problem, first), costs.min(), peer_costs.min())
        yield FromGuesses(name, ours, theirs, costs, peer_costs, float(best))


def _from(name: str, problem: Any, guess: Guess, *, own: bool) -> Attempt:
    if not own:
        return attempt(problem, guess=guess, cold_start="never")
    another = SYSTEMS[name].make()
    another.initial_guess = lambda: guess
    return attempt(another)


def _reason(failed: Attempt) -> str:
    return "CONVERGED_INFEASIBLE" if failed.ok else failed.status


def _worth(problem: Any, answer: Solved) -> float:
    judged = judge(problem, answer.states, answer.controls)
    return judged.cost if answer.converged and judged.feasible else np.inf


def summary(found: Sequence[FromGuesses]) -> list[str]:
    """What the rows amount to."""
    count = sum(len(f.ours) for f in found)
    ours, theirs = (
        sum(int(np.isfinite(c).sum()) for c in each)
        for each in ([f.costs for f in found], [f.peer_costs for f in found])
    )
    near = sum(int((f.costs <= f.limit).sum()) for f in found)
    peer_near = sum(int((f.peer_costs <= f.limit).sum()) for f in found)
    certified = sum(a.solved and a.certified for f in found for a in f.ours)
    fewer = [f.name for f in found if np.isfinite(f.costs).sum() < np.isfinite(f.peer_costs).sum()]
    return [
        f"converged: {ours} of {count} (IPOPT {theirs}), certified: {certified}",
        f"within 1 % of the best known: {near} (IPOPT {peer_near})",
        f"converged from fewer guesses than IPOPT: {', '.join(fewer) or 'none'}",
    ]

"""The default call, `plan(problem, variance_weight=0.0)`, beside IPOPT from the same guess."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .attempts import Attempt, attempt
from .catalogue import SYSTEMS
from .judge import AS_GOOD, excess
from .table import yes
from .transcription import Programme, Solved

#: Turns of a system, and seconds for all of them.
TURNS, BUDGET = 15, 3.0


@dataclasses.dataclass(frozen=True)
class Compared:
    """One system: what `plan` and IPOPT made of it, each the fastest of its turns."""

    name: str
    ours: Attempt
    theirs: Solved

    @property
    def excess(self) -> float:
        """Our cost above IPOPT's, in parts of it."""
        return excess(self.ours.judged.cost, self.theirs.cost)

    @property
    def good(self) -> bool:
        """Whether it is solved, certified and at most 1 % dearer than IPOPT's."""
        return self.ours.solved and self.ours.certified and self.excess <= AS_GOOD

    @property
    def faster(self) -> float:
        """How many times as long IPOPT takes; nan for what is not solved."""
        return self.theirs.seconds / self.ours.seconds if self.ours.solved else float("nan")

    def row(self) -> dict[str, Any]:
        """A row of the table."""
        ours, theirs = self.ours, self.theirs
        return {
            "system": self.name,
            "status": ours.status,
            "certified": yes(ours.certified),
            "iterations": ours.iterations,
            "cost": f"{ours.judged.cost:.6g}",
            "cost/IPOPT − 1": f"{self.excess:+.1e}",
            "miss": f"{ours.judged.miss:.0e}",
            "ms": f"{1e3 * ours.seconds:.2f}",
            "IPOPT": f"{theirs.cost:.6g}" if theirs.converged else theirs.status,
            "its iterations": theirs.iterations,
            "its ms": f"{1e3 * theirs.seconds:.2f}",
            "times faster": f"{self.faster:.2f}",
            "good": yes(self.good),
        }


def measure(names: Sequence[str]) -> Iterator[Compared]:
    """Each system by turns of `plan` and IPOPT, after one that is not counted.

    There is no other turn for what does not converge, or takes more than its share.
    """
    for name in names:
        problem, programme = SYSTEMS[name].make(), Programme(SYSTEMS[name].make())
        ours, theirs = attempt(problem), programme.solve()
        spent = ours.seconds + theirs.seconds
        turns: list[tuple[Attempt, Solved]] = []
        while ours.ok and len(turns) < TURNS and spent < BUDGET:
            turns.append((attempt(problem), programme.solve()))
            spent += sum(each.seconds for each in turns[-1])
        if turns:
            ours = min((turn[0] for turn in turns), key=lambda each: each.seconds)
            theirs = min((turn[1] for turn in turns), key=lambda each: each.seconds)
        yield Compared(name, ours, theirs)


def summary(found: Sequence[Compared]) -> list[str]:
    """What the rows amount to, variants left out."""
    own = [c for c in found if not SYSTEMS[c.name].variant]
    good = [c for c in own if c.good]
    faster = np.array([c.faster for c in own if c.ours.solved])
    refused = [c.name for c in found if c.ours.ok and not c.ours.certified]
    slower = [c.name for c in found if c.faster < 1.0]
    mean = np.exp(np.mean(np.log(faster))) if len(faster) else np.nan
    return [
        f"converged, certified, at most 1 % dearer than IPOPT: {len(good)} of {len(own)} systems",
        f"IPOPT's time over ours, geometric mean of the {len(faster)} solved: {mean:.2f}",
        f"slower than IPOPT, variants too: {', '.join(slower) or 'none'}",
        f"CONVERGED but not certified, variants too: {', '.join(refused) or 'none'}",
    ]

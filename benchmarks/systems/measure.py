"""The three measurements: the default call, disturbed guesses, other units."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .attempts import Attempt, attempt
from .catalogue import IN_UNITS, SYSTEMS
from .guesses import disturbed
from .judge import judge
from .memory import solved
from .transcription import Programme, Solved
from .units import CHOICES, in_units

Array = np.ndarray

#: Disturbed guesses of each system, repeats of a timed call and seconds for all of them.
GUESSES, REPEATS, BUDGET = 20, 15, 3.0
#: A cost that is so much above the best passes for as good.
AS_GOOD = 0.01


@dataclasses.dataclass(frozen=True)
class Default:
    """`plan(problem, variance_weight=0)` beside IPOPT from the same guess.

    Attributes:
        name: of the system.
        ours: the fastest of the repeats.
        theirs: IPOPT's answer, its time the fastest of the repeats.
        optimum: the cost in the catalogue.
    """

    name: str
    ours: Attempt
    theirs: Solved
    optimum: float

    @property
    def excess(self) -> float:
        """Our cost above IPOPT's, in parts of it."""
        return _excess(self.ours.judged.cost, self.theirs.cost)

    @property
    def good(self) -> bool:
        """Whether it is solved, certified and within 1 % of IPOPT's."""
        return self.ours.solved and self.ours.certified and self.excess <= AS_GOOD

    def row(self) -> dict[str, Any]:
        """A row of the table."""
        ours, theirs = self.ours, self.theirs
        faster = theirs.seconds / ours.seconds if ours.solved else float("nan")
        return {
            "system": self.name,
            "status": ours.status,
            "certified": _yes(ours.certified),
            "iterations": ours.iterations,
            "cost": f"{ours.judged.cost:.6g}",
            "cost/IPOPT − 1": f"{self.excess:+.1e}",
            "miss": f"{max(ours.judged.terminal, ours.judged.defect):.0e}",
            "ms": f"{1e3 * ours.seconds:.2f}",
            "IPOPT": f"{theirs.cost:.6g}" if theirs.converged else theirs.status,
            "IPOPT's iterations": theirs.iterations,
            "IPOPT's ms": f"{1e3 * theirs.seconds:.2f}",
            "times faster": f"{faster:.2f}",
            "good": _yes(self.good),
        }


def default(names: Sequence[str], folder: Path | None) -> Iterator[Default]:
    """Each system by the default call; IPOPT's answers from a folder, or anew if it is None."""
    for name in names:
        system = SYSTEMS[name]
        problem, programme = system.make(), Programme(system.make())
        ours = attempt(problem)
        spent, repeats = ours.seconds, 1
        while repeats < REPEATS and spent < BUDGET and ours.ok:
            again = attempt(problem)
            spent, repeats = spent + again.seconds, repeats + 1
            if again.seconds < ours.seconds:
                ours = again
        if folder is not None:
            theirs = solved(programme, None, folder)
        else:
            theirs = min((programme.solve() for _ in range(repeats)), key=lambda s: s.seconds)
        yield Default(name, ours, theirs, system.optimum)


@dataclasses.dataclass(frozen=True)
class Disturbed:
    """One system from disturbed guesses: an entry for each.

    Attributes:
        name: of the system.
        ours: what `plan` made of them.
        theirs: what IPOPT made of them.
        costs: IPOPT's, as judged; infinite where it did not converge.
        best: the least cost seen, from whichever guess.
    """

    name: str
    ours: list[Attempt]
    theirs: list[Solved]
    costs: Array
    best: float

    def row(self) -> dict[str, Any]:
        """A row of the table."""
        own = np.array([a.judged.cost if a.solved else np.inf for a in self.ours])
        limit = self.best + AS_GOOD * abs(self.best)
        failed = [i for i, a in enumerate(self.ours) if not a.solved]
        others = sorted({a.status for a in self.ours} - {"CONVERGED"})
        return {
            "system": self.name,
            "guesses": len(own),
            "converged": int(np.isfinite(own).sum()),
            "certified": sum(a.solved and a.certified for a in self.ours),
            "within 1 %": int((own <= limit).sum()),
            "IPOPT converged": int(np.isfinite(self.costs).sum()),
            "IPOPT within 1 %": int((self.costs <= limit).sum()),
            "best": f"{self.best:.6g}",
            "iterations": f"{np.median([a.iterations for a in self.ours]):.0f}",
            "IPOPT's": f"{np.median([s.iterations for s in self.theirs]):.0f}",
            "median ms": f"{1e3 * np.median([a.seconds for a in self.ours]):.2f}",
            "worst ms": f"{1e3 * np.max([a.seconds for a in self.ours]):.0f}",
            "IPOPT's median ms": f"{1e3 * np.median([s.seconds for s in self.theirs]):.2f}",
            "failed": ", ".join(map(str, failed)),
            "how": ", ".join(others),
        }


def guesses(
    names: Sequence[str], folder: Path, count: int = GUESSES, *, own: bool = False
) -> Iterator[Disturbed]:
    """Each system from so many disturbed guesses, those of seeds 0 to count − 1.

    Args:
        names: systems.
        folder: of IPOPT's answers.
        count: guesses.
        own: as the problem's own `initial_guess`; else as `guess=`, and nothing beside it.
    """
    for name in names:
        problem = SYSTEMS[name].make()
        programme = Programme(problem)
        first = solved(programme, None, folder)
        costs, ours, theirs = [], [], []
        for seed in range(count):
            x, u = disturbed(problem, (first.states, first.controls), seed)
            theirs.append(answer := solved(programme, (x, u), folder))
            told = judge(problem, answer.states, answer.controls)
            costs.append(told.cost if answer.converged and told.feasible else np.inf)
            if own:
                problem.initial_guess = lambda x=x, u=u: (x.copy(), u.copy())
                ours.append(attempt(problem))
                del problem.initial_guess
            else:
                ours.append(attempt(problem, guess=(x, u), cold_start="never"))
        reached = [a.judged.cost for a in ours if a.solved]
        yield Disturbed(name, ours, theirs, np.array(costs), min([first.cost, *costs, *reached]))


@dataclasses.dataclass(frozen=True)
class Converted:
    """A plan in other units, converted back, beside the plan in the original ones.

    Attributes:
        name: of the system.
        units: their name.
        original: the plan as the system is written.
        other: the plan in other units.
        cost: its cost, converted back.
        states: largest difference of a component, in parts of its largest value.
        controls: the same of controls.
    """

    name: str
    units: str
    original: Attempt
    other: Attempt
    cost: float
    states: float
    controls: float

    def row(self) -> dict[str, Any]:
        """A row of the table."""
        first, other = self.original, self.other
        excess = _excess(self.cost, first.judged.cost)
        alike = first.status == other.status and first.iterations == other.iterations
        worst = max(abs(excess), self.states, self.controls)
        return {
            "system": self.name,
            "units": self.units,
            "status": first.status,
            "status there": other.status,
            "iterations": first.iterations,
            "iterations there": other.iterations,
            "certified there": _yes(other.certified),
            "cost": f"{first.judged.cost:.6g}",
            "cost − 1": f"{excess:+.1e}",
            "states": f"{self.states:.0e}",
            "controls": f"{self.controls:.0e}",
            "same": _yes(alike and worst <= 1e-9),
        }


def units(names: Sequence[str]) -> Iterator[Converted]:
    """Systems in each choice of units."""
    for name in names:
        system = SYSTEMS[name]
        problem = system.make()
        original = attempt(problem)
        for choice in CHOICES:
            converted = in_units(problem, system.dimensions, choice)
            other = attempt(converted)
            differences = (np.nan, np.nan)
            if original.plan is not None and other.plan is not None:
                back = converted.original(other.plan.mean, other.plan.controls)
                own = original.plan.mean, original.plan.controls
                differences = tuple(_difference(a, b) for a, b in zip(back, own, strict=True))
            cost = other.judged.cost / choice.cost
            yield Converted(name, choice.name, original, other, cost, *differences)


def _difference(other: Array, own: Array) -> float:
    """The largest |difference|, in parts of the largest value of its column."""
    size = np.abs(own).max(axis=0)
    size = np.maximum(size, 1e-6 * size.max())
    return float(np.max(np.abs(other - own).max(axis=0) / np.where(size > 0.0, size, 1.0)))


def _excess(cost: float, reference: float) -> float:
    return (cost - reference) / abs(reference)


def _yes(true: bool) -> str:
    return "yes" if true else "no"


def chosen(names: Sequence[str], measurement: str) -> list[str]:
    """The systems asked for, by beginnings of their names; all of a measurement's if none are.

    Raises:
        ValueError: for a name that no system's begins with.
    """
    if not names:
        return list(IN_UNITS if measurement == "units" else SYSTEMS)
    found = {n: [s for s in SYSTEMS if s.lower().startswith(n.lower())] for n in names}
    for name, systems in found.items():
        if not systems:
            raise ValueError(f"no system is called {name}: there are {', '.join(SYSTEMS)}")
    return [name for name, found in found.items() for name in found]

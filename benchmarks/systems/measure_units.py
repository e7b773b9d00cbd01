"""Other units: the same problem in mm, km, kN, µs and another unit of cost, and the plan back."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .attempts import Attempt, attempt
from .catalogue import SYSTEMS
from .judge import excess
from .table import yes
from .units import CHOICES, InUnits, in_units

Array = np.ndarray

#: Relative difference of a plan that counts as none.
SAME = 1e-9


@dataclasses.dataclass(frozen=True)
class Converted:
    """A plan in other units beside the plan in the original ones.

    Attributes:
        name: of the system.
        units: their name.
        original: the plan as the system is written.
        other: the plan in other units.
        cost: difference of its cost, converted back, in parts of the original's.
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

    @property
    def same(self) -> bool:
        """Whether nothing but rounding differs."""
        first, other = self.original, self.other
        alike = first.status == other.status and first.iterations == other.iterations
        return alike and max(abs(self.cost), self.states, self.controls) <= SAME

    def row(self) -> dict[str, Any]:
        """A row of the table."""
        first, other = self.original, self.other
        return {
            "system": self.name,
            "units": self.units,
            "status": first.status,
            "there": other.status,
            "iterations": first.iterations,
            "iterations there": other.iterations,
            "certified there": yes(other.certified),
            "original cost": f"{first.judged.cost:.6g}",
            "cost − 1": f"{self.cost:+.1e}",
            "states": f"{self.states:.0e}",
            "controls": f"{self.controls:.0e}",
            "same": yes(self.same),
        }


def measure(names: Sequence[str]) -> Iterator[Converted]:
    """Systems in each choice of units."""
    for name in names:
        problem, dimensions = SYSTEMS[name].make(), SYSTEMS[name].dimensions
        original = attempt(problem)
        for choice in CHOICES:
            converted = in_units(problem, dimensions, choice)
            other = attempt(converted)
            cost = excess(other.judged.cost / choice.cost, original.judged.cost)
            states, controls = _differences(converted, original, other)
            yield Converted(name, choice.name, original, other, cost, states, controls)


def _differences(converted: InUnits, original: Attempt, other: Attempt) -> tuple[float, float]:
    """Of states and controls; infinite where there is no plan."""
    if original.plan is None or other.plan is None:
        return np.inf, np.inf
    x, u = converted.original(other.plan.mean, other.plan.controls)
    return _difference(x, original.plan.mean), _difference(u, original.plan.controls)


def _difference(other: Array, own: Array) -> float:
    """The largest |difference|, in parts of the largest value of its column.

    A column that stays at zero but for rounding is measured by the others.
    """
    size = np.abs(own).max(axis=0)
    size = np.maximum(size, 1e-6 * size.max())
    difference = np.abs(other - own).max(axis=0) / np.where(size > 0.0, size, 1.0)
    return float(np.nan_to_num(difference.max(), nan=np.inf))


def summary(found: Sequence[Converted]) -> list[str]:
    """What the rows amount to."""
    same = sum(f.same for f in found)
    return [f"the same iterations and plan to {SAME:.0e}: {same} of {len(found)}"]

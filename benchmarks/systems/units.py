"""The same problem in other units: states, controls, time and cost multiplied by numbers.

With x' = X x, u' = U u, t' = T t and cost' = C cost, componentwise:

    b' = X b / T,   σ' = X σ / √T,   R' = C R / (U Uᵀ T),   H' = C H / T,   ℓ' = C ℓ / (U T),
    c' = P c,   w' = C w / (P² T),   g' = G g
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Units:
    """How many of the new units one old one is: 1000 for metres in millimetres.

    Attributes:
        name: for people.
        length: of what has length (or whatever "m" stands for in a system).
        control: of every control, beside its length and time.
        time: of time.
        cost: of the cost.
    """

    name: str
    length: float = 1.0
    control: float = 1.0
    time: float = 1.0
    cost: float = 1.0


MILLIMETRES = Units("mm", length=1e3)
CHOICES = (
    MILLIMETRES,
    Units("km", length=1e-3),
    Units("kN", control=1e-3),
    Units("µs", time=1e6),
    Units("cost × 1e4", cost=1e4),
)

#: Powers of length and time in a unit. "N" is any unit of its own.
_POWERS = {
    "1": (0, 0), "N": (0, 0), "N/s": (0, -1), "m": (1, 0), "m2": (2, 0), "m/s": (1, -1),
    "m/s2": (1, -2), "1/s": (0, -1), "1/s2": (0, -2),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Dimensions:
    """Units of a problem's numbers, a word each: of states, controls, penalties, terminal rows."""

    states: str
    controls: str
    rows: str
    terminal: str


@dataclasses.dataclass(frozen=True)
class Factors:
    """What numbers are multiplied by: states (n,), controls (m,), rows (p,), terminal (q,)."""

    states: Array
    controls: Array
    rows: Array
    terminal: Array
    time: float
    cost: float


def factors(dimensions: Dimensions, units: Units) -> Factors:
    """Of a problem with these dimensions in these units."""

    def of(words: str) -> Array:
        powers = [_POWERS[word] for word in words.split()]
        return np.array([units.length**a * units.time**b for a, b in powers])

    return Factors(
        states=of(dimensions.states),
        controls=units.control * of(dimensions.controls),
        rows=of(dimensions.rows),
        terminal=of(dimensions.terminal),
        time=units.time,
        cost=units.cost,
    )


def in_units(problem: Any, dimensions: Dimensions, units: Units) -> InUnits:
    """The problem as its user would have written it in other units."""
    return InUnits(problem, factors(dimensions, units))


class InUnits:
    """A problem in other units; what the original lacks, it lacks.

    Args:
        problem: the original.
        by: what its numbers are multiplied by.
    """

    def __init__(self, problem: Any, by: Factors) -> None:
        self.problem, self.by = problem, by
        self.start = by.states * problem.start
        self.times = by.time * problem.times
        per_time = by.cost / by.time
        self.control_weight = per_time * problem.control_weight / np.outer(by.controls, by.controls)
        if hasattr(problem, "control_bounds"):
            self.control_bounds = by.controls * problem.control_bounds
        if hasattr(problem, "control_radius"):  # of controls of one unit
            self.control_radius = float(by.controls[0]) * problem.control_radius
        if hasattr(problem, "penalty"):
            self.penalty_weight = per_time * problem.penalty_weight / by.rows**2
            self.penalty = lambda t, x: by.rows * problem.penalty(*self._old(t, x))
        if hasattr(problem, "state_cost"):
            self.state_cost = lambda t, x: per_time * problem.state_cost(*self._old(t, x))
        if hasattr(problem, "control_cost"):
            ell = per_time / by.controls
            self.control_cost = lambda t, x: ell * problem.control_cost(*self._old(t, x))
        if hasattr(problem, "constraint"):  # positive or not: its units do not matter
            self.constraint = lambda t, x: problem.constraint(*self._old(t, x))
        if hasattr(problem, "terminal_weight"):
            self.terminal_weight = by.cost * problem.terminal_weight / by.terminal**2
        if hasattr(problem, "initial_guess"):
            self.initial_guess = lambda: self.converted(*problem.initial_guess())
        if hasattr(problem, "angles"):
            self.angles = problem.angles

    def drift(self, t: Any, x: Array, u: Array) -> Array:
        b = self.problem.drift(*self._old(t, x), u / self.by.controls)
        return self.by.states / self.by.time * b

    def diffusion(self, t: Any, x: Array) -> Array:
        sigma = self.problem.diffusion(*self._old(t, x))
        return self.by.states[:, None] / np.sqrt(self.by.time) * sigma

    def terminal(self, x: Array) -> Array:
        return self.by.terminal * self.problem.terminal(x / self.by.states)

    def converted(self, x: Array, u: Array) -> tuple[Array, Array]:
        """States and controls of the original, in these units."""
        return self.by.states * x, self.by.controls * u

    def original(self, x: Array, u: Array) -> tuple[Array, Array]:
        """The inverse of `converted`."""
        return x / self.by.states, u / self.by.controls

    def _old(self, t: Any, x: Array) -> tuple[Any, Array]:
        return t / self.by.time, x / self.by.states

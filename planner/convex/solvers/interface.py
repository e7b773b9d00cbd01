"""What a solver of sub-problems takes and returns."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from slipcar.planner.convex.subproblem import Subproblem

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Solution:
    """A sub-problem's solution, or the typed failure to find one.

    Attributes:
        found: whether the arrays below solve the sub-problem to the solver's tolerance.
        d: deviations of nodes 1..K, (K, n).
        e: control deviations, (K, m).
        adjoint: λ_1..λ_K, multipliers of the dynamics, (K, n): gradient of the cost to go.
        terminal: ν, multiplier of the terminal condition, (q,), |ν| ≤ ρ.
        objective: value of the sub-problem.
        iterations: LQ solves (structured) or iterations of the package.
        message: the package's own words when not found.
    """

    found: bool
    d: Array
    e: Array
    adjoint: Array
    terminal: Array
    objective: float
    iterations: int
    message: str = ""


class Solver(Protocol):
    """Solves a sequence of sub-problems of one shape."""

    def solve(self, sub: Subproblem) -> Solution:
        """Solve one; a solver may start from what it found last."""
        ...


def failed(sub: Subproblem, iterations: int, message: str) -> Solution:
    """A `Solution` that was not found: zero deviations, infinite objective."""
    d, e, terminal = (np.zeros(like.shape) for like in (sub.f, sub.r, sub.g))
    return Solution(False, d, e, d, terminal, np.inf, iterations, message)

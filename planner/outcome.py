"""Where an iteration ended, whichever way it went there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from slipcar.planner.history import Iteration
from slipcar.planner.status import Status

Array = np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """The last iterate and its multipliers.

    Attributes:
        status: how it ended.
        x: states, (N, n).
        u: controls, (K, m).
        A: ∂x⁺/∂x there, (K, n, n).
        B: ∂x⁺/∂u, (K, n, m).
        covariance: Σ, (N, n, n).
        effort: Σ dt uᵀRu.
        penalty: Σ dt Σ w max(0, c)².
        running: Σ dt (H + ℓᵀu).
        adjoint: λ_1..λ_K of the last accepted step, (K, n).
        terminal: ν, (q,).
        trust_multiplier: −p¹ of it.
        iterations: sub-problems solved.
        history: each of them; empty where it was not kept.
        objective: effort, penalty, running cost and w ∫ tr Σ dt.
        message: what is lacking when infeasible; the solver's own words when it failed.
    """

    status: Status
    x: Array
    u: Array
    A: Array
    B: Array
    covariance: Array
    effort: float
    penalty: float
    running: float
    adjoint: Array
    terminal: Array
    trust_multiplier: float
    iterations: int
    history: Sequence[Iteration]
    objective: float
    message: str = ""

    def said(self, words: str) -> Outcome:
        """The same with more to say."""
        message = f"{self.message}; {words}" if self.message else words
        return dataclasses.replace(self, message=message)

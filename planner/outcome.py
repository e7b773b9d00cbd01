"""Where an iteration ended, whichever way it went there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from slipcar.planner.history import Iteration
from slipcar.planner.moments import covariance as moments
from slipcar.planner.problem.linearization import Linearization
from slipcar.planner.problem.model import Model
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

    @classmethod
    def at(
        cls,
        lin: Linearization,
        model: Model,
        variance_weight: float,
        *,
        status: Status,
        adjoint: Array,
        terminal: Array,
        history: Sequence[Iteration],
        trust_multiplier: float = 0.0,
        message: str = "",
    ) -> Outcome:
        """What is known where an iteration ended, from its linearisation there."""
        S = moments.covariance_of(model, lin)
        variance = variance_weight * moments.trace_integral(S, model.dt)
        return cls(
            status=status,
            x=lin.x,
            u=lin.u,
            A=lin.A,
            B=lin.B,
            covariance=S,
            effort=lin.effort,
            penalty=lin.penalty,
            running=lin.running,
            adjoint=adjoint,
            terminal=terminal,
            trust_multiplier=trust_multiplier,
            iterations=len(history),
            history=history,
            objective=lin.effort + lin.penalty + lin.running + variance,
            message=message,
        )

    def said(self, words: str) -> Outcome:
        """The same with more to say."""
        message = f"{self.message}; {words}" if self.message else words
        return dataclasses.replace(self, message=message)

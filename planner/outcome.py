"""Where an iteration ended, whichever way it went there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from slipcar.planner.moments import covariance as moments
from slipcar.planner.problem.linearization import Linearization
from slipcar.planner.problem.model import Model
from slipcar.planner.records import Iteration
from slipcar.planner.status import Status

Array = np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """The last iterate and its multipliers; what is not described is as in a plan."""

    status: Status
    x: Array  #: mean, (N, n)
    u: Array  #: controls, (K, m)
    A: Array
    B: Array
    covariance: Array
    effort: float
    penalty: float  #: a plan's obstacle_cost
    running: float  #: a plan's running_cost
    adjoint: Array  #: λ_1..λ_K of the last accepted step, (K, n)
    terminal: Array  #: ν, (q,)
    trust_multiplier: float  #: −p¹ of that step
    iterations: int
    history: Sequence[Iteration]  #: empty where it was not kept
    objective: float  #: effort, penalty, running cost and w ∫ tr Σ dt
    message: str = ""
    answered: bool = False  #: whether its adjoint is bounded by feedback alone, as of what explodes

    @classmethod
    def at(
        cls,
        lin: Linearization,
        model: Model,
        variance_weight: float,
        *,
        history: Sequence[Iteration],
        trust_multiplier: float = 0.0,
        **others: Any,
    ) -> Outcome:
        """What is known from a linearisation; `others`: status, adjoint, terminal, message."""
        S = moments.covariance_of(model, lin)
        names = ("x", "u", "A", "B", "effort", "penalty", "running")
        return cls(
            **{name: getattr(lin, name) for name in names},
            covariance=S,
            trust_multiplier=trust_multiplier,
            iterations=len(history),
            history=history,
            objective=lin.effort + lin.penalty + lin.running
            + variance_weight * moments.trace_integral(S, model.dt),
            **others,
        )  # fmt: skip

    def said(self, words: str) -> Outcome:
        """The same with more to say."""
        message = f"{self.message}; {words}" if self.message else words
        return dataclasses.replace(self, message=message)

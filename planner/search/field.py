"""Several ways to go, one expected cost: at each price of risk the best of them.

The cheapest way round the obstacles may be the riskiest, so plans of the mean that differ are all
steered, each warm from its own answer at the nearest price; those that fall behind are dropped.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from slipcar.planner.expected import loop
from slipcar.planner.expected.engine import engine
from slipcar.planner.expected.guarded import Posed
from slipcar.planner.expected.loop import Steered
from slipcar.planner.moments.belief import feedback_effort, loss_at
from slipcar.planner.moments.covariance import trace_integral
from slipcar.planner.moments.losses import loss
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.options import Options
from slipcar.planner.problem.model import Model
from slipcar.planner.records import ExpectedCost

Array = np.ndarray

#: So many candidates stay after the first price, at most, and none so many times as dear as the
#: best. Where risk is free, the best way may be straight through: there this many times.
_KEPT, _BEHIND, _FREE = 3, 2.0, 3.0


def priced(stakes: Stakes, price: float) -> Stakes:
    """With constraints at this price."""
    weight = np.where(stakes.tail, price, stakes.weight)
    return dataclasses.replace(stakes, weight=weight)


def expected_cost(model: Model, stakes: Stakes, found: Steered) -> ExpectedCost:
    """What a plan costs in expectation, and the risk predicted for it."""
    from scipy.special import ndtr

    rows = loss(found.c, found.s, np.ones_like(found.c), stakes.tail).value
    tails = ndtr(found.c / found.s)
    penalties = model.dt[:, None] * np.where(stakes.tail, 0.0, stakes.weight) * rows
    g, G = np.asarray(model.terminal(found.x[-1])), np.asarray(model.terminal_jacobian(found.x[-1]))
    spread = np.einsum("qi,ij,qj->q", G, found.covariance[-1], G)
    running = found.running
    if model.state_cost is not None and model.state_cost_derivatives is not None:
        hessian = model.state_cost_derivatives(model.times[1:], found.x[1:])[1]
        running += 0.5 * float(np.einsum("k,kij,kij", model.dt, hessian, found.covariance[1:]))
    return ExpectedCost(
        effort=found.effort,
        feedback=feedback_effort(model, found.gains, found.covariance),
        running=running,
        penalty=float(penalties.sum()),
        goal=float(np.dot(stakes.terminal, g * g + spread)),
        risk=min(1.0, float(tails[:, stakes.tail].sum())),
    )


def value(model: Model, stakes: Stakes, found: Steered) -> float:
    """Everything that is charged: expected cost, w ∫ tr Σ dt and the risk at its price."""
    cost = expected_cost(model, stakes, found)
    rows = loss_at(model, stakes, found.c, found.s).value[:, stakes.tail]
    spread = stakes.variance_weight * trace_integral(found.covariance, model.dt)
    return cost.total + float(rows.sum()) + spread


class Field:
    """Candidates and what became of them, price by price.

    Args:
        ready: the problem.
        options: of the iteration.
        stakes: what is charged, constraints at price zero.
        guesses: means (N, n) and controls (K, m), the most promising first.

    Attributes:
        steps: Newton steps so far.
        attempt: the last answer to the first guess, whether or not it converged.
    """

    attempt: Steered

    def __init__(
        self, ready: Posed, options: Options, stakes: Stakes, guesses: Sequence[tuple[Array, Array]]
    ) -> None:
        self.steps = 0
        self._model, self._stakes, self._options = ready.model, stakes, options
        self._guesses = list(guesses)
        self._known: list[list[tuple[float, Steered]]] = [[] for _ in guesses]
        self._alive = list(range(len(self._guesses)))
        self._origin: dict[int, int] = {}
        self._functions, run = engine(ready, *self._guesses[0], compiled=options.compiled)
        self._iterate: Any = loop.iterate if run is None else run.iterate

    def solve(self, price: float) -> Steered | None:
        """The best converged plan at a price, or None."""
        stakes = priced(self._stakes, price)
        worth: dict[int, tuple[float, Steered]] = {}
        for i in self._alive:
            found = self._one(i, price, stakes)
            if found.status.ok:
                self._known[i].append((price, found))
                self._origin[id(found)] = i  # it stays alive, in the line above
                worth[i] = (value(self._model, stakes, found), found)
        order = sorted(worth, key=lambda i: worth[i][0])
        if not order:
            return None
        best = worth[order[0]][0]
        # One that fails, warm and cold, while another does not, is not tried again either.
        behind, kept = (_BEHIND, _KEPT) if price > 0.0 else (_FREE, len(order))
        near = [i for i in order if worth[i][0] <= best + (behind - 1.0) * abs(best)]
        self._alive = near[:kept]
        return worth[order[0]][1]

    def origin(self, found: Steered) -> int:
        """Which guess an answer comes from."""
        return self._origin.get(id(found), 0)

    def _one(self, i: int, price: float, stakes: Stakes) -> Steered:
        """Candidate i, warm from its nearest price; if that fails, from its guess."""
        warm = min(
            self._known[i], key=lambda known: abs(math.log((known[0] + 1e-9) / (price + 1e-9))),
            default=None,
        )  # fmt: skip
        found = self._run(i, stakes, None if warm is None else warm[1])
        if not found.status.ok and warm is not None:
            found = self._run(i, stakes, None)
        return found

    def _run(self, i: int, stakes: Stakes, warm: Steered | None) -> Steered:
        x, u = self._guesses[i] if warm is None else (warm.x, warm.u)
        found: Steered = self._iterate(
            self._model, self._functions, stakes, x, u, tolerance=self._options.tolerance,
            max_iterations=self._options.max_iterations, warm=warm,
        )  # fmt: skip
        self.steps += found.iterations
        if i == 0 or not hasattr(self, "attempt"):
            self.attempt = found
        return found

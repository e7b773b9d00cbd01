"""Several ways to go, one expected cost: at each price of risk the best of them.

The cheapest way round the obstacles may be the riskiest, so plans of the mean that differ are all
steered, each warm from its own answer at the nearest price; those that fall behind are dropped.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence

import numpy as np

from slipcar.planner.moments.covariance import trace_integral
from slipcar.planner.moments.gains import feedback_effort
from slipcar.planner.moments.losses import loss, normal_cdf
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.posing import Posed, pose
from slipcar.planner.newton.running import Steered, solve_noise
from slipcar.planner.options import Options
from slipcar.planner.problem.model import Model
from slipcar.planner.records import ExpectedCost

Array = np.ndarray

#: So many candidates stay after the first price, at most, and none so many times as dear as the
#: best. Where risk is free, the best way may be straight through: there this many times.
_KEPT, _BEHIND, _FREE = 3, 2.0, 3.0


def expected_cost(model: Model, stakes: Stakes, plan: Steered, risk: float = 0.0) -> ExpectedCost:
    """What a plan costs in expectation; `risk` is what is predicted for it."""
    p = len(stakes.penalties)
    weight = model.dt[:, None] * stakes.penalties
    penalties = loss(plan.c[:, :p], plan.s[:, :p], weight, np.zeros(p, dtype=bool)).value
    spread = np.einsum("qi,ij,qj->q", plan.G, plan.covariance[-1], plan.G)
    running = plan.running
    if model.state_cost is not None:
        hessian = model.state_cost_derivatives(model.times[1:], plan.x[1:])[1]
        running += 0.5 * float(np.einsum("k,kij,kij", model.dt, hessian, plan.covariance[1:]))
    return ExpectedCost(
        effort=plan.effort,
        feedback=feedback_effort(model.R, model.dt, plan.gains, plan.covariance),
        running=running,
        penalty=float(penalties.sum()),
        goal=float(np.dot(stakes.terminal, plan.g**2 + spread)),
        risk=risk,
    )


def charged(model: Model, stakes: Stakes, plan: Steered) -> float:
    """Everything that is charged: expected cost, w ∫ tr Σ dt and the risk at its price."""
    value = expected_cost(model, stakes, plan).total
    if stakes.tails:
        c, s = plan.c[:, -stakes.tails :], plan.s[:, -stakes.tails :]
        value += float(
            loss(c, s, np.full(c.shape, stakes.price), np.ones(c.shape[1], bool)).value.sum()
        )
    return value + stakes.variance_weight * trace_integral(plan.covariance, model.dt)


class Field:
    """Candidates and what became of them, price by price.

    Args:
        model: the problem.
        options: of the iteration.
        stakes: what is charged.
        guesses: means (N, n) and controls (K, m), the most promising first.

    Attributes:
        steps: Newton steps so far.
        attempt: the last answer to the first guess, whether or not it converged.
    """

    attempt: Steered

    def __init__(
        self, model: Model, options: Options, stakes: Stakes, guesses: Sequence[tuple[Array, Array]]
    ) -> None:
        self.steps = 0
        self._model, self._stakes, self._options = model, stakes, options
        self._guesses = list(guesses)
        self._answers: list[list[tuple[float, Steered]]] = [[] for _ in guesses]
        self._alive = list(range(len(self._guesses)))
        self._origin: dict[int, int] = {}

    @functools.cached_property
    def guarded(self) -> Posed:
        """The problem with its constraints as rows."""
        return pose(self._model, constraints=True, compiled=self._options.compiled)

    @functools.cached_property
    def free(self) -> Posed:
        """The problem with its penalties alone as rows."""
        return pose(self._model, compiled=self._options.compiled)

    def solve(self, price: float) -> Steered | None:
        """The best converged plan at a price, or None."""
        stakes = self._stakes.at_price(price)
        worth: dict[int, tuple[float, Steered]] = {}
        for i in self._alive:
            plan = self._one(i, price, stakes)
            if plan.status.ok:
                self._answers[i].append((price, plan))
                self._origin[id(plan)] = i  # it stays alive, in the line above
                worth[i] = (charged(self._model, stakes, plan), plan)
        order = sorted(worth, key=lambda i: worth[i][0])
        if not order:
            return None
        best = worth[order[0]][0]
        # One that fails, warm and cold, while another does not, is not tried again either.
        behind, kept = (_BEHIND, _KEPT) if price > 0.0 else (_FREE, len(order))
        near = [i for i in order if worth[i][0] <= best + (behind - 1.0) * abs(best)]
        self._alive = near[:kept]
        return worth[order[0]][1]

    def origin(self, plan: Steered) -> int:
        """Which guess an answer comes from."""
        return self._origin.get(id(plan), 0)

    def cost(self, plan: Steered) -> ExpectedCost:
        """What a plan costs in expectation, with the risk predicted for it."""
        return expected_cost(self._model, self._stakes, plan, self.predicted_risk(plan))

    def predicted_risk(self, plan: Steered) -> float:
        """Σ Φ(h/s) over nodes and constraints, at most 1: Boole's bound."""
        if not self._stakes.constraints:
            return 0.0
        tails = self._stakes.constraints
        if plan.c.shape[1] == tails + len(self._stakes.penalties):
            c, s = plan.c[:, -tails:], plan.s[:, -tails:]
        else:
            c, s = self.guarded.row_moments(plan.x, plan.covariance)
            c, s = c[:, -tails:], s[:, -tails:]
        return min(1.0, float(normal_cdf(c / s).sum()))

    def _one(self, i: int, price: float, stakes: Stakes) -> Steered:
        """Candidate i, warm from its nearest price; if that fails, from its guess."""
        warm = min(
            self._answers[i],
            key=lambda known: abs(math.log((known[0] + 1e-9) / (price + 1e-9))),
            default=None,
        )
        plan = self._run(i, stakes, None if warm is None else warm[1])
        if not plan.status.ok and warm is not None:
            plan = self._run(i, stakes, None)
        return plan

    def _run(self, i: int, stakes: Stakes, warm: Steered | None) -> Steered:
        x, u = self._guesses[i] if warm is None else (warm.x, warm.u)
        plan = solve_noise(
            self.guarded if stakes.priced else self.free, stakes, x, u,
            tolerance=self._options.tolerance, max_iterations=self._options.max_iterations,
            warm=None if warm is None else _with_rows(warm, len(stakes.weight)),
        )  # fmt: skip
        self.steps += plan.iterations
        if i == 0 or not hasattr(self, "attempt"):
            self.attempt = plan
        return plan


def _with_rows(plan: Steered, rows: int) -> Steered:
    """The plan with weights of so many rows: those that it does not know weigh nothing."""
    K, known = plan.eta.shape
    if known == rows:
        return plan
    eta = np.zeros((K, rows))
    eta[:, : min(known, rows)] = plan.eta[:, : min(known, rows)]
    return dataclasses.replace(plan, eta=eta)

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
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.model import Model
from slipcar.planner.records import ExpectedCost

Array = np.ndarray

#: So many candidates stay after the first price, at most, and none so many times as dear as the
#: best. Where risk is free, the best way may be straight through: there this many times.
_KEPT, _BEHIND, _FREE = 3, 2.0, 3.0


def expected_cost(
    model: Model, stakes: Stakes, plan: Steered, risk: float = 0.0, clipped: float = 0.0
) -> ExpectedCost:
    """What a plan costs in expectation; `risk` and `clipped` are what is predicted for it."""
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
        clipped=clipped,
    )


def clipped_part(model: Model, plan: Steered) -> float:
    """Part of the K m controls that u + K (x − μ), Gaussian, asks for beyond their bounds."""
    variance = np.einsum("kij,kjl,kil->ki", plan.gains, plan.covariance[:-1], plan.gains)
    s = np.sqrt(np.maximum(variance, np.finfo(float).tiny))
    beyond = normal_cdf((model.lower - plan.u) / s) + normal_cdf((plan.u - model.upper) / s)
    return float(np.mean(beyond * (variance > 0.0)))


def charged(model: Model, stakes: Stakes, plan: Steered) -> float:
    """Everything that is charged: expected cost, w ∫ tr Σ dt and the risk at its price."""
    value = expected_cost(model, stakes, plan).total
    if stakes.tails:
        c, s = plan.c[:, -stakes.tails :], plan.s[:, -stakes.tails :]
        price = np.full(c.shape, stakes.price)
        value += float(loss(c, s, price, np.ones(c.shape[1], bool)).value.sum())
    return value + stakes.variance_weight * trace_integral(plan.covariance, model.dt)


class Field:
    """Candidates, plans of the mean with the most promising first, and their answers at each price.

    Attributes:
        steps: Newton steps so far.
        attempt: the last answer of the first candidate, whether or not it converged.
    """

    attempt: Steered

    def __init__(
        self, model: Model, options: Options, stakes: Stakes, candidates: Sequence[Outcome]
    ) -> None:
        self.steps = 0
        self._model, self._stakes, self._options = model, stakes, options
        self._candidates = candidates
        self._answers: list[list[tuple[float, Steered]]] = [[] for _ in candidates]
        self._alive = list(range(len(candidates)))

    @functools.cached_property
    def guarded(self) -> Posed:
        """The problem with its constraints as rows."""
        return pose(self._model, constraints=True, compiled=self._options.compiled)

    @functools.cached_property
    def _free(self) -> Posed:
        """The problem with its penalties alone as rows."""
        return pose(self._model, compiled=self._options.compiled)

    def solve(self, price: float) -> Steered | None:
        """The best converged plan at a price, or None."""
        stakes = self._stakes.at_price(price)
        worth: list[tuple[float, int, Steered]] = []
        for i in self._alive:
            plan = self._steered(i, price, stakes)
            if plan.status.ok:
                self._answers[i].append((price, plan))
                worth.append((charged(self._model, stakes, plan), i, plan))
        if not worth:
            return None
        worth.sort(key=lambda row: row[0])
        least, _, best = worth[0]
        # One that fails, warm and cold, while another does not, is not tried again either.
        behind, kept = (_BEHIND, _KEPT) if price > 0.0 else (_FREE, len(worth))
        limit = least + (behind - 1.0) * abs(least)
        self._alive = [i for cost, i, _ in worth if cost <= limit][:kept]
        return best

    def origin(self, plan: Steered) -> int:
        """Which candidate an answer comes from."""
        known = ((i, other) for i, answers in enumerate(self._answers) for _, other in answers)
        return next((i for i, other in known if other is plan), 0)

    def cost(self, plan: Steered) -> ExpectedCost:
        """What a plan costs in expectation, with the risk predicted for it."""
        return expected_cost(
            self._model, self._stakes, plan,
            risk=self.predicted_risk(plan), clipped=clipped_part(self._model, plan),
        )  # fmt: skip

    def predicted_risk(self, plan: Steered) -> float:
        """Σ Φ(h/s) over nodes and constraints, at most 1: Boole's bound."""
        tails = self._stakes.constraints
        if not tails:
            return 0.0
        c, s = plan.c, plan.s
        if c.shape[1] != tails + len(self._stakes.penalties):
            c, s = self.guarded.row_moments(plan.x, plan.covariance)
        return min(1.0, float(normal_cdf(c[:, -tails:] / s[:, -tails:]).sum()))

    def _steered(self, i: int, price: float, stakes: Stakes) -> Steered:
        """Candidate i, warm from its answer at the nearest price; if that fails, from its guess."""
        known = self._answers[i]
        if known:
            nearest = min(known, key=lambda row: abs(math.log((row[0] + 1e-9) / (price + 1e-9))))
            plan = self._run(i, stakes, nearest[1])
            if plan.status.ok:
                return plan
        return self._run(i, stakes, None)

    def _run(self, i: int, stakes: Stakes, warm: Steered | None) -> Steered:
        start = self._candidates[i] if warm is None else warm
        plan = solve_noise(
            self.guarded if stakes.priced else self._free, stakes, start.x, start.u,
            tolerance=self._options.tolerance, max_iterations=self._options.max_iterations,
            warm=None if warm is None else _with_rows(warm, len(stakes.weight)),
        )  # fmt: skip
        self.steps += plan.iterations
        if i == 0:
            self.attempt = plan
        return plan


def _with_rows(plan: Steered, rows: int) -> Steered:
    """The plan with weights of so many rows: those that it does not know weigh nothing."""
    known = plan.eta[:, :rows]
    unknown = np.zeros((len(known), rows - known.shape[1]))
    return dataclasses.replace(plan, eta=np.hstack([known, unknown]))

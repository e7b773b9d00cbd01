"""From a plan of the mean to one that minimises an expected cost, at a price of risk or a risk.

    minimise  E[ Σ dt (uᵀRu + H + Σ w max(0, c)²) + gᵀWg ] + w ∫ tr Σ dt,   P(constraint) ≤ δ

for Gaussian states (:mod:`slipcar.planner.newton.loop`). The chance constraint is priced: ν times
Boole's bound joins the cost, which allocates the risk over nodes and rows, and ν is searched for
until simulated paths keep δ (:mod:`.price_search`, :mod:`slipcar.planner.moments.monte_carlo`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.running import Steered
from slipcar.planner.options import Options, check_choice, check_count, check_flag, check_number
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.model import Model
from slipcar.planner.records import ExpectedCost
from slipcar.planner.search.counting import Counting
from slipcar.planner.search.field import Field
from slipcar.planner.search.price_search import PriceSearch, search_price
from slipcar.planner.search.risk import PROMISES, PricedRate, Risk, check_risk, wilson_interval
from slipcar.planner.status import Status

Array = np.ndarray

#: What feedback is charged for the spread of g where nothing else is; as `Feedback`'s Qf.
_SPREAD_WEIGHT = 100.0
#: More of the controls clipped than this is said.
_CLIPPED = 0.01
#: Paths that the search for a price looks at: so many violations are expected among them.
_COUNTED, _COUNTED_ON_PATH = 1000, 400
_LEAST_PATHS, _MOST_PATHS = 10_000, 100_000
#: Common random numbers of the search, and those of each verification, which it never saw.
_SEARCH_SEED, _VERIFICATION_SEED = 0x51EE, 0xF5E5
#: Standard deviations of Monte Carlo that the search keeps below δ, and verifications at most.
_CAUTION, _VERIFICATIONS = 1.5, 3
#: How far below its target, relatively, a rate of the search may stay.
_NEAR, _NEAR_ON_PATH = 0.15, 0.08
#: With fewer violations expected among the paths, Boole's bound is searched with instead.
_COUNTABLE = 10
#: Boole's bound overestimates, as nodes are correlated, by less than this.
_BOOLE = 10.0
#: The first price, as a multiple of (cost of the nominal plan) / δ; and the dearest, of the first.
_FIRST, _DEAREST = 0.02, 1e5


@dataclasses.dataclass(frozen=True)
class Request:
    """What is asked for beyond the mean.

    Attributes:
        risk: δ in (0, 1): the probability that a path violates `problem.constraint` must not
            exceed it. The constraint is priced and the price searched for by Monte Carlo
            on common random numbers; `Plan.risk` holds what was predicted and what fresh paths
            say. Where no price leads there: status RISK_UNREACHABLE, with the plan of least risk.
        risk_at: what is promised: `"nodes"`, the paper's definition, at any node of the discretised
            chain with steps of the plan's own integrator; or `"path"`, at any instant of the SDE,
            controls held between nodes. Then the mean is integrated by `integrator="rk4"` unless
            another is asked for, a row of a constraint keeps the distance that paths stray between
            nodes, and paths are simulated in substeps with Brownian bridges between them.
        risk_price: ν ≥ 0: add ν Σ P(violation) over nodes and constraints to the expected cost
            (Boole's bound; optimal risk allocation). No Monte Carlo: milliseconds.
        risk_episodes: fresh paths that verify a risk, ≥ 100.
        feedback: plan u = ū + K (x − μ) with the gains that minimise the expected cost: effort
            of the corrections included, bounds kept at a standard deviation of them.
            `Feedback(plan)` plays it.
        expected: charge the penalties' expectation, E Σ w max(0, c)² for Gaussian states, instead
            of their value at the mean. With any of the above it always is.
        terminal_weight: W ≥ 0, a number or (q,): charge E gᵀWg instead of asking for g(μ) = 0.
            None: exact, or with `feedback` the problem's `terminal_weight`, if it has one; if not,
            exact for the mean, and the spread charged 100 tr Cov g.

    Raises:
        ValueError: for a value out of range, naming it.
    """

    risk: float | None = None
    risk_at: str = "nodes"
    risk_price: float | None = None
    risk_episodes: int = 100_000
    feedback: bool = False
    expected: bool = False
    terminal_weight: Any = None

    def __post_init__(self) -> None:
        if self.risk is not None:
            check_risk(self.risk)
            if self.risk_price is not None:
                raise ValueError(
                    "risk and risk_price exclude each other: risk=δ searches for the price"
                )
        if self.risk_price is not None:
            if isinstance(self.risk_price, (bool, np.bool_)):
                raise ValueError(f"risk_price must be a number >= 0, not {self.risk_price!r}")
            check_number("risk_price", self.risk_price, zero_allowed=True)
        check_choice("risk_at", self.risk_at, PROMISES)
        if self.on_path and self.risk is None and self.risk_price is None:
            raise ValueError("risk_at='path' says what a risk is about: give risk or risk_price")
        check_count("risk_episodes", self.risk_episodes, least=100)
        check_flag("feedback", self.feedback)
        check_flag("expected", self.expected)
        if self.terminal_weight is not None:
            _numbers(self.terminal_weight)
            if not self.wanted:
                raise ValueError(
                    "terminal_weight is of expected costs: it needs feedback, expected, risk or "
                    "risk_price"
                )

    @property
    def on_path(self) -> bool:
        """Whether constraints are to hold between nodes."""
        return self.risk_at == "path"

    @property
    def wanted(self) -> bool:
        """Whether anything is."""
        priced = self.risk is not None or self.risk_price is not None
        return self.feedback or self.expected or priced

    def check(self, options: Options, model: Model) -> None:
        """Raise ValueError for what an expected cost cannot be combined with, or constraints."""
        if options.convex:
            raise ValueError(
                f"risk, feedback and expected cannot be combined with {options.convex}"
            )
        if model.radius < np.inf:
            raise ValueError("risk, feedback and expected know no control_radius: use bounds")
        priced = self.risk is not None or bool(self.risk_price)
        if priced and not model.has("constraint"):
            raise ValueError(
                f"risk needs the problem's constraint(t, x) -> (..., p), violated where > 0; "
                f"{type(model.problem).__name__} has none"
            )
        model.constraint_count()

    def stakes(self, model: Model, variance_weight: float) -> Stakes:
        """What to charge, constraints at price zero.

        Raises:
            ValueError: for a terminal weight of wrong shape or sign.
        """
        q = np.shape(model.terminal(model.start))[-1]
        given = self.terminal_weight
        if given is None and self.feedback:
            given = getattr(model.problem, "terminal_weight", None)
        weight = np.asarray(_SPREAD_WEIGHT if self.feedback else 0.0)
        if given is not None:
            weight = _numbers(given)
        if weight.shape not in ((), (q,)) or not np.isfinite(weight).all() or (weight < 0.0).any():
            raise ValueError(
                f"terminal_weight must be a number or ({q},) numbers, finite and >= 0, "
                f"not {given!r}"
            )
        return Stakes(
            penalties=model.weight,
            constraints=model.constraint_count(),
            price=0.0,
            terminal=np.array(np.broadcast_to(weight, (q,))),
            soft=given is not None,
            feedback=self.feedback,
            variance_weight=variance_weight,
            bridged=self.on_path,
        )


def _numbers(given: Any) -> Array:
    try:
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"terminal_weight must be numbers >= 0, not {given!r}") from error


@dataclasses.dataclass(frozen=True, eq=False)
class Steering:
    """What came of a request."""

    plan: Steered  #: where the iteration ended
    status: Status
    cost: ExpectedCost
    risk: Risk | None
    message: str
    origin: int  #: which of the plans of the mean it started from
    iterations: int  #: Newton steps in all


def steer(
    model: Model, options: Options, request: Request, candidates: Sequence[Outcome]
) -> Steering:
    """Go on from plans of the mean, the best first; which is taken is decided by expected cost."""
    stakes = request.stakes(model, options.variance_weight)
    field = Field(model, options, stakes, candidates)
    if request.risk is not None:
        counting = Counting(model, field.guarded, at_path=request.on_path)
        return _Calibration(float(request.risk), request.risk_episodes, counting, field).run()
    plan = field.solve(request.risk_price or 0.0) or field.attempt
    message = "" if plan.status.ok else "the iteration on the expected cost did not settle"
    return _steering(field, plan, plan.status, message)


def _steering(
    field: Field, plan: Steered, status: Status, message: str, risk: Risk | None = None
) -> Steering:
    cost, origin = field.cost(plan), field.origin(plan)
    if status.ok and cost.clipped > _CLIPPED:
        say = (
            f"the feedback asks for {100.0 * cost.clipped:.2g} % of its controls beyond their "
            "bounds, where they are clipped: the cost is more than is expected"
        )
        message = "; ".join(filter(None, (message, say)))
    return Steering(plan, status, cost, risk, message, origin, field.steps)


class _Calibration:
    """The search for the price at which a risk δ is kept, the plan at that price, and the proof."""

    def __init__(self, delta: float, episodes: int, counting: Counting, field: Field) -> None:
        self._delta, self._episodes, self._counting, self._field = delta, episodes, counting, field
        counted = _COUNTED_ON_PATH if counting.at_path else _COUNTED
        self._paths = int(np.clip(counted / delta, _LEAST_PATHS, _MOST_PATHS))
        self._countable = delta * self._paths >= _COUNTABLE
        noise = np.sqrt(delta * (1.0 - delta) * (1.0 / self._paths + 1.0 / episodes))
        cautious = max(delta - _CAUTION * float(noise), 0.3 * delta)
        self._target = cautious if self._countable else delta
        self._at_nodes = 0.0
        self._tried: list[PricedRate] = []

    def run(self) -> Steering:
        """Search."""
        delta, field = self._delta, self._field
        free = field.solve(0.0)
        # Boole's bound says whether to look.
        if free is not None and field.predicted_risk(free) <= _BOOLE * delta:
            rate = self._measure(free)
            self._tried.append(PricedRate(0.0, field.predicted_risk(free), rate))
            if rate <= self._target:
                self._refine(free)
                if (verified := self._verified(free, 0)) <= delta:
                    return self._answer(free, 0.0, verified, True)
        price = _FIRST * max(abs(field.attempt.effort), 1e-6) / delta
        if (first := field.solve(price)) is not None:
            self._refine(first)
        for attempt in range(_VERIFICATIONS):
            search = self._searched(price)
            plan, price = search.best, search.price
            if plan is None:
                last = field.attempt
                say = f"no plan was found at any price of risk: the last ended {last.status}"
                return _steering(field, last, Status.SOLVER_FAILED, say)
            verified = self._verified(plan, attempt)
            if verified <= delta or not search.reached:
                break
            # Fresh paths disagree with those of the search: ask for less.
            self._target *= 0.9 * delta / verified
        return self._answer(plan, price, verified, search.reached and verified <= delta)

    def _refine(self, plan: Steered) -> None:
        self._counting.refine(plan, self._delta, self._episodes, _SEARCH_SEED)

    def _searched(self, price: float) -> PriceSearch:
        """The search from a price."""
        search = search_price(
            self._field.solve,
            self._measure,
            target=self._target,
            start=price,
            largest=_DEAREST * price,
            tolerance=_NEAR_ON_PATH if self._counting.at_path else _NEAR,
            resolution=1.0 / self._paths if self._countable else 0.0,
        )
        for trial in search.tried:
            predicted = trial.answer and self._field.predicted_risk(trial.answer)
            self._tried.append(PricedRate(trial.price, predicted, trial.rate))
        return search

    def _measure(self, plan: Steered) -> float:
        """The rate on the paths of the search; predicted where they are too few to tell."""
        if self._countable:
            return self._counting.search_rate(plan, self._paths, _SEARCH_SEED, self._target)
        return self._field.predicted_risk(plan)

    def _verified(self, plan: Steered, attempt: int) -> float:
        seed = _VERIFICATION_SEED + attempt
        rate, self._at_nodes = self._counting.rates(plan, self._episodes, seed)
        return rate

    def _successes(self, rate: float) -> float:
        """Violations behind a rate; on the path a sum of probabilities."""
        return rate * self._episodes if self._counting.at_path else round(rate * self._episodes)

    def _answer(self, plan: Steered, price: float, verified: float, kept: bool) -> Steering:
        delta, episodes = self._delta, self._episodes
        risk = Risk(
            requested=delta,
            predicted=self._field.predicted_risk(plan),
            verified=verified,
            interval=wilson_interval(self._successes(verified), episodes),
            episodes=episodes,
            price=price,
            reached=kept,
            tried=tuple(self._tried),
            simulation_time=self._counting.seconds,
            at="path" if self._counting.at_path else "nodes",
            substeps=self._counting.substeps,
            verified_at_nodes=self._at_nodes,
        )
        status, say = plan.status, ""
        if not kept:
            status = Status.RISK_UNREACHABLE
            say = f"P(violation) <= {delta:g} was not reached: the least found is {verified:.4g}"
        elif not self._countable:
            say = f"{self._paths:,} paths cannot tell a risk of {delta:g}: Boole's bound keeps it"
        return _steering(self._field, plan, status, say, risk)

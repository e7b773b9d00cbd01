"""From a plan of the mean to one that minimises an expected cost, at a price of risk or a risk.

    minimise  E[ Σ dt (uᵀRu + H + Σ w max(0, c)²) + gᵀWg ] + w ∫ tr Σ dt,   P(constraint) ≤ δ

for Gaussian states (:mod:`slipcar.planner.newton.loop`). The chance constraint is priced: ν times Boole's
bound joins the cost, which allocates the risk over nodes and rows, and ν is searched for until
simulated paths keep δ (:mod:`.price_search`, :mod:`.monte_carlo`).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from slipcar.planner.moments.gains import wrap
from slipcar.planner.moments.monte_carlo import violations
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.running import Steered
from slipcar.planner.options import Options, check_count, check_number
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.control_set import project_controls
from slipcar.planner.problem.model import Model
from slipcar.planner.records import ExpectedCost
from slipcar.planner.search.field import Field
from slipcar.planner.search.price_search import PriceSearch, search_price
from slipcar.planner.search.risk import PricedRate, Risk, check_risk, wilson_interval
from slipcar.planner.status import Status

Array = np.ndarray

#: What feedback is charged for the spread of g where nothing else is; as `Feedback`'s Qf.
_SPREAD_WEIGHT = 100.0
#: Paths that the search for a price looks at: so many violations are expected among them.
_COUNTED = 1000
_LEAST_PATHS, _MOST_PATHS = 10_000, 100_000
#: Common random numbers of the search, and those of each verification, which it never saw.
_SEARCH_SEED, _VERIFICATION_SEED = 0x51EE, 0xF5E5
#: Standard deviations of Monte Carlo that the search keeps below δ, and verifications at most.
_CAUTION, _VERIFICATIONS = 1.5, 3
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
        risk: δ in (0, 1): the probability that a path violates `problem.constraint` at any node
            must not exceed it. The constraint is priced and the price searched for by Monte Carlo
            on common random numbers; `Plan.risk` holds what was predicted and what fresh paths
            say. Where no price leads there: status RISK_UNREACHABLE, with the plan of least risk.
        price: ν ≥ 0 (`risk_price` of `plan`): add ν Σ P(violation) over nodes and constraints to
            the expected cost (Boole's bound; optimal risk allocation). No Monte Carlo:
            milliseconds.
        feedback: plan u = ū + K (x − μ) with the gains that minimise the expected cost: effort
            of the corrections included, bounds kept at a standard deviation of them.
            `Feedback(plan)` plays it.
        expected: charge the penalties' expectation, E Σ w max(0, c)² for Gaussian states, instead
            of their value at the mean. With any of the above it always is.
        terminal_weight: W ≥ 0, a number or (q,): charge E gᵀWg instead of asking for g(μ) = 0.
            None: exact, or with `feedback` the problem's `terminal_weight`, if it has one; if not,
            exact for the mean, and the spread charged 100 tr Cov g.
        episodes: fresh paths that verify a risk, ≥ 100 (`risk_episodes`).

    Raises:
        ValueError: for a value out of range, naming it.
    """

    risk: float | None = None
    price: float | None = None
    feedback: bool = False
    expected: bool = False
    terminal_weight: Any = None
    episodes: int = 100_000

    def __post_init__(self) -> None:
        if self.risk is not None:
            check_risk(self.risk)
            if self.price is not None:
                raise ValueError(
                    "risk and risk_price exclude each other: risk=δ searches for the price"
                )
        if self.price is not None:
            if isinstance(self.price, (bool, np.bool_)):
                raise ValueError(f"risk_price must be a number >= 0, not {self.price!r}")
            check_number("risk_price", self.price, zero_allowed=True)
        check_count("risk_episodes", self.episodes, least=100)
        for name in ("feedback", "expected"):
            if getattr(self, name) not in (True, False):
                raise ValueError(f"{name} must be True or False, not {getattr(self, name)!r}")
        if self.terminal_weight is not None:
            _numbers(self.terminal_weight)
            if not self.wanted:
                raise ValueError(
                    "terminal_weight is of expected costs: it needs feedback, expected, risk or "
                    "risk_price"
                )

    @property
    def wanted(self) -> bool:
        """Whether anything is."""
        return self.feedback or self.expected or self.risk is not None or self.price is not None

    def check(self, options: Options, model: Model) -> None:
        """Raise ValueError for what an expected cost cannot be combined with."""
        if options.only_convex or options.method == "convex":
            other = options.only_convex or "method='convex'"
            raise ValueError(f"risk, feedback and expected cannot be combined with {other}")
        if model.radius < np.inf:
            raise ValueError("risk, feedback and expected know no control_radius: use bounds")
        priced = self.risk is not None or bool(self.price)
        if priced and getattr(model.problem, "constraint", None) is None:
            raise ValueError(
                f"risk needs the problem's constraint(t, x) -> (..., p), violated where > 0; "
                f"{type(model.problem).__name__} has none"
            )

    def stakes(self, model: Model, w: float) -> Stakes:
        """What to charge, constraints at price zero.

        Raises:
            ValueError: for a terminal weight of wrong shape or sign.
        """
        problem: Any = model.problem
        q = np.shape(model.terminal(model.start))[-1]
        given = self.terminal_weight
        if given is None and self.feedback:
            given = getattr(problem, "terminal_weight", None)
        spread = _SPREAD_WEIGHT if self.feedback else 0.0
        return Stakes(
            penalties=model.weight,
            constraints=model.constraint_count(),
            price=0.0,
            terminal=np.full(q, spread) if given is None else _checked_terminal(given, q),
            soft=given is not None,
            feedback=self.feedback,
            variance_weight=w,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Steering:
    """What came of a request.

    Attributes:
        plan: where the iteration ended.
        status: how planning ended.
        cost: what is expected of the plan.
        risk: where one was asked for.
        message: what is lacking, or how a search went.
        origin: which of the plans of the mean it started from.
        iterations: Newton steps in all.
    """

    plan: Steered
    status: Status
    cost: ExpectedCost
    risk: Risk | None
    message: str
    origin: int
    iterations: int


def steer(
    model: Model, options: Options, request: Request, candidates: Sequence[Outcome]
) -> Steering:
    """Go on from plans of the mean, the best first; which is taken is decided by expected cost."""
    stakes = request.stakes(model, options.variance_weight)
    field = Field(model, options, stakes, [(c.x, c.u) for c in candidates])
    if request.risk is not None:
        return _Calibration(request, model, field).run()
    plan = field.solve(request.price or 0.0) or field.attempt
    say = "" if plan.status.ok else "the iteration on the expected cost did not settle"
    return Steering(plan, plan.status, field.cost(plan), None, say, field.origin(plan), field.steps)


def law(model: Model, plan: Steered) -> Any:
    """The law u = ū + K (x − μ) within bounds, as a function (t, x (..., n)) -> (..., m)."""
    angles = tuple(getattr(model.problem, "angles", ()))
    closed = bool(plan.gains.any())
    starts = model.times[:-1]

    def control(t: Any, x: Array) -> Array:
        k = int(np.argmin(np.abs(starts - t)))
        if not closed:
            return np.broadcast_to(plan.u[k], (*np.shape(x)[:-1], plan.u.shape[1]))
        u = plan.u[k] + wrap(x - plan.x[k], angles) @ plan.gains[k].T
        return project_controls(u, model.lower, model.upper, model.radius)

    return control


class _Calibration:
    """The search for the price at which a risk is kept, the plan at that price, and the proof.

    Args:
        request: with a risk δ.
        model: the problem.
        field: candidates.
    """

    def __init__(self, request: Request, model: Model, field: Field) -> None:
        self._request, self._model, self._field = request, model, field
        delta = self._delta = float(request.risk or 0.0)
        paths = self._paths = int(np.clip(_COUNTED / delta, _LEAST_PATHS, _MOST_PATHS))
        noise = np.sqrt(delta * (1.0 - delta) * (1.0 / paths + 1.0 / request.episodes))
        self._countable = delta * paths >= _COUNTABLE
        self._target = max(delta - _CAUTION * float(noise), 0.3 * delta)
        if not self._countable:
            self._target = delta
        self._simulated = 0.0
        self._tried: list[PricedRate] = []

    def run(self) -> Steering:
        """Search."""
        free = self._field.solve(0.0)
        verified = None if free is None else self._safe_already(free)
        if free is not None and verified is not None:
            return self._answer(free, 0.0, verified, kept=True)
        delta, target = self._delta, self._target
        price = _FIRST * max(abs(self._field.attempt.effort), 1e-6) / delta
        for attempt in range(_VERIFICATIONS):
            search = self._search(target, price)
            plan = search.best
            if plan is None:
                last = self._field.attempt
                say = f"no plan was found at any price of risk: the last ended {last.status}"
                cost, status = self._field.cost(last), Status.SOLVER_FAILED
                return Steering(last, status, cost, None, say, 0, self._field.steps)
            verified = self._rate(plan, self._request.episodes, _VERIFICATION_SEED + attempt)
            if verified <= delta or not search.reached:
                break
            # Fresh paths disagree with those of the search: ask for less.
            target, price = target * 0.9 * delta / verified, search.price
        kept = bool(search.reached and verified <= delta)
        return self._answer(plan, search.price, verified, kept)

    def _safe_already(self, free: Steered) -> float | None:
        """The verified rate of the plan without a price, if it keeps the risk; else None."""
        predicted = self._field.predicted_risk(free)
        # Boole's bound says whether to look.
        if predicted > _BOOLE * self._delta:
            return None
        rate = self._measure(free)
        self._tried.append(PricedRate(0.0, predicted, rate))
        if rate > self._target:
            return None
        verified = self._rate(free, self._request.episodes, _VERIFICATION_SEED)
        return verified if verified <= self._delta else None

    def _search(self, target: float, price: float) -> PriceSearch:
        search = search_price(
            lambda price, _: self._field.solve(price),
            self._measure,
            target=target,
            first=price,
            largest=_DEAREST * price,
            resolution=1.0 / self._paths if self._countable else 0.0,
        )
        for trial in search.tried:
            predicted = trial.answer and self._field.predicted_risk(trial.answer)
            self._tried.append(PricedRate(trial.price, predicted, trial.rate))
        return search

    def _measure(self, plan: Steered) -> float:
        if self._countable:
            return self._rate(plan, self._paths, _SEARCH_SEED)
        return self._field.predicted_risk(plan)

    def _rate(self, plan: Steered, episodes: int, seed: int) -> float:
        began = time.perf_counter()
        broken = violations(
            self._model.problem, law(self._model, plan), episodes=episodes, seed=seed
        )
        self._simulated += time.perf_counter() - began
        return float(broken.mean())

    def _answer(self, plan: Steered, price: float, verified: float, kept: bool) -> Steering:
        delta, episodes, field = self._delta, self._request.episodes, self._field
        cost = field.cost(plan)
        risk = Risk(
            requested=delta,
            predicted=cost.risk,
            verified=verified,
            interval=wilson_interval(round(verified * episodes), episodes),
            episodes=episodes,
            price=price,
            reached=kept,
            tried=tuple(self._tried),
            simulation_time=self._simulated,
        )
        status, say = plan.status, ""
        if not kept:
            status = Status.RISK_UNREACHABLE
            say = f"P(violation) <= {delta:g} was not reached: the least found is {verified:.4g}"
        elif not self._countable:
            say = f"{self._paths:,} paths cannot tell a risk of {delta:g}: Boole's bound keeps it"
        return Steering(plan, status, cost, risk, say, field.origin(plan), field.steps)


def _numbers(given: Any) -> Array:
    try:
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"terminal_weight must be numbers >= 0, not {given!r}") from error


def _checked_terminal(given: Any, q: int) -> Array:
    weight = _numbers(given)
    if weight.ndim == 0:
        weight = np.full(q, float(weight))
    if weight.shape != (q,) or not np.isfinite(weight).all() or (weight < 0.0).any():
        raise ValueError(
            f"terminal_weight must be a number or ({q},) numbers, finite and >= 0, not {given!r}"
        )
    return weight

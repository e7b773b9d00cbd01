"""From a plan of the mean to one that minimises an expected cost, at a price of risk or a risk.

    minimise  E[ Σ dt (uᵀRu + H + Σ w max(0, c)²) + gᵀWg ] + w ∫ tr Σ dt,   P(constraint) ≤ δ

for Gaussian states (:mod:`.expected`). The chance constraint is priced: ν times Boole's
bound joins the cost, which allocates the risk over nodes and rows, and ν is searched for until
simulated paths keep δ (:mod:`.price_search`, :mod:`.monte_carlo`).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from slipcar.planner.expected.guarded import Posed, posed
from slipcar.planner.expected.loop import Steered
from slipcar.planner.moments.gains import wrap
from slipcar.planner.moments.monte_carlo import violations
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.options import Options, check_count, check_number
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.control_set import project_controls
from slipcar.planner.problem.model import Model
from slipcar.planner.records import ExpectedCost
from slipcar.planner.search.field import Field, expected_cost, priced
from slipcar.planner.search.price_search import search_price
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
    """What is asked for beyond the mean; see `slipcar.planner.plan`.

    Attributes:
        risk: δ, or None.
        price: ν ≥ 0, where no risk is asked for.
        feedback: whether gains are part of the plan.
        expected: whether penalties are to be charged in expectation (they are with any other).
        terminal_weight: W, scalar or (q,), or None for the problem's own.
        episodes: paths for the verification.
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

    def stakes(self, ready: Posed, q: int, w: float) -> Stakes:
        """What to charge at price zero.

        Raises:
            ValueError: for a terminal weight of wrong shape or sign.
        """
        guarded = ready.guarded
        given = self.terminal_weight
        if given is None and self.feedback:
            given = getattr(guarded.problem, "terminal_weight", None)
        spread = _SPREAD_WEIGHT if self.feedback else 0.0
        return Stakes(
            weight=guarded.penalty_weight,
            tail=guarded.is_constraint,
            terminal=np.full(q, spread) if given is None else _checked_terminal(given, q),
            soft=given is not None,
            feedback=self.feedback,
            variance_weight=w,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Steering:
    """What came of a request.

    Attributes:
        found: where the iteration ended.
        status: how planning ended.
        cost: what is expected of the plan.
        risk: where one was asked for.
        message: what is lacking, or how a search went.
        origin: which of the plans of the mean it started from.
        iterations: Newton steps in all.
    """

    found: Steered
    status: Status
    cost: ExpectedCost
    risk: Risk | None
    message: str
    origin: int
    iterations: int


def steer(
    problem: Any, options: Options, request: Request, candidates: Sequence[Outcome]
) -> Steering:
    """Go on from plans of the mean, the best first; which is taken is decided by expected cost."""
    ready = posed(problem, options.integrator)
    first = candidates[0]
    q = len(np.asarray(ready.model.terminal(first.x[-1])))
    stakes = request.stakes(ready, q, options.variance_weight)
    field = Field(ready, options, stakes, [(c.x, c.u) for c in candidates])
    if request.risk is None:
        price = request.price or 0.0
        found = field.solve(price) or field.attempt
        cost = expected_cost(ready.model, priced(stakes, price), found)
        say = "" if found.status.ok else "the iteration on the expected cost did not settle"
        return Steering(found, found.status, cost, None, say, field.origin(found), field.steps)
    return _calibrated(problem, request, ready, field, stakes)


def _predicted(model: Model, stakes: Stakes, trial: Any) -> float | None:
    if trial.answer is None:
        return None
    return expected_cost(model, priced(stakes, trial.price), trial.answer).risk


def law(model: Model, found: Steered) -> Any:
    """The law u = ū + K (x − μ) within bounds, as a function (t, x (..., n)) -> (..., m)."""
    angles = tuple(getattr(model.problem, "angles", ()))
    closed = bool(found.gains.any())
    starts = model.times[:-1]

    def control(t: Any, x: Array) -> Array:
        k = int(np.argmin(np.abs(starts - t)))
        if not closed:
            return np.broadcast_to(found.u[k], (*np.shape(x)[:-1], found.u.shape[1]))
        u = found.u[k] + wrap(x - found.x[k], angles) @ found.gains[k].T
        return project_controls(u, model.lower, model.upper, model.radius)

    return control


def _calibrated(
    problem: Any, request: Request, ready: Posed, field: Field, stakes: Stakes
) -> Steering:
    """The price at which the risk is kept, the plan at that price, and the proof."""
    model, delta = ready.model, float(request.risk or 0.0)
    paths = int(np.clip(_COUNTED / delta, _LEAST_PATHS, _MOST_PATHS))
    noise = np.sqrt(delta * (1.0 - delta) * (1.0 / paths + 1.0 / request.episodes))
    target = max(delta - _CAUTION * float(noise), 0.3 * delta)
    countable = delta * paths >= _COUNTABLE
    if not countable:
        target = delta
    simulated = 0.0

    def rate(found: Steered, episodes: int, seed: int) -> float:
        nonlocal simulated
        began = time.perf_counter()
        broken = violations(problem, law(model, found), episodes=episodes, seed=seed)
        simulated += time.perf_counter() - began
        return float(broken.mean())

    def measure(found: Steered) -> float:
        if countable:
            return rate(found, paths, _SEARCH_SEED)
        return expected_cost(model, stakes, found).risk

    def answer(found: Steered, price: float, kept: bool) -> Steering:
        cost = expected_cost(model, priced(stakes, price), found)
        risk = Risk(
            requested=delta,
            predicted=cost.risk,
            verified=verified,
            interval=wilson_interval(round(verified * request.episodes), request.episodes),
            episodes=request.episodes,
            price=price,
            reached=kept,
            tried=tuple(tried),
            simulation_time=simulated,
        )
        if kept:
            say = ""
            if not countable:
                say = f"{paths:,} paths cannot tell a risk of {delta:g}: Boole's bound keeps it"
            return Steering(found, found.status, cost, risk, say, field.origin(found), field.steps)
        say = f"P(violation) <= {delta:g} was not reached: the least found is {verified:.4g}"
        status = Status.RISK_UNREACHABLE
        return Steering(found, status, cost, risk, say, field.origin(found), field.steps)

    tried: list[PricedRate] = []
    free = field.solve(0.0)
    if free is not None:
        # Perhaps what is cheapest is safe enough: Boole's bound says whether to look.
        cost = expected_cost(model, stakes, free)
        if cost.risk <= _BOOLE * delta:
            share = measure(free)
            tried.append(PricedRate(0.0, cost.risk, share))
            if share <= target:
                verified = rate(free, request.episodes, _VERIFICATION_SEED)
                if verified <= delta:
                    return answer(free, 0.0, True)
    scale = max(abs(field.attempt.effort), 1e-6)
    first = _FIRST * scale / delta
    for attempt in range(_VERIFICATIONS):
        search = search_price(
            lambda price, _: field.solve(price),
            measure,
            target=target,
            first=first,
            largest=_DEAREST * first,
            resolution=1.0 / paths if countable else 0.0,
        )
        tried += [PricedRate(t.price, _predicted(model, stakes, t), t.rate) for t in search.tried]
        found = search.best
        if found is None:
            cost = expected_cost(model, stakes, field.attempt)
            say = f"no plan was found at any price of risk: the last ended {field.attempt.status}"
            status = Status.SOLVER_FAILED
            return Steering(field.attempt, status, cost, None, say, 0, field.steps)
        verified = rate(found, request.episodes, _VERIFICATION_SEED + attempt)
        if verified <= delta or not search.reached:
            break
        # Fresh paths disagree with those of the search: ask for less.
        target, first = target * 0.9 * delta / verified, search.price
    assert found is not None
    return answer(found, search.price, bool(search.reached and verified <= delta))


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

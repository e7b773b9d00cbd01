"""`plan`: one problem, one call."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.convex.solvers.interface import Solver
from slipcar.planner.newton.posing import Posed
from slipcar.planner.options import (
    Backend,
    ColdStart,
    Guesses,
    IntegratorName,
    Linearization,
    Method,
    Options,
    RiskAt,
    TrustRegionName,
    plain,
)
from slipcar.planner.outcome import Outcome
from slipcar.planner.plan import Plan, plan_of, steered_fields
from slipcar.planner.problem.checks import check_derivatives as compare_derivatives
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.problem.reposed import reposed
from slipcar.planner.records import Iteration
from slipcar.planner.search.attempt import Task, attempt, completed, posed_for
from slipcar.planner.search.free_time import checked_bounds
from slipcar.planner.search.free_time import free_final_time as search_time
from slipcar.planner.search.shot import solve_shooting
from slipcar.planner.search.starts import multistart
from slipcar.planner.search.steering import Request, steer
from slipcar.planner.search.warm_start import given_guess, run_guarded
from slipcar.planner.status import Status

Array = np.ndarray

#: Guesses where noise has a cost: the cheapest way round the obstacles may be the riskiest.
_STARTS = 6


def plan(
    problem: Problem,
    *,
    variance_weight: float | None = None,
    solver: Backend | Solver = "structured",
    method: Method = "auto",
    tolerance: float = 1e-4,
    max_iterations: int = 200,
    trust_region: TrustRegionName | None = None,
    linearization: Linearization = "composite",
    terminal_tolerance: float = 0.0,
    integrator: IntegratorName | None = None,
    compiled: bool | None = None,
    starts: int | None = None,
    guess: Plan | tuple[Array, Array] | None = None,
    cold_start: ColdStart = "auto",
    free_first: bool | None = None,
    shooting: bool = False,
    free_final_time: bool = False,
    time_weight: float = 1.0,
    final_time_bounds: tuple[float, float] | None = None,
    risk: float | None = None,
    risk_at: RiskAt = "nodes",
    risk_price: float | None = None,
    risk_episodes: int = 100_000,
    feedback: bool = False,
    expected: bool = False,
    terminal_weight: Any = None,
    check_derivatives: bool = False,
    callback: Callable[[Iteration], bool | None] | None = None,
) -> Plan:
    """Plan by stochastic sequential convex programming (paper §3 and §6).

        minimise  ∫ uᵀRu + H(μ) + ℓ(μ)ᵀu + Σ w max(0, c(μ))² + variance_weight · tr Σ dt

    Any object that satisfies :class:`slipcar.planner.Problem` can be planned for; a Scenario does.
    How the iteration runs (`variance_weight` to `compiled`, and `callback`), is described at
    :class:`slipcar.planner.options.Options`; where it begins and which horizons it tries (`starts`
    to `final_time_bounds`, and `check_derivatives`), at :class:`slipcar.planner.options.Guesses`;
    and what is planned for beyond the mean (`risk` to `terminal_weight`), at
    :class:`slipcar.planner.search.steering.Request`.

    Returns:
        A plan; look at `status` before using it, and at `message` when it is not CONVERGED.

    Raises:
        TypeError: if `problem` lacks a required member.
        ValueError: for an option or a problem's function out of range, naming it; for functions
            that can neither be traced nor differentiated, and assumptions that do not hold.
    """
    asked, began = {name: plain(value) for name, value in locals().items()}, time.perf_counter()
    request, guesses = _of(Request, asked), _of(Guesses, asked)
    if shooting and compiled:
        raise ValueError("shooting=True watches each iterate: leave compiled=True out")
    if request.wanted and (shooting or free_final_time):
        raise ValueError(
            "risk, risk_price, feedback and expected cannot be combined with shooting or "
            "free_final_time"
        )
    if variance_weight is None:
        asked["variance_weight"] = 0.0 if request.wanted else 1.0
    if integrator is None:
        asked["integrator"] = "rk4" if request.on_path else "euler"
    if shooting and method == "auto":
        asked["method"] = "convex"
    with np.errstate(all="ignore"):
        return _Planning(problem, _of(Options, asked), request, guesses, began).run()


def _of(kind: Any, asked: dict[str, Any]) -> Any:
    """The options that a record holds and describes, checked."""
    record = object.__new__(kind)  # not field by field, as a frozen record's own __init__ does
    vars(record).update({name: asked[name] for name in kind.__dataclass_fields__})
    record.__post_init__()
    return record


class _Planning:
    """One call of `plan`, which began at a time [s]."""

    def __init__(
        self, problem: Problem, options: Options, request: Request, guesses: Guesses, began: float
    ) -> None:
        self.problem, self.options, self.request = problem, options, request
        self.guesses, self.began = guesses, began
        self.extras: dict[str, Any] = {}
        self.model = completed(problem, options)
        self.posed: Posed | None = None
        self.bounds: tuple[float, float] | None = None

    def run(self) -> Plan:
        """Check, plan, and put the plan together."""
        model, options, guesses = self.model, self.options, self.guesses
        wanted = self.request.wanted
        if wanted:
            self.request.check(options, model)
        if guesses.free_final_time:
            self.bounds = checked_bounds(model, guesses.final_time_bounds)
        x, u = given_guess(model, guesses.guess)
        if guesses.check_derivatives:  # before the rest, which relies on them
            compare_derivatives(model, x, u)
        charged = options.variance_weight > 0 and not wanted
        self.posed = posed_for(model, options, x, u, charged=charged)
        candidates = self._candidates(x, u)
        if self.bounds is not None:
            states, outcome = candidates[0]
            self.model, outcome, self.extras["time_search"] = search_time(
                model, self.posed, options, outcome,
                time_weight=float(guesses.time_weight), bounds=self.bounds,
            )  # fmt: skip
            self.problem = reposed(self.problem, times=self.model.times)
            candidates = [(states, outcome)]
        ended = candidates[0][1].status in (Status.STOPPED, Status.SOLVER_FAILED)
        plan = self._built(candidates, steered=wanted and not ended)
        model = self.model
        names = sorted(model.jacobians.differenced) if model.knows_jacobians else []
        if not names:
            return plan
        say = f"differentiated numerically, as they cannot be traced: {', '.join(names)}"
        return plan.replace(message=f"{plan.message}; {say}" if plan.message else say)

    def _candidates(self, x: Array, u: Array) -> list[tuple[Array, Outcome]]:
        """Outcomes that differ, each with the states of its guess, the best first."""
        given, cold_start, starts = self.guesses.guess, self.guesses.cold_start, self.guesses.starts
        if starts is None:
            starts = _STARTS if self.request.wanted and given is None else 1
        if starts > 1:
            different, rows = multistart(self.model, self.posed, self.options, starts)
            self.extras["alternatives"] = rows
            if self.guesses.shooting:
                states, best = different[0]
                different[0] = states, self._attempt(best.x, best.u)
            return different
        if given is None or cold_start == "never":
            return [(x, self._attempt(x, u, own=given is None))]
        trusted = isinstance(given, Plan) and given.status.ok and cold_start == "auto"
        return [run_guarded(self.model, self.options, self._attempt, (x, u), trusted=trusted)]

    def _attempt(self, x: Array, u: Array, *, own: bool = False) -> Outcome:
        """What one guess leads to; `own`: it is the problem's."""
        free_first = self.guesses.free_first
        if free_first is None:
            free_first = own and not self.options.convex
        task = Task(self.model, self.posed, x, u, free_first)
        if not self.guesses.shooting:
            return attempt(task, self.options)
        outcome, self.extras["shot"] = solve_shooting(task, self.options)
        return outcome

    def _built(self, candidates: list[tuple[Array, Outcome]], *, steered: bool) -> Plan:
        """The plan of the mean, or of the expected cost that plans of the mean lead to."""
        origin, changes = 0, {}
        if steered:
            outcomes = [outcome for _, outcome in candidates]
            answer = steer(self.model, self.options, self.request, outcomes)
            origin = answer.origin
            changes = steered_fields(answer.plan, self.model) | {
                "status": answer.status,
                "iterations": outcomes[origin].iterations + answer.iterations,
                "message": answer.message,
                "expected": answer.cost,
                "risk": answer.risk,
            }
            if not self.request.feedback:
                changes["gains"] = None
            nominal = outcomes[origin]
            if not (answer.status.ok or nominal.status.ok):
                # What keeps the mean from converging keeps all that is built on it.
                both = "; ".join(filter(None, (nominal.message, answer.message)))
                changes |= {"status": nominal.status, "message": both}
        states, outcome = candidates[origin]
        plan = plan_of(
            outcome, self.model, self.problem, options=self._record(), guess=states,
            solve_time=time.perf_counter() - self.began, **self.extras,
        )  # fmt: skip
        return plan.replace(**changes) if changes else plan

    def _record(self) -> dict[str, Any]:
        """What the plan was asked for, as plain data."""
        guesses, request = self.guesses, self.request
        weight = request.terminal_weight
        return {
            **self.options.as_dict(),
            "starts": int(guesses.starts or (_STARTS if request.wanted else 1)),
            "cold_start": guesses.cold_start,
            "free_first": guesses.free_first,
            "shooting": bool(guesses.shooting),
            "free_final_time": bool(guesses.free_final_time),
            "time_weight": float(guesses.time_weight) if guesses.free_final_time else None,
            "final_time_bounds": None if self.bounds is None else list(self.bounds),
            "risk": request.risk,
            "risk_at": request.risk_at,
            "risk_price": request.risk_price,
            "risk_episodes": int(request.risk_episodes),
            "feedback": bool(request.feedback),
            "expected": bool(request.expected),
            "terminal_weight": None if weight is None else np.asarray(weight, float).tolist(),
        }

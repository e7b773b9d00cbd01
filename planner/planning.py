"""`plan`: one problem, one call."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.convex.solvers.interface import Solver
from slipcar.planner.history import Iteration
from slipcar.planner.newton.posing import Posed, check_assumptions, pose
from slipcar.planner.options import Guesses, Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.plan import Plan, plan_of, steered_plan
from slipcar.planner.problem import checks
from slipcar.planner.problem.model import Model, model_of
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.problem.reposed import reposed
from slipcar.planner.search.attempt import attempt, uses_newton
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
    solver: str | Solver = "structured",
    method: str = "auto",
    tolerance: float = 1e-3,
    max_iterations: int = 100,
    trust_region: str | None = None,
    linearization: str = "composite",
    terminal_tolerance: float = 0.0,
    integrator: str = "euler",
    compiled: bool | None = None,
    starts: int | None = None,
    guess: Plan | tuple[Array, Array] | None = None,
    cold_start: str = "auto",
    free_first: bool | None = None,
    shooting: bool = False,
    free_final_time: bool = False,
    time_weight: float = 1.0,
    final_time_bounds: tuple[float, float] | None = None,
    risk: float | None = None,
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

    Args:
        problem: anything that satisfies :class:`slipcar.planner.Problem`; a Scenario does.
        variance_weight, solver, method, tolerance, max_iterations, trust_region, linearization,
            terminal_tolerance, integrator, compiled, callback: how the iteration runs; each is
            described at :class:`slipcar.planner.options.Options`.
        starts, guess, cold_start, free_first, shooting, free_final_time, time_weight,
            final_time_bounds, check_derivatives: where it begins and which horizons it tries; see
            :class:`slipcar.planner.options.Guesses`.
        risk, risk_price, risk_episodes, feedback, expected, terminal_weight: what is planned for
            beyond the mean; see :class:`slipcar.planner.search.steering.Request`.

    Returns:
        A plan; look at `status` before using it, and at `message` when it is not CONVERGED.

    Raises:
        TypeError: if `problem` lacks a required member.
        ValueError: for an option or a problem's function out of range, naming it; for functions
            that can neither be traced nor differentiated, and assumptions that do not hold.
    """
    began = time.perf_counter()
    request = Request(risk, risk_price, feedback, expected, terminal_weight, risk_episodes)
    guesses = Guesses(
        starts, guess, cold_start, free_first, shooting, free_final_time, time_weight,
        final_time_bounds, check_derivatives,
    )  # fmt: skip
    options = _options(request, guesses, variance_weight, method, dict(
        solver=solver, tolerance=tolerance, max_iterations=max_iterations, compiled=compiled,
        trust_region=trust_region, linearization=linearization, callback=callback,
        terminal_tolerance=terminal_tolerance, integrator=integrator,
    ))  # fmt: skip
    with np.errstate(all="ignore"):
        return _Planning(problem, options, request, guesses, began).run()


def _options(
    request: Request, guesses: Guesses, weight: float | None, method: str, others: dict[str, Any]
) -> Options:
    """Options of the iteration, those that depend on what is asked for filled in."""
    if guesses.shooting and others["compiled"]:
        raise ValueError("shooting=True watches each iterate: leave compiled=True out")
    if request.wanted and (guesses.shooting or guesses.free_final_time):
        raise ValueError(
            "risk, risk_price, feedback and expected cannot be combined with shooting or "
            "free_final_time"
        )
    if weight is None:
        weight = 0.0 if request.wanted else 1.0
    if guesses.shooting and method == "auto":
        method = "convex"
    return Options(variance_weight=weight, method=method, **others)


class _Planning:
    """One call of `plan`.

    Args:
        problem: what is planned for.
        options: of the iterations.
        request: what is planned for beyond the mean.
        guesses: where iterations begin.
        began: when the call did [s].
    """

    def __init__(
        self, problem: Problem, options: Options, request: Request, guesses: Guesses, began: float
    ) -> None:
        self.problem, self.options, self.request = problem, options, request
        self.guesses, self.began = guesses, began
        self.extras: dict[str, Any] = {}
        model = model_of(problem)
        if options.integrator != model.integrator:
            model = dataclasses.replace(model, integrator=options.integrator)
        self.model: Model = model
        if request.wanted:
            request.check(options, model)
        self.bounds = (
            checked_bounds(model, guesses.final_time_bounds) if guesses.free_final_time else None
        )
        self.posed: Posed | None = None
        if uses_newton(model, options):
            self.posed = pose(model, compiled=options.compiled)

    def run(self) -> Plan:
        """Check, plan, and put the plan together."""
        model, guesses = self.model, self.guesses
        given = guesses.guess
        x, u = model.guess() if given is None else given_guess(model, given)
        if guesses.check_derivatives:  # before the rest, which relies on them
            checks.check_derivatives(model, x, u)
        charged = self.options.variance_weight > 0 and not self.request.wanted
        if self.posed is not None:
            check_assumptions(self.posed, x, u, charged=charged)
        else:
            checks.check(model, x, u, None, charged=charged)
        candidates = self._candidates(x, u)
        if guesses.free_final_time:
            candidates = [(candidates[0][0], self._timed(candidates[0][1]))]
        plan = self._steered(candidates) if self._steers(candidates[0][1]) else self._built(
            *candidates[0]
        )  # fmt: skip
        return self._noted(plan)

    def _candidates(self, x: Array, u: Array) -> list[tuple[Array, Outcome]]:
        """Outcomes that differ, each with the states of its guess, the best first."""
        guesses = self.guesses
        starts = guesses.starts
        if starts is None:
            starts = _STARTS if self.request.wanted and guesses.guess is None else 1
        if starts > 1:
            tried = multistart(self.model, self.posed, self.options, starts)
            self.extras["alternatives"] = tried.alternatives
            best_x, best = tried.different[0]
            if guesses.shooting:
                best = self._attempt(best.x, best.u)
            return [(best_x, best), *tried.different[1:]]
        if guesses.guess is None:
            return [(x, self._attempt(x, u, own=True))]
        if guesses.cold_start == "never":
            return [(x, self._attempt(x, u))]
        given = guesses.guess
        trusted = isinstance(given, Plan) and given.status.ok and guesses.cold_start == "auto"
        return [run_guarded(self.model, self.options, self._attempt, (x, u), trusted=trusted)]

    def _attempt(self, x: Array, u: Array, *, own: bool = False) -> Outcome:
        """What one guess leads to; `own`: it is the problem's."""
        free_first = self.guesses.free_first
        if free_first is None:
            convex = self.options.method == "convex" or bool(self.options.only_convex)
            free_first = own and not convex
        at = (self.model, self.posed, self.options, x, u)
        if self.guesses.shooting:
            outcome, self.extras["shot"] = solve_shooting(*at, free_first=free_first)
            return outcome
        return attempt(*at, free_first=free_first)

    def _timed(self, outcome: Outcome) -> Outcome:
        """The plan at the best horizon."""
        assert self.bounds is not None
        self.model, outcome, self.extras["time_search"] = search_time(
            self.model, self.posed, self.options, outcome,
            time_weight=float(self.guesses.time_weight), bounds=self.bounds,
        )  # fmt: skip
        self.problem = reposed(self.problem, times=self.model.times)
        return outcome

    def _steers(self, outcome: Outcome) -> bool:
        ended = outcome.status in (Status.STOPPED, Status.SOLVER_FAILED)
        return self.request.wanted and not ended

    def _steered(self, candidates: list[tuple[Array, Outcome]]) -> Plan:
        """The plan of the expected cost that plans of the mean lead to."""
        steering = steer(
            self.model, self.options, self.request, [outcome for _, outcome in candidates]
        )
        x, nominal = candidates[steering.origin]
        return steered_plan(
            steering, nominal, self.model, self.problem, guess=x, options=self._record(),
            seconds=time.perf_counter() - self.began, **self.extras,
        )  # fmt: skip

    def _built(self, x: Array, outcome: Outcome) -> Plan:
        return plan_of(
            outcome, self.model, self.problem, guess=x, options=self._record(),
            seconds=time.perf_counter() - self.began, **self.extras,
        )  # fmt: skip

    def _noted(self, plan: Plan) -> Plan:
        """With a word on derivatives that were taken numerically."""
        names = sorted(self.model.jacobians.differenced) if self.model.knows_jacobians else []
        if not names:
            return plan
        say = f"differentiated numerically, as they cannot be traced: {', '.join(names)}"
        return plan.replace(message=f"{plan.message}; {say}" if plan.message else say)

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
            "risk_price": request.price,
            "risk_episodes": int(request.episodes),
            "feedback": bool(request.feedback),
            "expected": bool(request.expected),
            "terminal_weight": None if weight is None else np.asarray(weight, float).tolist(),
        }

"""`plan`: one problem, one call."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.build import build, build_steered
from slipcar.planner.convex.solvers import Solver
from slipcar.planner.history import Iteration
from slipcar.planner.options import Options, check_choice, check_count, check_number
from slipcar.planner.outcome import Outcome
from slipcar.planner.plan import Plan
from slipcar.planner.problem import checks
from slipcar.planner.problem.model import Problem, model_of
from slipcar.planner.problem.reposed import reposed
from slipcar.planner.search.free_time import checked_bounds
from slipcar.planner.search.free_time import free_final_time as search_time
from slipcar.planner.search.method import solve
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
    """Plan by stochastic sequential convex programming (paper §3 and §6, SPEC §3).

        minimise  ∫ uᵀRu + H(μ) + ℓ(μ)ᵀu + Σ w max(0, c(μ))² + variance_weight · tr Σ dt

    Args:
        problem: anything that satisfies :class:`slipcar.planner.Problem`; a Scenario does.
        variance_weight: w ≥ 0; 0 is deterministic SCP. None is 1, or 0 with one of `risk`,
            `risk_price`, `feedback` and `expected`, whose cost counts the noise already. Without
            one of them, w > 0 asks for a diffusion that depends on no uncertain state.
        solver: `"structured"`, `"osqp"` or `"cvxpy"`, or an object with their interface; see
            :mod:`slipcar.planner.convex.solvers`.
        method: `"newton"`: one LQ problem per iteration and Newton's method at the end, quadratic
            (:mod:`slipcar.planner.newton`); `"convex"`: the paper's scheme, exact convex
            sub-problems. `"auto"` takes the first unless an option or the problem asks for the
            second: another solver, a trust region, the literal linearisation, a terminal box, a
            ball of controls. Where the first does not converge, the second goes on.
        tolerance: stop when ∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt falls to it, > 0; in the
            units of the controls: choose it for controls that are not of order one.
        max_iterations: at most so many sub-problems from each guess, ≥ 1; of those beyond 60
            three quarters are for the convex method, should Newton's not converge.
        trust_region: of the convex method: `"adaptive"` (None is), `"paper"` (Δ₀ = 100, × 0.99)
            or `"none"`.
        linearization: `"composite"` keeps max(0, ·)² and linearises its argument; `"literal"`
            linearises the obstacle cost whole, as the paper writes it.
        terminal_tolerance: half-width of a box round E g = 0; 0 asks for equality.
        integrator: of the mean: `"euler"` (the paper's) or `"rk4"`; controls are constant on each
            interval either way. See :mod:`slipcar.planner.problem.integrators`.
        compiled: run Newton's method compiled by numba, the same steps to rounding errors. None:
            where numba is installed and the problem's functions can be traced, and no callback
            is to be called on the way.
        starts: guesses to try, ≥ 1: the problem's own (with and without its penalties at first) and
            others round the obstacles; the best plan is returned and `alternatives` says what
            became of each. None is 1, or 6 for an expected cost: the way round the obstacles that
            is cheapest for the mean may be the riskiest.
        guess: where to start: a plan (resampled if its time grid is another), or states (N, n)
            and controls (N−1, m); None takes the problem's own.
        cold_start: when the problem's own guess is tried beside `guess` and the better plan
            returned: `"auto"` unless `guess` is a converged plan that fits the problem at least
            as well and leads to a converged one, `"always"` or `"never"`. A converged plan is a
            local optimum, as a rule in its guess's homotopy class; only a comparison tells
            whether the problem's own guess leads to a better one. `message` says which was taken.
        free_first: leave the penalties out until the first steps have settled, so that the path
            that would be best without obstacles decides which way round them, not the guess.
            None: from the problem's own guess, unless an option asks for the convex method.
        shooting: once an iterate of the convex method is near an extremal, solve the maximum
            principle itself by Newton's method, to 1e-12 (paper §3.3, SPEC §3.8); SCP goes on
            where that fails. `shot` says what became of it.
        free_final_time: choose the horizon too: minimise cost + time_weight · T over a uniform
            dilation of the time grid (paper §5); `final_time` and `time_search` say what came out.
        time_weight: cost of a second of final time, > 0.
        final_time_bounds: least and largest final time [s], counted from the first node; None is
            1/10 and 10 times the problem's.
        risk: δ in (0, 1): the probability that a path violates `problem.constraint` at any node
            must not exceed it. The constraint is priced (see `risk_price`) and the price searched
            for by Monte Carlo on common random numbers; `Plan.risk` holds what was predicted and
            what `risk_episodes` fresh paths say. Where no price leads there: status
            RISK_UNREACHABLE, with the plan of least risk found.
        risk_price: ν ≥ 0: add ν Σ P(violation) over nodes and constraints to the expected cost
            (Boole's bound; optimal risk allocation). No Monte Carlo: milliseconds.
        risk_episodes: fresh paths that verify a risk, ≥ 100.
        feedback: plan u = ū + K (x − μ) with the gains that minimise the expected cost: effort
            of the corrections included, bounds kept at a standard deviation of them.
            `Feedback(plan)` plays it.
        expected: charge the penalties' expectation, E Σ w max(0, c)² for Gaussian states, instead
            of their value at the mean. With `risk`, `risk_price` and `feedback` it always is.
        terminal_weight: W ≥ 0, a number or (q,): charge E gᵀWg instead of asking for g(μ) = 0.
            None: exact, or with `feedback` the problem's `terminal_weight`, if it has one; if not,
            exact for the mean, and the spread charged 100 tr Cov g.
        check_derivatives: compare every Jacobian with differences before planning.
        callback: called with each :class:`Iteration`, from whichever guess and at whichever
            horizon; returning True stops that guess (all others begin nonetheless) and any search
            of a final time.

    Returns:
        A plan; look at `status` before using it, and at `message` when it is not CONVERGED.

    Raises:
        TypeError: if `problem` lacks a required member.
        ValueError: for an option or a problem's function out of range, naming it; for a drift
            that is not affine in the control, or a diffusion that depends on uncertain states
            where `variance_weight` is to charge the noise.
    """
    began = time.perf_counter()
    if shooting and compiled:
        raise ValueError("shooting=True watches each iterate: leave compiled=True out")
    request = Request(
        risk=risk,
        price=risk_price,
        feedback=feedback,
        expected=expected,
        terminal_weight=terminal_weight,
        episodes=risk_episodes,
    )
    if request.wanted and (shooting or free_final_time):
        raise ValueError(
            "risk, risk_price, feedback and expected cannot be combined with shooting or "
            "free_final_time"
        )
    if variance_weight is None:
        variance_weight = 0.0 if request.wanted else 1.0
    if shooting and method == "auto":
        method = "convex"
    options = Options(
        variance_weight=variance_weight,
        solver=solver,
        method=method,
        tolerance=tolerance,
        max_iterations=max_iterations,
        trust_region=trust_region,
        linearization=linearization,
        terminal_tolerance=terminal_tolerance,
        integrator=integrator,
        compiled=compiled,
        callback=callback,
    )
    if starts is None:
        starts = _STARTS if request.wanted and guess is None else 1
    check_count("starts", starts)
    check_choice("cold_start", cold_start, ("auto", "always", "never"))
    if free_first not in (None, True, False):
        raise ValueError(f"free_first must be None, True or False, not {free_first!r}")
    if starts > 1 and guess is not None:
        raise ValueError("starts > 1 and guess exclude each other: starts makes its own guesses")
    model = model_of(problem)
    if integrator != model.integrator:
        model = dataclasses.replace(model, integrator=integrator)
    if request.wanted:
        request.check(options, model)
    if free_final_time:
        check_number("time_weight", time_weight)
        bounds = checked_bounds(model, final_time_bounds)
    x, u = model.guess() if guess is None else given_guess(model, guess)
    if check_derivatives:  # before the rest, which relies on them
        checks.check_derivatives(model, x, u)
    checks.check_once(model, x, u, charged=options.variance_weight > 0 and not request.wanted)
    record: dict[str, Any] = {
        **options.as_dict(),
        "starts": int(starts),
        "cold_start": cold_start,
        "free_first": free_first,
        "shooting": bool(shooting),
        "free_final_time": bool(free_final_time),
        "time_weight": float(time_weight) if free_final_time else None,
        "final_time_bounds": list(bounds) if free_final_time else None,
        "risk": risk,
        "risk_price": risk_price,
        "risk_episodes": int(risk_episodes),
        "feedback": bool(feedback),
        "expected": bool(expected),
        "terminal_weight": None
        if terminal_weight is None
        else np.asarray(terminal_weight, dtype=float).tolist(),
    }
    more: dict[str, Any] = {}
    convex = method == "convex" or bool(options.only_convex)

    def run(x: Array, u: Array, *, own: bool = False) -> Outcome:
        first = own and not convex if free_first is None else free_first
        if shooting:
            found, more["shot"] = solve_shooting(model, options, x, u, free_first=first)
            return found
        return solve(model, options, x, u, free_first=first)

    candidates: tuple[tuple[Array, Outcome], ...] = ()
    if starts > 1:
        tried = multistart(model, options, starts)
        candidates, more["alternatives"] = tried.different, tried.alternatives
        x, found = candidates[0]
        if shooting:
            found = run(found.x, found.u)
    elif guess is None:
        found = run(x, u, own=True)
    elif cold_start == "never":
        found = run(x, u)
    else:
        trusted = isinstance(guess, Plan) and guess.status.ok and cold_start == "auto"
        x, found = run_guarded(model, options, run, (x, u), trusted=trusted)
    if free_final_time:
        model, found, more["time_search"] = search_time(
            model, options, found, time_weight=float(time_weight), bounds=bounds
        )
        problem = reposed(problem, times=model.times)
    if request.wanted and found.status not in (Status.STOPPED, Status.SOLVER_FAILED):
        candidates = candidates or ((x, found),)
        steered = steer(problem, options, request, [outcome for _, outcome in candidates])
        x, found = candidates[steered.origin]
        return build_steered(
            steered,
            found,
            model,
            problem,
            guess=x,
            options=record,
            seconds=time.perf_counter() - began,
            **more,
        )
    return build(
        found,
        model,
        problem,
        guess=x,
        options=record,
        seconds=time.perf_counter() - began,
        **more,
    )

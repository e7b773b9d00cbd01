"""The stochastic SCP iteration (paper §3.1): linearise, solve LOCP_{k+1}, judge the step.

    repeat   linearise at (u_k, μ_k)            convexify.linearize
             moments and their sensitivities    moments
             solve the convex sub-problem       backends
             accept or shorten                  trust_region
    until    ∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt ≤ tolerance

The merit function that steps are judged by is

    Φ = effort + penalty + w ∫ tr Σ dt + Σ λᵀf + ½ max|λ| ‖f‖₁ + ρ ‖g‖₁ (beyond its tolerance)

with f the defects of the non-linear dynamics and λ their multipliers from the sub-problem.
Pricing defects by λ, with its sign, is what keeps good steps from being rejected near the
solution (Maratos): the defect that a step leaves is of second order, and so is its gain.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from slipcar.planner import moments
from slipcar.planner.backends import Solution, Solver
from slipcar.planner.convexify import Linearization, Subproblem, convexify, linearize
from slipcar.planner.problem import Model
from slipcar.planner.status import Status
from slipcar.planner.trust_region import Step, TrustRegion

Array = np.ndarray

#: Weights of the terminal penalty: the first, and the largest before it is called infeasible.
_MIN_RHO, _MAX_RHO = 1e3, 1e6
#: A converged plan leaves no more than this of the terminal condition, per unit of the state.
_FEASIBILITY = 1e-6


@dataclasses.dataclass(frozen=True)
class Iteration:
    """One sub-problem solved and its step judged.

    Attributes:
        mean: states of the step, (N, n).
        controls: (N−1, m).
        effort: Σ dt uᵀRu.
        penalty: Σ dt Σ w max(0, c)², the obstacle cost.
        variance: ∫ tr Σ dt; NaN when its weight is zero (it is not computed then).
        merit: Φ there.
        predicted: decrease of Φ by the convex model.
        actual: decrease of Φ.
        step: ∫ ‖u_{k+1} − u_k‖² dt.
        trust_radius: ∫ E‖x − x_k‖² dt.
        trust_multiplier: −p¹ with p⁰ = −1.
        virtual_control: what the sub-problem's terminal condition lacks, 1-norm.
        defect: largest |x_k + dt b(x_k, u_k) − x_{k+1}|.
        terminal_residual: largest |g(x_N)|.
        terminal_multiplier: ν, (q,).
        accepted: whether it became the next iterate.
        solver_iterations: LQ solves or the package's iterations.
        linearize_seconds: time spent on the model.
        solve_seconds: time spent in the sub-problem solver.
    """

    mean: Array
    controls: Array
    effort: float
    penalty: float
    variance: float
    merit: float
    predicted: float
    actual: float
    step: float
    trust_radius: float
    trust_multiplier: float
    virtual_control: float
    defect: float
    terminal_residual: float
    terminal_multiplier: Array
    accepted: bool
    solver_iterations: int
    linearize_seconds: float
    solve_seconds: float

    @property
    def seconds(self) -> float:
        """Time of the iteration, callback excluded."""
        return self.linearize_seconds + self.solve_seconds


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Where the iteration ended.

    Attributes:
        status: how.
        at: linearisation at the last accepted iterate.
        adjoint: λ_1..λ_K of the last accepted sub-problem, (K, n).
        terminal: ν, (q,).
        trust_multiplier: −p¹ of it.
        history: every sub-problem solved.
        message: the solver's own words when it failed.
    """

    status: Status
    at: Linearization
    adjoint: Array
    terminal: Array
    trust_multiplier: float
    history: tuple[Iteration, ...]
    message: str = ""


@dataclasses.dataclass(frozen=True)
class Settings:
    """What the loop needs to know beyond the model; see `slipcar.planner.plan`."""

    variance_weight: float
    tolerance: float
    max_iterations: int
    composite: bool
    terminal_tolerance: float
    callback: Callable[[Iteration], bool | None] | None


@dataclasses.dataclass(frozen=True)
class _Iterate:
    """A linearisation with the variance terms that belong to it."""

    lin: Linearization
    variance: moments.Variance | None
    trust_weight: Array | None

    def variance_value(self) -> float:
        return 0.0 if self.variance is None else self.variance.value


def iterate(
    model: Model, solver: Solver, trust: TrustRegion, settings: Settings, x: Array, u: Array
) -> Outcome:
    """Run the loop from the guess x (N, n), u (N−1, m).

    Raises:
        ValueError: if the model functions are not finite along the guess.
    """
    history: list[Iteration] = []
    clock = time.perf_counter()
    at = _iterate_at(model, settings, x, u)
    linearize_seconds = time.perf_counter() - clock
    if not at.lin.finite:
        raise ValueError("drift, diffusion, penalty or terminal is not finite along the guess")
    K, n = at.lin.defect.shape
    adjoint, terminal, multiplier = np.zeros((K, n)), np.zeros(len(at.lin.g)), 0.0
    rho = _MIN_RHO
    last_step = np.inf

    def outcome(status: Status, message: str = "") -> Outcome:
        return Outcome(status, at.lin, adjoint, terminal, multiplier, tuple(history), message)

    for _ in range(settings.max_iterations):
        clock = time.perf_counter()
        sub, found, radius = _solve(model, solver, trust, settings, at, rho)
        solved = time.perf_counter()
        if not found.found:
            # A shorter step is an easier sub-problem; a schedule that knows none gives up.
            trust.judge(Step(np.nan, 0.0, -np.inf, np.inf, np.inf))
            if trust.collapsed:
                return outcome(Status.SOLVER_FAILED, found.message)
            continue
        new_x = at.lin.x.copy()
        new_x[1:] += found.d
        new = _iterate_at(model, settings, new_x, at.lin.u + found.e)
        before = _merit(settings, at, found, rho)
        after = _merit(settings, new, found, rho)
        actual = before - after if new.lin.finite and np.isfinite(after) else -np.inf
        predicted = before - _model_merit(model, settings, at, sub, found)
        used = trust.multiplier
        accepted = trust.judge(Step(radius, max(predicted, 0.0), actual, after, before))
        step = float(np.einsum("k,ki,ki", model.dt, found.e, found.e))
        done = time.perf_counter()
        history.append(
            Iteration(
                mean=new.lin.x,
                controls=new.lin.u,
                effort=new.lin.effort,
                penalty=new.lin.penalty,
                variance=np.nan if new.variance is None else _trace(settings, new),
                merit=after,
                predicted=predicted,
                actual=actual,
                step=step,
                trust_radius=radius,
                trust_multiplier=used,
                virtual_control=sub.virtual_control(found.d),
                defect=float(np.max(np.abs(new.lin.defect))),
                terminal_residual=float(np.max(np.abs(new.lin.g), initial=0.0)),
                terminal_multiplier=found.terminal,
                accepted=accepted,
                solver_iterations=found.iterations,
                linearize_seconds=linearize_seconds + done - solved,
                solve_seconds=solved - clock,
            )
        )
        linearize_seconds = 0.0
        stop = settings.callback is not None and settings.callback(history[-1])
        if accepted:
            at, adjoint, terminal, multiplier = new, found.adjoint, found.terminal, used
            # Where a trust region is needed to the end, a short step proves nothing by itself:
            # the force it stands for, p¹ (x − x_k), must vanish too.
            step += used**2 * radius
            if step + last_step <= settings.tolerance:
                lacking = sub.virtual_control(found.d) / (1.0 + float(np.max(np.abs(at.lin.x))))
                if lacking <= _FEASIBILITY:
                    return outcome(Status.CONVERGED)
                if rho >= _MAX_RHO:
                    return outcome(Status.INFEASIBLE)
                rho, step = 10.0 * rho, np.inf
            last_step = step
        elif trust.collapsed:
            return outcome(Status.STALLED)
        if stop:
            return outcome(Status.STOPPED)
    return outcome(Status.MAX_ITERATIONS)


def _iterate_at(model: Model, settings: Settings, x: Array, u: Array) -> _Iterate:
    lin = linearize(model, x, u)
    return _Iterate(lin, _variance(model, lin, settings.variance_weight), None)


def _variance(model: Model, lin: Linearization, weight: float) -> moments.Variance | None:
    if weight == 0.0:
        return None
    d_sigma = np.asarray(model.diffusion_jacobian(model.times[:-1], lin.x[:-1]))
    Lambda = moments.adjoint_weights(lin.A, model.dt)
    return moments.variance_penalty(weight, lin.sigma, d_sigma, Lambda, model.dt)


def _trace(settings: Settings, at: _Iterate) -> float:
    return at.variance_value() / settings.variance_weight


def _solve(
    model: Model,
    solver: Solver,
    trust: TrustRegion,
    settings: Settings,
    at: _Iterate,
    rho: float,
) -> tuple[Subproblem, Solution, float]:
    """Solve the sub-problem within the trust region: with the multiplier it asks for."""
    weight: Array | None = None
    for _ in range(60):
        if weight is None and trust.multiplier > 0.0:
            weight = _trust_weight(model, settings, at)
        sub = convexify(
            model,
            at.lin,
            variance=at.variance,
            composite=settings.composite,
            trust_multiplier=trust.multiplier,
            trust_weight=weight,
            rho=rho,
            tolerance=settings.terminal_tolerance,
        )
        found = solver.solve(sub)
        if not found.found:
            return sub, found, np.nan
        if weight is None:
            radius = float(np.einsum("k,ki,ki", model.dt, found.d, found.d))
        else:
            radius = 0.5 * float(np.einsum("ki,kij,kj", found.d, weight, found.d))
        if trust.fits(radius):
            break
    return sub, found, radius


def _trust_weight(model: Model, settings: Settings, at: _Iterate) -> Array:
    # The variance penalty is the same quadratic, but for its weight.
    variance, weight = at.variance, settings.variance_weight
    if variance is None:
        variance, weight = _variance(model, at.lin, 1.0), 1.0
    assert variance is not None
    return moments.trust_region_weight(variance.hessian / weight, model.dt)


def _merit(settings: Settings, at: _Iterate, found: Solution, rho: float) -> float:
    """Φ with the multipliers of the sub-problem at hand; see the module's docstring."""
    lin = at.lin
    beyond = lin.g - np.clip(lin.g, -settings.terminal_tolerance, settings.terminal_tolerance)
    price = 0.5 * float(np.max(np.abs(found.adjoint)))
    return (
        lin.effort
        + lin.penalty
        + at.variance_value()
        + float(np.sum(found.adjoint * lin.defect) + price * np.sum(np.abs(lin.defect)))
        + rho * float(np.sum(np.abs(beyond)))
    )


def _model_merit(
    model: Model, settings: Settings, at: _Iterate, sub: Subproblem, found: Solution
) -> float:
    """Merit of the step by the convex model: no defects, the trust region's term left out."""
    u = at.lin.u + found.e
    value = float(np.einsum("k,ki,ij,kj", model.dt, u, model.R, u))
    value += sub.rho * sub.virtual_control(found.d)
    if at.variance is not None:
        d = found.d[:-1]
        value += at.variance.value + float(np.sum(at.variance.gradient[1:] * d))
        value += 0.5 * float(np.einsum("ki,kij,kj", d, at.variance.hessian[1:], d))
    if settings.composite:
        c = np.maximum(np.einsum("kpn,kn->kp", sub.a, found.d) + sub.b, 0.0)
        value += 0.5 * float(np.sum(sub.h * c**2))
    else:
        value += at.lin.penalty
        slope = 2.0 * model.dt[:, None] * model.weight * np.maximum(at.lin.c, 0.0)
        value += float(np.einsum("kp,kpn,kn", slope, at.lin.C, found.d))
    return value

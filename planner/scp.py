"""The stochastic SCP iteration (paper §3.1): linearise, solve LOCP_{k+1}, judge the step.

    repeat   linearise at (u_k, μ_k)            convexify.linearize
             moments and their sensitivities    moments
             solve the convex sub-problem       backends
             accept or shorten                  trust_region
    until    ∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt ≤ tolerance

and the mean is, to first order, what the controls do: over long horizons and for cheap controls
the step alone says little about the path.

The merit function that steps are judged by is

    Φ = effort + penalty + w ∫ tr Σ dt + Σ λᵀf + ½ max|λ| ‖f‖₁ + νᵀg + ½ max|ν| ‖g‖₁

with f the defects of the non-linear dynamics, g the terminal residual (beyond its tolerance) and
λ, ν their multipliers from the sub-problem. Pricing them by multipliers, with their signs, is
what keeps good steps from being rejected near the solution (Maratos): the defect that a step
leaves is of second order, and so is its gain. While something is lacking (ν at its limit ρ) the
last two terms are ρ ‖g‖₁.
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

#: Weight of the terminal penalty at first, per unit of the multiplier it must exceed; how often
#: it is raised tenfold; and the part of the virtual control that this must remove to go on.
_FIRST_RHO, _RAISES, _WORTHWHILE = 1e3, 3, 0.01
#: A converged plan leaves no more than this of the terminal condition, per unit of the state,
_FEASIBILITY = 1e-6
#: and no more than this between its mean and the path that its controls lead to.
_CONSISTENCY = 1e-4
#: Steps to where the model is not finite are rejected: no warning is needed on the way.
_quiet = np.errstate(over="ignore", invalid="ignore", divide="ignore")


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
        trust_radius: ∫ E‖x − x_k‖² dt; its mean's part alone while no trust region acts.
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
    first_rho = _FIRST_RHO * max(1.0, _terminal_force(model, at.lin))
    rho, raises, lacked = first_rho, 0, np.inf
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
        step = float(np.vdot(model.dt[:, None] * found.e, found.e))
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
            size = 1.0 + float(np.max(np.abs(at.lin.x)))
            lacking = sub.virtual_control(found.d)
            feasible = lacking <= _FEASIBILITY * size
            # Where a trust region is needed to the end, a short step proves nothing by itself:
            # the force it stands for, p¹ (x − x_k), must vanish too (beside that of the terminal
            # penalty, where it is at its limit).
            step += (used if feasible else used * first_rho / rho) ** 2 * radius
            settled = step + last_step <= settings.tolerance
            if settled and _inconsistency(settings, at.lin, lacking) <= _CONSISTENCY * size:
                if feasible:
                    return outcome(Status.CONVERGED)
                if raises == _RAISES or lacking > (1.0 - _WORTHWHILE) * lacked:
                    return outcome(Status.INFEASIBLE)
                rho, raises, lacked, step = 10.0 * rho, raises + 1, lacking, np.inf
            last_step = step
        elif trust.collapsed:
            return outcome(Status.STALLED)
        if stop:
            return outcome(Status.STOPPED)
    return outcome(Status.MAX_ITERATIONS)


@_quiet
def _terminal_force(model: Model, at: Linearization) -> float:
    """How large a multiplier moves the linearised end to where it shall be, at least.

    With W = Σ Φ_k B_k (2 dt R)⁻¹ B_kᵀ Φ_kᵀ the controllability Gramian seen by G, a change γ of
    the end at least cost takes W ν = γ, so ‖ν‖ ≥ ‖γ‖ / λ_max(W). This sets the scale of the
    terminal penalty, whatever the units of states and costs.
    """
    Phi = np.empty((len(at.A), *at.G.shape))  # G Φ_k: what arrives at node k + 1 does at the end
    Phi[-1] = at.G
    for k in range(len(at.A) - 1, 0, -1):
        Phi[k - 1] = Phi[k].dot(at.A[k])
    missing = at.g + np.einsum("kqi,ki->q", Phi, at.defect)
    pushed = Phi @ at.B
    W = np.einsum("kqi,ij,krj,k->qr", pushed, np.linalg.inv(2.0 * model.R), pushed, 1.0 / model.dt)
    strength = float(np.max(np.linalg.eigvalsh(W), initial=0.0)) if np.isfinite(W).all() else 0.0
    return float(np.linalg.norm(missing)) / strength if strength > 0.0 else 0.0


def _inconsistency(settings: Settings, at: Linearization, lacking: float) -> float:
    """How far, to first order, the mean is from the path that the controls lead to.

    The defects carried forward along the linearised dynamics; and the terminal residual beyond
    what the sub-problem said is lacking.
    """
    gap, worst = np.zeros(at.x.shape[1]), 0.0
    for A, defect in zip(at.A, at.defect, strict=True):
        gap = A.dot(gap) + defect
        worst = max(worst, np.abs(gap).max())
    beyond = np.maximum(np.abs(at.g) - settings.terminal_tolerance, 0.0)
    return max(worst, abs(float(beyond.sum()) - lacking))


@_quiet
def _iterate_at(model: Model, settings: Settings, x: Array, u: Array) -> _Iterate:
    lin = linearize(model, x, u)
    return _Iterate(lin, _variance(model, lin, settings.variance_weight))


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
        if weight is None and (trust.multiplier > 0.0 or trust.limits_radius):
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


@_quiet
def _merit(settings: Settings, at: _Iterate, found: Solution, rho: float) -> float:
    """Φ with the multipliers of the sub-problem at hand; see the module's docstring."""
    lin = at.lin
    beyond = lin.g - np.clip(lin.g, -settings.terminal_tolerance, settings.terminal_tolerance)
    price = 0.5 * float(np.max(np.abs(found.adjoint)))
    nu, size = found.terminal, float(np.max(np.abs(found.terminal), initial=0.0))
    lacking = size > 0.5 * rho
    terminal = 0.0 if lacking else np.vdot(nu, beyond)
    terminal += (rho if lacking else 0.5 * size) * np.abs(beyond).sum()
    return (
        lin.effort
        + lin.penalty
        + at.variance_value()
        + float(np.vdot(found.adjoint, lin.defect) + price * np.abs(lin.defect).sum())
        + float(terminal)
    )


@_quiet
def _model_merit(
    model: Model, settings: Settings, at: _Iterate, sub: Subproblem, found: Solution
) -> float:
    """Merit of the step by the convex model: no defects, the trust region's term left out."""
    u = at.lin.u + found.e
    value = float(np.vdot(model.dt[:, None] * u, u @ model.R))
    value += sub.rho * sub.virtual_control(found.d)
    if at.variance is not None:
        d = found.d[:-1]
        value += at.variance.value + float(np.sum(at.variance.gradient[1:] * d))
        value += 0.5 * float(np.einsum("ki,kij,kj", d, at.variance.hessian[1:], d))
    if settings.composite:
        c = np.maximum((sub.a @ found.d[..., None])[..., 0] + sub.b, 0.0)
        value += 0.5 * float(np.vdot(sub.h, c * c))
    else:
        value += at.lin.penalty
        slope = 2.0 * model.dt[:, None] * model.weight * np.maximum(at.lin.c, 0.0)
        value += float(np.einsum("kp,kpn,kn", slope, at.lin.C, found.d))
    return value

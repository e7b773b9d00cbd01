"""The stochastic SCP iteration (paper §3.1): linearise, solve LOCP_{k+1}, judge the step.

    repeat   linearise at (u_k, μ_k)            convexify.linearize
             moments and their sensitivities    moments
             solve the convex sub-problem       backends
             accept or shorten                  trust_region
    until    ∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt ≤ tolerance

and the mean is, to first order, what the controls do: over long horizons and for cheap controls
the step alone says little about the path.

Steps are long at first: they find a way round the obstacles. The linearisation is then crude, and
limits on the controls would make it saturate them, up to paths from which no way leads on: they
act from when steps have become short. Should the iteration settle all the same where the terminal
condition cannot be met, it is run once more, with limits and short steps from the beginning. At
the end, where convergence is linear, steps are lengthened or combined (:mod:`.acceleration`).
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np

from slipcar.planner.convex.acceleration import Acceleration
from slipcar.planner.convex.convexify import Subproblem, convexify
from slipcar.planner.convex.merit import (
    Iterate,
    iterate_at,
    lagrangian,
    merit,
    model_merit,
    variance_of,
)
from slipcar.planner.convex.solvers import Solution, Solver
from slipcar.planner.convex.trust_region import Step, TrustRegion
from slipcar.planner.history import Iteration
from slipcar.planner.moments import covariance as moments
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.feasibility import (
    FEASIBILITY,
    inconsistency,
    not_finite,
    terminal_force,
    what_lacks,
)
from slipcar.planner.problem.linearization import Linearization, linearize
from slipcar.planner.problem.model import Model
from slipcar.planner.status import Status

Array = np.ndarray

#: Weight of the terminal penalty at first, per unit of the multiplier it must exceed; how often
#: it is raised tenfold; and the part of the virtual control that this must remove to go on.
_FIRST_RHO, _RAISES, _WORTHWHILE = 1e3, 3, 0.01
#: A converged plan leaves no more than this between its mean and the path that its controls
#: lead to, per unit of the state.
_CONSISTENCY = 1e-4
#: Control bounds act once ∫ ‖u_{k+1} − u_k‖² dt is this small beside ∫ ‖u_{k+1}‖² dt.
_SHORT = 0.03


def iterate(
    model: Model, solver: Solver, trust: TrustRegion, options: Options, x: Array, u: Array
) -> Outcome:
    """Run the loop from the guess x (N, n), u (N−1, m).

    Raises:
        ValueError: if the model functions are not finite along the guess.
    """
    bold = _attempt(model, solver, trust, options, x, u)
    left = options.max_iterations - len(bold.history)
    if bold.status is not Status.INFEASIBLE or left <= 0:
        return bold
    first = bold.history[0]
    second = trust.cautious(first.predicted / max(first.trust_radius, 1e-300))
    if second is None:
        return bold
    options = dataclasses.replace(options, max_iterations=left)
    careful = _attempt(model, solver, second, options, x, u)
    off = [
        inconsistency(linearize(model, found.x, found.u), options.terminal_tolerance)
        for found in (careful, bold)
    ]
    better = careful.status.ok or careful.status is Status.STOPPED or off[0] < off[1]
    history = (*bold.history, *careful.history)
    best = careful if better else bold
    return dataclasses.replace(best, iterations=len(history), history=history)


def _attempt(
    model: Model, solver: Solver, trust: TrustRegion, options: Options, x: Array, u: Array
) -> Outcome:
    """One run of the loop; see :func:`iterate`."""
    history: list[Iteration] = []
    clock = time.perf_counter()
    at = iterate_at(model, options.variance_weight, x, u)
    linearize_seconds = time.perf_counter() - clock
    if not at.lin.finite:
        raise ValueError(f"{not_finite(at.lin)} is not finite along the guess")
    K, n = at.lin.defect.shape
    adjoint, terminal, multiplier = np.zeros((K, n)), np.zeros(len(at.lin.g)), 0.0
    first_rho = _FIRST_RHO * max(1.0, terminal_force(model, at.lin))
    rho, raises, lacked = first_rho, 0, np.inf
    last_step, tau = np.inf, options.terminal_tolerance

    acceleration = Acceleration(model.dt)
    # While steps are long: see the module's docstring.
    relaxed = _relaxed(model) if trust.bold and (model.bounded or model.radius < np.inf) else None

    def outcome(status: Status, message: str = "") -> Outcome:
        nonlocal at
        if not status.ok and not np.array_equal(inside := model.admissible(at.lin.u), at.lin.u):
            at = iterate_at(model, options.variance_weight, at.lin.x, inside)
        return Outcome.at(
            at.lin,
            model,
            options.variance_weight,
            status=status,
            adjoint=adjoint,
            terminal=terminal,
            history=tuple(history),
            trust_multiplier=multiplier,
            message=message,
        )

    composite = options.linearization == "composite"
    for _ in range(options.max_iterations):
        clock = time.perf_counter()
        sub, found, radius = _solve(relaxed or model, solver, trust, options, at, rho)
        solved = time.perf_counter()
        if not found.found:
            # A shorter step is an easier sub-problem; a schedule that knows none gives up.
            relaxed = None
            trust.judge(Step(np.nan, 0.0, -np.inf, np.inf, np.inf))
            if trust.collapsed:
                return outcome(Status.SOLVER_FAILED, found.message)
            continue
        new_x = at.lin.x.copy()
        new_x[1:] += found.d
        before = merit(at, found, tau, rho)
        predicted = before - model_merit(model, at, sub, found, composite=composite)
        used = trust.multiplier
        step = float(np.vdot(model.dt[:, None] * found.e, found.e))
        new = iterate_at(model, options.variance_weight, new_x, at.lin.u + found.e)
        after = merit(new, found, tau, rho)
        accelerated = False
        far = step + last_step > options.tolerance
        eligible = far and trust.accelerates and relaxed is None and used == 0.0
        if eligible and acceleration.observe(at.lin.u, new_x, found.e):
            plain = lagrangian(new, found, tau)
            here = lagrangian(at, found, tau)
            ratio = (here - plain) / max(predicted - before + here, 1e-300)
            for x, u in acceleration.propose(at.lin.x, at.lin.u, ratio):
                other = iterate_at(model, options.variance_weight, x, model.admissible(u))
                value = merit(other, found, tau, rho)
                accelerated = (
                    other.lin.finite
                    and (trust.bold or value < before)
                    and lagrangian(other, found, tau) < plain
                )
                if accelerated:
                    new, after = other, value
                    break
        actual = before - after if new.lin.finite and np.isfinite(after) else -np.inf
        accepted = trust.judge(Step(radius, max(predicted, 0.0), actual, after, before))
        if not accepted or trust.multiplier > 0.0:
            acceleration.forget()
        done = time.perf_counter()
        history.append(
            Iteration(
                mean=new.lin.x,
                controls=new.lin.u,
                effort=new.lin.effort,
                penalty=new.lin.penalty,
                running=new.lin.running,
                variance=np.nan
                if new.variance is None
                else new.variance.total / options.variance_weight,
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
        if relaxed is not None and not (accepted and _still_bold(model, trust, new.lin, step)):
            relaxed = None
            if not np.array_equal(model.admissible(new.lin.u), new.lin.u):
                step = np.inf  # by steps that do not count: they paid no heed to the bounds
        stop = options.callback is not None and options.callback(history[-1])
        if accepted:
            at, adjoint, terminal, multiplier = new, found.adjoint, found.terminal, used
            size = 1.0 + float(np.max(np.abs(at.lin.x)))
            lacking = sub.virtual_control(found.d)
            feasible = lacking <= FEASIBILITY * size
            # Where a trust region is needed to the end, a short step proves nothing by itself:
            # the force it stands for, p¹ (x − x_k), must vanish too (beside that of the terminal
            # penalty, where it is at its limit).
            step += (used if feasible else used * first_rho / rho) ** 2 * radius
            settled = step + last_step <= options.tolerance
            if settled and inconsistency(at.lin, tau, lacking) <= _CONSISTENCY * size:
                if feasible:
                    return outcome(Status.CONVERGED)
                if raises == _RAISES or lacking > (1.0 - _WORTHWHILE) * lacked:
                    return outcome(Status.INFEASIBLE, what_lacks(at.lin, tau, size))
                acceleration.forget()
                rho, raises, lacked, step = 10.0 * rho, raises + 1, lacking, np.inf
            last_step = step
        elif trust.collapsed:
            return outcome(Status.STALLED)
        if stop:
            return outcome(Status.STOPPED)
    return outcome(Status.MAX_ITERATIONS)


def _relaxed(model: Model) -> Model:
    """The problem without limits on its controls."""
    inf = np.full(model.control_dim, np.inf)
    return dataclasses.replace(model, lower=-inf, upper=inf, radius=np.inf)


def _still_bold(model: Model, trust: TrustRegion, at: Linearization, step: float) -> bool:
    """Whether the next step may still pass the control bounds."""
    size = float(np.vdot(model.dt[:, None] * at.u, at.u))
    return trust.bold and step > _SHORT * size


def _solve(
    model: Model,
    solver: Solver,
    trust: TrustRegion,
    options: Options,
    at: Iterate,
    rho: float,
) -> tuple[Subproblem, Solution, float]:
    """Solve the sub-problem within the trust region: with the multiplier it asks for."""
    weight: Array | None = None
    for _ in range(60):
        if weight is None and (trust.multiplier > 0.0 or trust.limits_radius):
            weight = _trust_weight(model, options, at)
        sub = convexify(
            model,
            at.lin,
            variance=at.variance,
            composite=options.linearization == "composite",
            trust_multiplier=trust.multiplier,
            trust_weight=weight,
            rho=rho,
            tolerance=options.terminal_tolerance,
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


def _trust_weight(model: Model, options: Options, at: Iterate) -> Array:
    # The variance penalty is the same quadratic, but for its weight.
    variance, weight = at.variance, options.variance_weight
    if variance is None:
        variance, weight = variance_of(model, at.lin, 1.0), 1.0
    assert variance is not None
    return moments.trust_region_weight(variance.hessian / weight, model.dt)

"""The stochastic SCP iteration (paper §3.1): linearise, solve LOCP_{k+1}, judge the step.

    repeat   linearise at (u_k, μ_k)            problem.linearization, moments
             solve the convex sub-problem       subproblem, solvers
             accept or shorten                  merit, trust_region
    until    ∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt ≤ tolerance ∫ ‖u_k‖² dt,  ‖u‖² = uᵀRu

and the mean is, to first order, what the controls do: over long horizons and for cheap controls
the step alone says little about the path.

Steps are long at first: they find a way round the obstacles. The linearisation is then crude, and
limits on the controls would make it saturate them, up to paths from which no way leads on: they
act from when steps have become short. Should the iteration settle all the same where the terminal
condition cannot be met, it is run once more, with limits and short steps from the beginning. At
the end, where convergence is linear, steps are lengthened or combined (:mod:`.acceleration`).

Under the adaptive trust region all of this happens in units of the problem's own size
(:mod:`.units`); the paper's, which is a number of the user's, is in the user's.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np

from slipcar.planner.convex.acceleration import Acceleration
from slipcar.planner.convex.merit import Iterate, Merit, iterate_at
from slipcar.planner.convex.solvers.interface import Solution, Solver
from slipcar.planner.convex.subproblem import convexify, variance_of
from slipcar.planner.convex.trust_region import Step, TrustRegion
from slipcar.planner.convex.units import ScaledModel, identity_units, natural_units, scaled
from slipcar.planner.moments import covariance as moments
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem import feasibility
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import Model
from slipcar.planner.records import Iteration
from slipcar.planner.status import Status

Array = np.ndarray

#: Weight of the terminal penalty at first, per unit of the multiplier it must exceed; how often
#: it is raised tenfold; and the part of the virtual control that this must remove to go on.
_FIRST_RHO, _RAISES, _WORTHWHILE = 1e3, 3, 0.01
#: A converged plan leaves no more than this between its mean and the path that its controls
#: lead to, relative to how far each state moves.
_CONSISTENCY = 1e-4
#: Control bounds act once ∫ ‖u_{k+1} − u_k‖² dt is this small beside ∫ ‖u_{k+1}‖² dt.
_SHORT = 0.03
#: Multipliers tried, at most, for a step that fits its trust region.
_TRIES = 60


def iterate(
    model: Model, solver: Solver, trust: TrustRegion, options: Options, x: Array, u: Array
) -> Outcome:
    """Run the loop from the guess x (N, n), u (N−1, m).

    Raises:
        ValueError: if the model functions are not finite along the guess.
    """
    box = options.terminal_tolerance > 0.0
    units = natural_units(model, x, u, box=box) if trust.scaled else identity_units(model, x)
    there = scaled(model, units)
    bold = _Attempt(there, solver, trust, options, x, u).run()
    left = options.max_iterations - len(bold.history)
    if bold.status is not Status.INFEASIBLE or left <= 0:
        return bold
    opening = bold.history[0]
    promised = opening.predicted / units.cost
    cautious = trust.cautious(promised / max(opening.trust_radius, 1e-300))
    if cautious is None:
        return bold
    options = dataclasses.replace(options, max_iterations=left)
    careful = _Attempt(there, solver, cautious, options, x, u).run()
    off_careful, off_bold = (
        max(
            feasibility.inconsistency(at),
            feasibility.lacks(at, options.terminal_tolerance).max(initial=0.0),
        )
        for at in (linearize(model, end.x, end.u) for end in (careful, bold))
    )
    better = careful.status in (Status.CONVERGED, Status.STOPPED) or off_careful < off_bold
    history = (*bold.history, *careful.history)
    best = careful if better else bold
    return dataclasses.replace(best, iterations=len(history), history=history)


@dataclasses.dataclass(frozen=True)
class _Proposal:
    """A sub-problem's solution."""

    solution: Solution
    beyond: Array  # what each terminal condition lacks, (q,)
    radius: float  # ∫ E‖x − x_k‖² dt of the step; its mean's part while no trust region acts
    multiplier: float  # of the trust region, −p¹
    step: float  # ∫ ‖u_{k+1} − u_k‖² dt
    length: float  # the same in the norm of R
    short: float  # what the solution leaves of the terminal condition, relative

    @property
    def lacking(self) -> float:
        """Its virtual control."""
        return float(self.beyond.sum())


@dataclasses.dataclass(frozen=True)
class _Candidate:
    """What the non-linear problem makes of a proposal."""

    at: Iterate
    merit: float
    before: float  # Φ at the iterate
    predicted: float  # decrease of Φ by the model
    actual: float  # decrease of Φ, −∞ where something is not finite


class _Attempt:
    """One run of the loop: the iterate, its multipliers, and what has been tried.

    The guess is in the user's units, as are the outcome and the history; all else in the model's.
    """

    def __init__(
        self,
        model: ScaledModel,
        solver: Solver,
        trust: TrustRegion,
        options: Options,
        x: Array,
        u: Array,
    ) -> None:
        self.model, self.solver, self.trust, self.asked = model, solver, trust, options
        units = model.units
        self.options = options = dataclasses.replace(
            options, variance_weight=options.variance_weight * units.time / units.cost,
            terminal_tolerance=options.terminal_tolerance / units.end.max(initial=1e-300),
        )  # fmt: skip
        self.composite = options.linearization == "composite"
        clock = time.perf_counter()
        self.at = iterate_at(model, options.variance_weight, x / units.state, u / units.control)
        self.linearize_seconds = time.perf_counter() - clock
        lin = self.at.lin
        if not lin.finite:
            raise ValueError(feasibility.not_finite(model.original, x, u))
        self.adjoint, self.terminal = np.zeros(lin.defect.shape), np.zeros(lin.g.shape)
        self.trust_multiplier = 0.0
        self.rho = self.first_rho = _FIRST_RHO * max(1.0, feasibility.terminal_force(model, lin))
        self.raises, self.lacked, self.last_step = 0, np.inf, np.inf
        self.acceleration = Acceleration(model.dt)
        self.history: list[Iteration] = []
        # While steps are long the controls have no limits: see the module's docstring.
        self.relaxed: Model | None = None
        if trust.bold and (model.bounded or model.radius < np.inf):
            inf = np.full(model.control_dim, np.inf)
            self.relaxed = dataclasses.replace(model, lower=-inf, upper=inf, radius=np.inf)

    def run(self) -> Outcome:
        """Iterate to the end."""
        trust, options = self.trust, self.options
        for _ in range(options.max_iterations):
            clock = time.perf_counter()
            proposal = self.solve()
            solved = time.perf_counter()
            if not proposal.solution.found:
                # A shorter step is an easier sub-problem; a schedule that knows none gives up.
                self.relaxed = None
                trust.judge(Step(np.nan, 0.0, -np.inf, np.inf))
                if trust.collapsed:
                    return self.outcome(Status.SOLVER_FAILED, proposal.solution.message)
                continue
            new = self.evaluate(proposal)
            promised = max(new.predicted, 0.0)
            accepted = trust.judge(Step(proposal.radius, promised, new.actual, new.before))
            if not accepted or trust.multiplier > 0.0:
                self.acceleration.forget()
            seconds = self.linearize_seconds + time.perf_counter() - solved, solved - clock
            self.linearize_seconds = 0.0
            self.history.append(self.record(proposal, new, accepted, seconds))
            unlimited = self.limit_controls(proposal, new, accepted)
            stop = options.callback is not None and options.callback(self.history[-1])
            if accepted:
                status = self.accept(proposal, new, np.inf if unlimited else proposal.length)
                if status is not None:
                    return self.outcome(status)
            elif trust.collapsed:
                return self.outcome(Status.STALLED)
            if stop:
                return self.outcome(Status.STOPPED)
        return self.outcome(Status.MAX_ITERATIONS)

    def solve(self) -> _Proposal:
        """Solve the sub-problem with the multiplier that the trust region asks for."""
        model, options, trust = self.relaxed or self.model, self.options, self.trust
        lin, weight = self.at.lin, None
        for _ in range(_TRIES):
            if weight is None and (trust.multiplier > 0.0 or trust.limits_radius):
                weight = self.trust_weight()
            multiplier = trust.multiplier
            sub = convexify(
                model, lin, variance=self.at.variance, composite=self.composite,
                trust_multiplier=multiplier, trust_weight=weight,
                rho=self.rho, tolerance=options.terminal_tolerance,
            )  # fmt: skip
            solution = self.solver.solve(sub)
            if not solution.found:
                return _Proposal(solution, lin.g, np.nan, multiplier, np.nan, np.nan, np.nan)
            d = solution.d
            if weight is None:
                radius = float(np.vdot(model.dt[:, None] * d, d))
            else:
                radius = 0.5 * float(np.vdot(d, np.matmul(weight, d[..., None])[..., 0]))
            if trust.fits(radius):
                break
        e = model.dt[:, None] * solution.e
        step, length = float(np.vdot(e, solution.e)), float(np.vdot(e @ model.R, solution.e))
        g = lin.g + lin.G @ d[-1]
        short = feasibility.lacks(lin, options.terminal_tolerance, g).max(initial=0.0)
        beyond = np.maximum(np.abs(g) - options.terminal_tolerance, 0.0)
        return _Proposal(solution, beyond, radius, multiplier, step, length, float(short))

    def trust_weight(self) -> Array:
        """Hessian blocks of ∫ E‖x − x_k‖² dt: those of the variance penalty with weight one."""
        lin, dt = self.at.lin, self.model.dt
        variance = variance_of(self.model, lin, 1.0, moments.adjoint_weights(lin.A, dt))
        assert variance is not None
        return moments.trust_region_weight(variance.hessian, dt)

    def evaluate(self, proposal: _Proposal) -> _Candidate:
        """Where the step leads, lengthened or combined with others if they have become slow."""
        model, options, trust = self.model, self.options, self.trust
        lin, solution = self.at.lin, proposal.solution
        x = lin.x.copy()
        x[1:] += solution.d
        merit = Merit(self.at, solution, options.terminal_tolerance, self.rho)
        before = merit(self.at)
        # Φ by the model, which leaves no defects; the literal one holds only changes of penalties.
        constant = self.at.smooth_cost + (0.0 if self.composite else lin.penalty)
        promised = constant + solution.objective - proposal.multiplier * proposal.radius
        predicted = before - promised
        new = iterate_at(model, options.variance_weight, x, lin.u + solution.e)
        far = proposal.length + self.last_step > options.tolerance * lin.effort
        free = trust.accelerates and self.relaxed is None and proposal.multiplier == 0.0
        if far and free and self.acceleration.observe(lin.u, x, solution.e):
            new = self.accelerated(new, merit, before, predicted)
        after = merit(new)
        actual = before - after if np.isfinite(after) and new.lin.finite else -np.inf
        return _Candidate(new, after, before, predicted, actual)

    def accelerated(self, new: Iterate, merit: Merit, before: float, predicted: float) -> Iterate:
        """A better iterate than `new` along or between the last steps; `new` if there is none."""
        lin, plain, here = self.at.lin, merit.lagrangian(new), merit.lagrangian(self.at)
        ratio = (here - plain) / max(predicted - before + here, 1e-300)
        for x, u in self.acceleration.propose(lin.x, lin.u, ratio):
            u = self.model.admissible(u)
            other = iterate_at(self.model, self.options.variance_weight, x, u)
            lower = self.trust.bold or merit(other) < before
            if other.lin.finite and lower and merit.lagrangian(other) < plain:
                return other
        return new

    def limit_controls(self, proposal: _Proposal, new: _Candidate, accepted: bool) -> bool:
        """Let bounds act once steps are short; whether they take this one back.

        Such a step says nothing of convergence.
        """
        u = new.at.lin.u
        if self.relaxed is None:
            return False
        effort = float(np.vdot(self.model.dt[:, None] * u, u))
        if accepted and self.trust.bold and proposal.step > _SHORT * effort:
            return False
        self.relaxed = None
        return not np.array_equal(self.model.admissible(u), u)

    def accept(self, proposal: _Proposal, new: _Candidate, step: float) -> Status | None:
        """Go to the new iterate; CONVERGED or INFEASIBLE if the iteration has settled there."""
        self.at, self.trust_multiplier = new.at, proposal.multiplier
        self.adjoint, self.terminal = proposal.solution.adjoint, proposal.solution.terminal
        lacking, lin = proposal.lacking, self.at.lin
        feasible = proposal.short <= feasibility.FEASIBILITY
        # Where a trust region is needed to the end, a short step proves nothing by itself:
        # the force it stands for, p¹ (x − x_k), must vanish too (beside that of the terminal
        # penalty, where it is at its limit).
        force = proposal.multiplier * (1.0 if feasible else self.first_rho / self.rho)
        step += force * force * proposal.radius
        settled = step + self.last_step <= self.options.tolerance * lin.effort
        self.last_step = step
        if not settled:
            return None
        tau = self.options.terminal_tolerance
        if not feasibility.inconsistency(lin) <= _CONSISTENCY:
            return None
        if feasible:
            met = feasibility.lacks(lin, tau).max(initial=0.0) <= feasibility.FEASIBILITY
            return Status.CONVERGED if met else None
        beyond = float(np.maximum(np.abs(lin.g) - tau, 0.0).sum())
        if not abs(beyond - lacking) <= _CONSISTENCY * lacking:
            return None
        if self.raises == _RAISES or lacking > (1.0 - _WORTHWHILE) * self.lacked:
            return Status.INFEASIBLE
        self.acceleration.forget()
        self.rho, self.raises, self.lacked = 10.0 * self.rho, self.raises + 1, lacking
        self.last_step = np.inf
        return None

    def record(
        self, proposal: _Proposal, new: _Candidate, accepted: bool, seconds: tuple[float, float]
    ) -> Iteration:
        """A row of the history, with seconds of linearising and of solving."""
        lin, variance, solution, units = (
            new.at.lin,
            new.at.variance,
            proposal.solution,
            self.model.units,
        )
        spread = np.nan if variance is None else variance.total / self.options.variance_weight
        e, kappa = units.control * solution.e, units.cost
        return Iteration(
            mean=units.state * lin.x, controls=units.control * lin.u,
            effort=kappa * lin.effort, penalty=kappa * lin.penalty, running=kappa * lin.running,
            variance=units.time * spread,
            merit=kappa * new.merit, predicted=kappa * new.predicted, actual=kappa * new.actual,
            step=float(np.vdot(self.model.original.dt[:, None] * e, e)),
            trust_radius=proposal.radius, trust_multiplier=kappa * proposal.multiplier,
            virtual_control=float(units.end @ proposal.beyond),
            defect=float(np.abs(units.state * lin.defect).max()),
            terminal_residual=float(np.abs(units.end * lin.g).max(initial=0.0)),
            terminal_multiplier=kappa / units.end * solution.terminal,
            accepted=accepted, solver_iterations=solution.iterations,
            linearize_seconds=seconds[0], solve_seconds=seconds[1],
        )  # fmt: skip

    def outcome(self, status: Status, message: str = "") -> Outcome:
        """What has been reached, with controls that are admissible however it ended."""
        units, model, asked = self.model.units, self.model.original, self.asked
        x, u = units.state * self.at.lin.x, model.admissible(units.control * self.at.lin.u)
        x[0] = model.start
        lin = linearize(model, x, u)
        if status is Status.INFEASIBLE:
            named = feasibility.what_lacks(lin, asked.terminal_tolerance)
            message = f"the terminal condition is out of reach; nearest path: {named}"
        kappa = units.cost
        return Outcome.at(
            lin, model, asked.variance_weight, status=status, history=tuple(self.history),
            adjoint=kappa / units.state * self.adjoint, terminal=kappa / units.end * self.terminal,
            trust_multiplier=kappa * self.trust_multiplier, message=message,
        )  # fmt: skip

"""SCP with one LQ problem per iteration and the curvature of the Lagrangian.

Each iteration solves one quadratic model, cut down to what is smooth at the iterate:

* the hinges max(0, c)² that are on at the iterate are squares, the others are off. That is the
  gradient at the iterate, so a step is a direction of descent; which hinges are on settles over
  the iterations rather than within each (as exact sub-problems do it);
* bounds of the controls are kept exactly: the LQ problem is solved again while the set of active
  ones changes;
* without a better guess, hinges are left out at first, until steps are short: which way round the
  obstacles is then decided by where the free path runs, not by where the guess did;
* at first the model is that of the paper's convex sub-problem. Whole steps are taken: bold ones
  are what finds a way. When they are no longer than the controls, or after some number of them,
  the curvature of dynamics, hinges and terminal condition is added, weighed by the
  multipliers: Newton's method on the optimality conditions, quadratic at the end (with a variance
  penalty, whose adjoint weights are held, linear with a factor of some hundredths);
* where the model is then not convex in the controls (a pivot of the Riccati recursion is not
  positive), a multiple of the identity is added: a trust region by its multiplier, −p¹ of the
  paper. A line search on a merit function makes it descend;
* after a few rejected steps in a row the convex model's step, searched further, goes first;
* steps that no longer become shorter go round in circles (between sets of hinges, as a rule): then
  the multiple of the identity is kept from vanishing.

The merit function is Φ = cost + Σ λᵀf + νᵀg + s (½ max|λ| ‖f‖₁ + ½ max|ν| ‖g‖₁), f the defects of
the dynamics and g the terminal condition, with s ≥ 1 large enough that the step descends. In its
variance term the adjoint weights Λ of the iterate are held, as in the model (:mod:`..moments`).

Its fixed points are those of the paper's scheme, extremals; `python benchmarks/run.py --only
worlds` counts from how many random worlds it gets there.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np

from slipcar.planner.history import Iteration
from slipcar.planner.newton.functions import Functions
from slipcar.planner.newton.lq import LqSolution, LqSolver, gramian_trace
from slipcar.planner.newton.model import (
    Iterate,
    Quadratic,
    evaluate,
    quadratic_model,
    solve_model,
    times,
)
from slipcar.planner.newton.settings import TUNING
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.feasibility import inconsistency, not_finite
from slipcar.planner.problem.linearization import Linearization
from slipcar.planner.problem.model import Model
from slipcar.planner.status import Status

Array = np.ndarray


def iterate(
    model: Model,
    functions: Functions,
    options: Options,
    x: Array,
    u: Array,
    *,
    free_first: bool,
) -> Outcome:
    """Run the iteration from the guess x (N, n), u (N−1, m); `free_first` leaves hinges out first.

    Raises:
        ValueError: if the model functions are not finite along the guess.
    """
    w = options.variance_weight
    clock = time.perf_counter()
    at = evaluate(model, functions, w, x, u)
    if not at.finite:
        raise ValueError(f"{not_finite(at.lin)} is not finite along the guess")
    K, n = at.lin.defect.shape
    q = len(at.lin.g)
    adjoint, terminal = np.zeros((K, n)), np.zeros(q)
    shift, last, rejected, settling = 0.0, np.inf, 0, np.inf
    solver = LqSolver(K, n, u.shape[1], q)
    R = 2.0 * model.dt[:, None, None] * model.R
    gramian = gramian_trace(at.lin.A, at.lin.B, R, at.lin.G)
    unit = float(np.max(np.diag(model.R)))  # of a shift
    bounds = (np.zeros(u.shape, dtype=bool), np.zeros(u.shape, dtype=bool))
    history: list[Iteration] = []
    status = Status.MAX_ITERATIONS
    circling = _Circling(unit)
    released = free_first and len(model.weight) > 0
    for iteration in range(options.max_iterations):
        if released and (
            settling < TUNING.released * at.lin.effort or iteration >= TUNING.released_steps
        ):
            released, last = False, np.inf
        newton = (
            not released
            and bool(history)
            and (iteration >= TUNING.free_steps or settling < TUNING.settled * at.lin.effort)
        )
        fallback = rejected >= TUNING.rejections
        curved = newton and not fallback
        quadratic = quadratic_model(model, functions, at, adjoint, terminal, curved)
        linearized = time.perf_counter()
        solves, found = 0, None
        for _ in range(TUNING.inertia_trials):
            found, bounds, more = solve_model(
                model,
                at,
                quadratic,
                bounds,
                np.zeros_like(model.weight) if released else model.weight,
                shift if curved else 0.0,
                solver,
                gramian,
                curved,
            )
            solves += more
            if found is not None or not curved:
                break
            shift = max(TUNING.shift_up * shift, TUNING.first_shift * unit)
        solved = time.perf_counter()
        if found is None:
            status = Status.SOLVER_FAILED
            break
        search = _search(model, functions, w, at, quadratic, found, newton, fallback)
        new, alpha, accepted = search.new, search.alpha, search.accepted
        step = alpha**2 * float(np.vdot(model.dt[:, None] * search.e, search.e))
        radius = alpha**2 * float(np.einsum("k,ki,ki", model.dt, found.d, found.d))
        done = time.perf_counter()
        history.append(
            Iteration(
                mean=new.lin.x,
                controls=new.lin.u,
                effort=new.lin.effort,
                penalty=new.lin.penalty,
                running=new.lin.running,
                variance=np.nan if new.variance is None else new.variance.total / w,
                merit=search.merit,
                predicted=search.predicted,
                actual=search.actual,
                step=step,
                trust_radius=radius,
                trust_multiplier=shift if curved else 0.0,
                virtual_control=0.0,
                defect=float(np.max(np.abs(new.lin.defect))),
                terminal_residual=float(np.max(np.abs(new.lin.g), initial=0.0)),
                terminal_multiplier=found.terminal,
                accepted=accepted,
                solver_iterations=solves,
                linearize_seconds=linearized - clock + done - solved,
                solve_seconds=solved - linearized,
            )
        )
        stop = options.callback is not None and options.callback(history[-1])
        clock = time.perf_counter()
        if not accepted:
            if not newton or fallback:
                status = Status.STALLED if newton else Status.SOLVER_FAILED
                break
            rejected += 1
            shift = max(TUNING.shift_up * shift, 0.1 * TUNING.first_shift * unit)
        else:
            settling, length = step * unit, step
            # A short step that a shift made short proves nothing: the force it stands for,
            # p¹ (x − x_k), must vanish too.
            step += shift**2 * radius if curved else 0.0
            rejected = 0
            if newton:
                circling.notice(length)
                shift = max(_next_shift(shift, unit, search), circling.floor)
            at, adjoint, terminal = new, found.adjoint, found.terminal
            short = alpha == 1.0 and step + last <= options.tolerance
            if short and not released and _consistent(at.lin):
                status = Status.CONVERGED
                break
            last = step
        if stop:
            status = Status.STOPPED
            break
    return Outcome.at(
        at.lin, model, w, status=status, adjoint=adjoint, terminal=terminal,
        history=tuple(history),
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _Search:
    """Where a line search ended."""

    new: Iterate
    e: Array
    alpha: float
    accepted: bool
    merit: float
    predicted: float
    actual: float
    noise: float


def _search(
    model: Model,
    functions: Functions,
    w: float,
    at: Iterate,
    quadratic: Quadratic,
    found: LqSolution,
    newton: bool,
    fallback: bool,
) -> _Search:
    """Shorten the step until the merit function falls; free steps are taken whole."""
    lin, dt, d = at.lin, model.dt, found.d
    e = np.clip(lin.u + found.e, model.lower, model.upper) - lin.u
    value = at.cost - lin.penalty
    value += float(np.vdot(quadratic.q + 0.5 * times(quadratic.Q, d), d))
    value += float(np.vdot(quadratic.r + 0.5 * times(quadratic.R, e), e))
    if quadratic.S is not None:
        value += float(np.vdot(e[1:], times(quadratic.S[1:], d[:-1])))
    c = np.maximum(times(lin.C, d) + lin.c, 0.0)
    value += float(np.vdot(dt[:, None] * model.weight, c * c))
    price = 0.5 * float(np.max(np.abs(found.adjoint)))
    dear = 0.5 * float(np.max(np.abs(found.terminal), initial=0.0))

    def lagrangian(point: Iterate) -> tuple[float, float]:
        """Cost + λᵀf + νᵀg, and what is lacking, priced."""
        f, g = point.lin.defect, point.lin.g
        lacking = price * float(np.abs(f).sum()) + dear * float(np.abs(g).sum())
        cost = point.lin.effort + point.lin.penalty + point.lin.running
        if at.weights is not None:
            cost += float(np.vdot(at.weights @ point.lin.sigma, point.lin.sigma))
        return cost + float(np.vdot(found.adjoint, f) + np.vdot(found.terminal, g)), lacking

    before, lacking = lagrangian(at)
    gain = before - value
    factor = max(1.0, -gain / (0.75 * lacking)) if lacking > 0.0 else 1.0
    before += factor * lacking
    predicted = gain + factor * lacking
    noise = TUNING.noise * (1.0 + abs(before))
    alpha, trials = 1.0, (TUNING.long_searches if fallback else TUNING.searches) if newton else 1
    for trial in range(trials):
        x = lin.x.copy()
        x[1:] += alpha * d
        new = evaluate(model, functions, w, x, lin.u + alpha * e)
        merit, actual, accepted = np.inf, -np.inf, False
        if new.finite:
            merit, rest = lagrangian(new)
            merit += factor * rest
            actual = before - merit
            accepted = (
                not newton
                or (predicted <= noise and actual >= -noise)
                or actual >= TUNING.armijo * alpha * predicted
            )
        if accepted or trial == trials - 1:
            break
        alpha *= 0.5
    return _Search(new, e, alpha, accepted, merit, predicted, actual, noise)


class _Circling:
    """Notices steps that no longer become shorter, and keeps the shift from falling."""

    def __init__(self, unit: float) -> None:
        self.floor = 0.0
        self._shortest, self._stale, self._unit = np.inf, 0, unit

    def notice(self, step: float) -> None:
        """One more Newton step of this length, ∫‖Δu‖² dt."""
        least = TUNING.first_shift * self._unit
        self._stale += 1
        if step < 0.5 * self._shortest:
            self._shortest, self._stale = step, 0
            self.floor /= TUNING.shift_up
            if self.floor < 0.01 * least:
                self.floor = 0.0
        elif self._stale == TUNING.patience:
            self.floor, self._stale = max(TUNING.shift_up * self.floor, 0.1 * least), 0


def _next_shift(shift: float, unit: float, search: _Search) -> float:
    """Less after a step that did what the model said, more after one that did not."""
    if search.alpha == 1.0 and (
        search.actual > 0.7 * search.predicted or search.predicted <= search.noise
    ):
        return shift / TUNING.shift_down if shift > 0.01 * TUNING.first_shift * unit else 0.0
    if search.alpha < 0.3 or search.actual < 0.1 * search.predicted:
        return max(2.0 * shift, 0.01 * TUNING.first_shift * unit)
    return shift


def _consistent(lin: Linearization) -> bool:
    """Whether the terminal condition holds and the mean is, to first order, the controls' path."""
    size = 1.0 + float(np.max(np.abs(lin.x)))
    if np.max(np.abs(lin.g), initial=0.0) > TUNING.feasibility * size:
        return False
    return inconsistency(lin, np.inf) <= TUNING.consistency * size

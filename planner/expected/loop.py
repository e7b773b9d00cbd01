"""Newton's method on an expected cost, whose noise part is held while a step is computed.

One LQ problem per iteration, as in :mod:`slipcar.planner.newton.loop`, of

    Σ dt uᵀRu + H + Σ ℓ(c(μ), s) + Σ dt tr(P σσᵀ(μ))   [+ g(μ)ᵀWg(μ), or s.t. g(μ) = 0]

with the rows' standard deviations s and the adjoint weights P of the iterate (:mod:`.belief`);
after each step they are computed anew, and with them the gains. Its fixed points are stationary
points of the expected cost in controls and gains but for what :mod:`.belief` names as neglected
(nothing, where dynamics, σ and rows are affine). The way there is linear, with a factor of some
tenths. Curvature of dynamics and rows is in the model; inertia, shift and line search are those of
`newton.loop`.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.expected.settings import TUNING, Tuning
from slipcar.planner.moments.belief import Belief, loss_at, propagate
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.functions import Functions
from slipcar.planner.newton.lq import LqSolution, LqSolver, gramian_trace
from slipcar.planner.newton.model import Iterate, Quadratic, evaluate, times
from slipcar.planner.problem.feasibility import inconsistency
from slipcar.planner.problem.model import Model
from slipcar.planner.status import Status

Array = np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Steered:
    """Where the iteration ended; also where another may begin.

    Attributes:
        status: how it ended.
        x: mean, (N, n).
        u: controls, (K, m).
        gains: (K, m, n); zeros in open loop.
        covariance: Σ, (N, n, n).
        held: rows' derivatives by variance, (K, p).
        c: rows' expectations at nodes 1..K, (K, p).
        s: their standard deviations, (K, p).
        A: (K, n, n).
        B: (K, n, m).
        adjoint: λ_1..λ_K, (K, n).
        terminal: ν, (q,); 2Wg where the terminal condition is charged.
        effort: Σ dt uᵀRu.
        running: Σ dt (H + ℓᵀu).
        objective: the cost of the last step, P held: the mean's, plus what the noise is charged;
            rows' spread is in both, and that of the start in neither. `field.value` is the
            expected cost.
        iterations: steps tried.
    """

    status: Status
    x: Array
    u: Array
    gains: Array
    covariance: Array
    held: Array
    c: Array
    s: Array
    A: Array
    B: Array
    adjoint: Array
    terminal: Array
    effort: float
    running: float
    objective: float
    iterations: int


def iterate(
    model: Model,
    functions: Functions,
    stakes: Stakes,
    x: Array,
    u: Array,
    *,
    tolerance: float,
    max_iterations: int,
    warm: Steered | None = None,
    tuning: Tuning = TUNING,
) -> Steered:
    """Run from x (N, n), u (K, m); gains, weights and multipliers from `warm` if it is given.

    Raises:
        ValueError: if the model functions are not finite along the guess.
    """
    at = evaluate(model, functions, 0.0, x, u)
    if not at.finite:
        raise ValueError("the problem's functions are not finite along the guess")
    (K, m), n, q = u.shape, x.shape[1], len(at.lin.g)
    damping, floor, shortest, stale = stakes.damping, 0.0, np.inf, 0
    adjoint, terminal = np.zeros((K, n)), np.zeros(q)
    gains, held = np.zeros((K, m, n)), None
    if warm is not None:
        adjoint, terminal, gains, held = warm.adjoint, warm.terminal, warm.gains, warm.held
    belief = propagate(
        model, functions, at, stakes, gains, held, damping if warm is not None else 1.0
    )
    first = at.lin.effort
    unit = float(np.max(np.diag(model.R)))
    shift, last, rejected, tried = 0.0, np.inf, 0, 0
    solver = LqSolver(K, n, m, 0 if stakes.soft else q)
    gramian = 0.0
    if not stakes.soft:
        R = 2.0 * model.dt[:, None, None] * model.R
        gramian = gramian_trace(at.lin.A, at.lin.B, R, at.lin.G)
    bounds = (np.zeros(u.shape, dtype=bool), np.zeros(u.shape, dtype=bool))
    status = Status.MAX_ITERATIONS
    for _ in range(max_iterations):
        at = _confined(model, functions, at, belief)
        quadratic = _quadratic(model, functions, stakes, at, belief, adjoint, terminal)
        found = None
        for _ in range(tuning.inertia_trials):
            found, bounds = _solve(
                model, stakes, at, belief, quadratic, bounds, shift, solver, gramian, tuning
            )
            if found is not None:
                break
            shift = max(tuning.shift_up * shift, tuning.first_shift * unit)
        if found is None:
            status = Status.SOLVER_FAILED
            break
        tried += 1
        step = _search(model, functions, stakes, at, belief, quadratic, found, first, tuning)
        if not step.accepted:
            rejected += 1
            shift = max(tuning.shift_up * shift, 0.1 * tuning.first_shift * unit)
            if rejected >= tuning.rejections:
                status = Status.STALLED
                break
            continue
        rejected = 0
        length = step.alpha**2 * float(np.vdot(model.dt[:, None] * step.e, step.e))
        radius = step.alpha**2 * float(np.einsum("k,ki,ki", model.dt, found.d, found.d))
        stale += 1
        if length < 0.5 * shortest:
            shortest, stale = length, 0
            floor /= tuning.shift_up
            if floor < 0.01 * tuning.first_shift * unit:
                floor = 0.0
        elif stale == tuning.patience:
            damping, stale = max(0.5 * damping, tuning.least_damping), 0
            floor = max(tuning.shift_up * floor, 0.1 * tuning.first_shift * unit)
        length += shift**2 * radius
        shift = max(_next_shift(shift, unit, step, tuning), floor)
        at, adjoint = step.new, found.adjoint
        terminal = 2.0 * stakes.terminal * at.lin.g if stakes.soft else found.terminal
        belief = propagate(model, functions, at, stakes, belief.gains, belief.held, damping)
        if step.alpha == 1.0 and length + last <= tolerance and _consistent(at, stakes, tuning):
            status = Status.CONVERGED
            break
        last = length
    lin = at.lin
    value = _cost(model, stakes, at, belief)
    return Steered(
        status=status, x=lin.x, u=lin.u, gains=belief.gains, covariance=belief.covariance,
        held=belief.held, c=lin.c + belief.offset, s=belief.s, A=lin.A, B=lin.B, adjoint=adjoint,
        terminal=terminal, effort=lin.effort, running=lin.running,
        objective=value, iterations=tried,
    )  # fmt: skip


def _confined(model: Model, functions: Functions, at: Iterate, belief: Belief) -> Iterate:
    """With controls within the bounds that the gains of now leave.

    Bounds follow the gains, so that the last step's controls may lie outside: a step back costs
    more than it gains, and measured from there none would be accepted.
    """
    u = np.clip(at.lin.u, belief.lower, belief.upper)
    if np.array_equal(u, at.lin.u):
        return at
    moved = evaluate(model, functions, 0.0, at.lin.x, u)
    return moved if moved.finite else at


def _cost(model: Model, stakes: Stakes, at: Iterate, belief: Belief) -> float:
    """Expected cost, P and s held."""
    lin = at.lin
    value = lin.effort + lin.running
    value += float(loss_at(model, stakes, lin.c + belief.offset, belief.s).value.sum())
    weighed = (model.dt[:, None, None] * belief.P) @ lin.sigma
    value += float(np.vdot(weighed, lin.sigma))
    if stakes.soft:
        value += float(np.vdot(stakes.terminal, lin.g * lin.g))
    return value


def _quadratic(
    model: Model,
    functions: Functions,
    stakes: Stakes,
    at: Iterate,
    belief: Belief,
    adjoint: Array,
    terminal: Array,
) -> Quadratic:
    """The quadratic model of the held cost: gradient of the cost, curvature of the Lagrangian."""
    lin, dt, t = at.lin, model.dt, model.times
    (K, m), n = lin.u.shape, lin.x.shape[1]
    assert lin.q_running is not None
    assert lin.r_running is not None
    rows = loss_at(model, stakes, lin.c + belief.offset, belief.s)
    q = lin.q_running + np.einsum("kpi,kp->ki", lin.C, rows.slope)
    Q = dt[:, None, None] * at.H_xx
    Q += np.einsum("kpi,kp,kpj->kij", lin.C, rows.curvature, lin.C, optimize=True)
    R = 2.0 * dt[:, None, None] * model.R
    r = times(R, lin.u) + lin.r_running
    second = functions.stage_hessian(t=t[:-1], dt=dt, x=lin.x[:-1], u=lin.u, adjoint=adjoint)
    Q[:-1] += second["xx"].reshape(K, n, n)[1:]
    S = second["ux"].reshape(K, m, n) if second["ux"].any() else None
    R += second["uu"].reshape(K, m, m)
    if lin.c.shape[1]:
        bent = functions.node_hessian(t=t[1:], x=lin.x[1:], weight=rows.slope)["xx"]
        Q += bent.reshape(K, n, n)
    bent = functions.terminal_hessian(x=lin.x[-1:], multiplier=terminal[None])["xx"]
    Q[-1] += bent.reshape(n, n)
    q[:-1] += belief.noise.gradient[1:]
    Q[:-1] += belief.noise.hessian[1:]
    if stakes.soft:
        weighted = 2.0 * stakes.terminal[:, None] * lin.G
        Q[-1] += lin.G.T @ weighted
        q[-1] += weighted.T @ lin.g
    return Quadratic(Q, q, R, r, S)


def _solve(
    model: Model,
    stakes: Stakes,
    at: Iterate,
    belief: Belief,
    quadratic: Quadratic,
    bounds: tuple[Array, Array],
    shift: float,
    solver: LqSolver,
    gramian: float,
    tuning: Tuning,
) -> tuple[LqSolution | None, tuple[Array, Array]]:
    """The step, and which bounds are active."""
    lin, dt = at.lin, model.dt
    n, m = lin.x.shape[1], lin.u.shape[1]
    level = 2.0 * shift * dt[:, None, None]
    Q, q = quadratic.Q + level * np.eye(n), quadratic.q.copy()
    R = quadratic.R + level * np.eye(m)
    G, g = lin.G, lin.g
    if stakes.soft:
        G, g = np.zeros((0, n)), np.zeros(0)
    elif gramian > 0.0:
        kappa = tuning.terminal_curvature * len(g) / gramian
        Q[-1] += kappa * G.T @ G
        q[-1] += kappa * G.T @ g
        gramian /= 1.0 + kappa * gramian
    lower, upper = belief.lower - lin.u, belief.upper - lin.u
    stiffness = tuning.bound_stiffness * 2.0 * float(np.max(dt) * np.max(np.diag(model.R)))
    diagonal = np.arange(m)
    found = None
    for round_ in range(tuning.bound_rounds):
        low, high = bounds
        Rb, rb = R, quadratic.r
        if model.bounded and (low.any() or high.any()):
            Rb, on = R.copy(), low | high
            Rb[:, diagonal, diagonal] += stiffness * on
            rb = rb - stiffness * np.where(high, upper, np.where(low, lower, 0.0))
        found = solver.solve(
            lin.A, lin.B, lin.defect, Q, q, Rb, rb, quadratic.S, G, g, gramian, convex=False
        )
        if found is None or not model.bounded:
            return found, bounds
        new = (found.e < lower, found.e > upper)
        if np.array_equal(new[0], low) and np.array_equal(new[1], high):
            return found, bounds
        if round_ < tuning.bound_rounds - 1:
            bounds = new
    # The set does not settle: clip the controls and let the states follow.
    assert found is not None
    e, d = np.clip(found.e, lower, upper), np.empty_like(found.d)
    state = np.zeros(n)
    for k in range(len(d)):
        state = d[k] = lin.A[k].dot(state) + lin.B[k].dot(e[k]) + lin.defect[k]
    return dataclasses.replace(found, d=d, e=e), bounds


@dataclasses.dataclass(frozen=True)
class _Step:
    new: Iterate
    e: Array
    alpha: float
    accepted: bool
    predicted: float
    actual: float
    noise: float


def _search(
    model: Model,
    functions: Functions,
    stakes: Stakes,
    at: Iterate,
    belief: Belief,
    quadratic: Quadratic,
    found: LqSolution,
    first: float,
    tuning: Tuning,
) -> _Step:
    """Shorten the step until the held cost, with what is lacking priced, falls.

    `first` is the effort of the guess, which says what a long step is.
    """
    lin, d = at.lin, found.d
    e = np.clip(found.e, belief.lower - lin.u, belief.upper - lin.u)
    change = float(np.vdot(quadratic.q + 0.5 * times(quadratic.Q, d), d))
    change += float(np.vdot(quadratic.r + 0.5 * times(quadratic.R, e), e))
    if quadratic.S is not None:
        change += float(np.vdot(e[1:], times(quadratic.S[1:], d[:-1])))
    price = 0.5 * float(np.max(np.abs(found.adjoint)))
    dear = 0.0 if stakes.soft else 0.5 * float(np.max(np.abs(found.terminal), initial=0.0))

    def priced(point: Iterate) -> tuple[float, float]:
        """Σ λᵀf + νᵀg, and what is lacking, priced."""
        f, g = point.lin.defect, point.lin.g
        lacking = price * float(np.abs(f).sum()) + dear * float(np.abs(g).sum())
        value = float(np.vdot(found.adjoint, f))
        return value + (0.0 if stakes.soft else float(np.vdot(found.terminal, g))), lacking

    value, lacking = priced(at)
    gain = value - change
    factor = max(1.0, -gain / (0.75 * lacking)) if lacking > 0.0 else 1.0
    before = _cost(model, stakes, at, belief) + value + factor * lacking
    predicted = gain + factor * lacking
    noise = tuning.noise * (1.0 + abs(before))
    # Rows and dynamics are far from their models beyond some length of a step.
    length = float(np.vdot(model.dt[:, None] * e, e @ model.R))
    most = tuning.longest * (max(first, lin.effort) + 1e-3 * length)
    alpha = 1.0 if length <= most else float(np.sqrt(most / length))
    for trial in range(tuning.searches):
        x = lin.x.copy()
        x[1:] += alpha * d
        new = evaluate(model, functions, 0.0, x, lin.u + alpha * e)
        actual, accepted = -np.inf, False
        if new.finite:
            value, rest = priced(new)
            actual = before - _cost(model, stakes, new, belief) - value - factor * rest
            accepted = (predicted <= noise and actual >= -noise) or (
                actual >= tuning.armijo * alpha * predicted
            )
        if accepted or trial == tuning.searches - 1:
            break
        alpha *= 0.5
    return _Step(new, e, alpha, accepted, predicted, actual, noise)


def _next_shift(shift: float, unit: float, step: _Step, tuning: Tuning) -> float:
    """Less after a step that did what the model said, more after one that did not."""
    if step.alpha == 1.0 and (step.actual > 0.7 * step.predicted or step.predicted <= step.noise):
        small = shift <= 0.01 * tuning.first_shift * unit
        return 0.0 if small else shift / tuning.shift_down
    if step.alpha < 0.3 or step.actual < 0.1 * step.predicted:
        return max(2.0 * shift, 0.01 * tuning.first_shift * unit)
    return shift


def _consistent(at: Iterate, stakes: Stakes, tuning: Tuning) -> bool:
    """Whether the terminal condition holds, if it must, and the mean follows the controls."""
    lin = at.lin
    size = 1.0 + float(np.max(np.abs(lin.x)))
    if not stakes.soft and np.max(np.abs(lin.g), initial=0.0) > tuning.feasibility * size:
        return False
    return inconsistency(lin, np.inf) <= tuning.consistency * size

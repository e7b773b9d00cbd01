"""The iteration of :mod:`.loop` compiled with numba, for one problem or many.

It knows a problem by the addresses of its kernels (:mod:`slipcar.planner.newton.traced`) and by
arrays; the same machine code serves every problem. The steps are those of `loop`, to rounding
errors.

Only the entry, `solve_many`, is compiled and cached on disk, with all it calls inside: numba's
cache notices changes of the file it is in, no others. `caching.stamp` makes it notice those of its
neighbours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numba
import numpy as np

from slipcar.planner.newton.caching import stamp
from slipcar.planner.newton.iterate_arrays import (
    covariance,
    evaluate,
    inconsistency,
    lagrangian,
    start_share,
    storage,
)
from slipcar.planner.newton.model_arrays import (
    active_bounds,
    clip,
    load,
    model_cost,
    quadratic,
    respond,
)
from slipcar.planner.newton.native import ticks
from slipcar.planner.newton.riccati import solve_lq, workspace
from slipcar.planner.newton.sweep import sweep

CONVERGED, MAX_ITERATIONS, STALLED, NO_STEP, NOT_FINITE = range(5)

#: Modules the compiled code comes from.
SOURCES = ("compiled", "iterate_arrays", "model_arrays", "native", "riccati", "sweep")
#: Columns of the table that is written, one row for each step tried; the last two are processor
#: cycles since the beginning.
COLUMNS = (
    "effort",
    "penalty",
    "running",
    "variance",
    "merit",
    "predicted",
    "actual",
    "step",
    "radius",
    "shift",
    "defect",
    "terminal_residual",
    "accepted",
    "solves",
    "linearized",
    "solved",
)


@numba.njit(error_model="numpy")
def half_largest(array):
    """Half of the largest absolute value."""
    largest = 0.0
    for value in array.flat:
        largest = max(largest, 0.5 * abs(value))
    return largest


@numba.njit(error_model="numpy")
def gramian_trace(A, B, dt, R, G):
    """`lq.gramian_trace`."""
    K = len(A)
    inverse = np.linalg.inv(R)
    Phi, total = G.copy(), 0.0
    for k in range(K - 1, -1, -1):
        pushed = Phi @ B[k]
        total += np.sum(pushed * (pushed @ inverse)) / (2.0 * dt[k])
        Phi = Phi @ A[k]
    return total


@numba.njit(error_model="numpy")
def _consistent(at, tuning):
    """`loop._consistent`."""
    x, values = at[14], at[19]
    size = 1.0 + 2.0 * half_largest(x)
    return values[5] <= tuning.feasibility * size and inconsistency(at) <= tuning.consistency * size


@numba.njit(error_model="numpy")
def _iterate(
    addresses, parameters, times, R, lower, upper, weight, w, tolerance, max_iterations, tuning,
    free_first, d, x_guess, u_guess, x_out, u_out, adjoint_out, nu_out, A_out, B_out, S_out,
    cost_out, table, xs, us, nus,
):  # fmt: skip
    """One problem; how it ended, and how many steps were tried. See `loop.iterate`."""
    K, m = u_guess.shape
    n, p, t = x_guess.shape[1], len(weight), len(nu_out)
    dt = times[1:] - times[:-1]
    at, new = storage(K, n, m, d, p, t), storage(K, n, m, d, p, t)
    at[14][:], at[15][:] = x_guess, u_guess
    # By node, 0..K, as the generated recursion wants it; node 0 costs nothing and does not move.
    Q_nodes, q_nodes, d_nodes = np.zeros((K + 1, n, n)), np.zeros((K + 1, n)), np.zeros((K + 1, n))
    Qs, qs, Rs, rs = Q_nodes[1:], q_nodes[1:], np.empty((K, m, m)), np.empty((K, m))
    Q, q, Rk, r = np.empty((K, n, n)), np.empty((K, n)), np.empty((K, m, m)), np.empty((K, m))
    S = np.zeros((K, m, n))
    size = n + 1 + t
    V = np.zeros((K + 1, size * (size + 1) // 2))
    gains, pivots = np.empty((K, m, size)), np.empty((K, m))
    work = workspace(0 if addresses[6] else K, n, m, t)
    de, ee, adjoint, nu = d_nodes[1:], np.empty((K, m)), np.zeros((K, n)), np.zeros(t)
    last_adjoint, last_nu = np.zeros((K, n)), np.zeros(t)
    low, high = np.zeros((K, m), dtype=np.bool_), np.zeros((K, m), dtype=np.bool_)
    low_new, high_new = low.copy(), high.copy()
    low_bound, high_bound = np.empty((K, m)), np.empty((K, m))
    low_bound[:], high_bound[:] = lower, upper
    unit = 0.0  # of a shift
    for i in range(m):
        unit = max(unit, R[i, i])
    stiffness = tuning.bound_stiffness * 2.0 * np.max(dt) * unit
    shift, last, settling, kappa = 0.0, np.inf, np.inf, 0.0
    floor, shortest, stale = 0.0, np.inf, 0
    rejected, tried, status = 0, 0, MAX_ITERATIONS
    # While hinges are left out, as if they weighed nothing.
    released, hinges = free_first and p > 0, weight
    if released:
        hinges = np.zeros(p)
    started = ticks()
    if not evaluate(addresses, parameters, times, dt, R, weight, w, at):
        return NOT_FINITE, 0
    gramian = gramian_trace(at[1], at[2], dt, R, at[13])
    if gramian > 0.0:
        kappa = tuning.terminal_curvature * t / gramian
    for iteration in range(max_iterations):
        if released and (
            settling < tuning.released * at[19][0] or iteration >= tuning.released_steps
        ):
            released, hinges, last = False, weight, np.inf
        newton = (
            not released
            and tried > 0
            and (iteration >= tuning.free_steps or settling < tuning.settled * at[19][0])
        )
        fallback = rejected >= tuning.rejections
        curved = newton and not fallback
        A, B, f, x, u = at[1], at[2], at[16], at[14], at[15]
        quadratic(
            addresses, parameters, times, dt, R, weight, w, at, curved, last_adjoint, last_nu,
            Q, q, Rk, r, S,
        )  # fmt: skip
        linearized = ticks() - started
        solves, convex, same = 0, False, True
        # What is left of the Gramian under the terminal curvature.
        seen = gramian / (1.0 + kappa * gramian) if curved else gramian
        for _ in range(tuning.inertia_trials):
            for bound_round in range(tuning.bound_rounds):
                load(
                    dt, hinges, at, Q, q, Rk, r, shift if curved else 0.0,
                    kappa if curved else 0.0, low, high, low_bound, high_bound, stiffness, Qs, qs,
                    Rs, rs,
                )  # fmt: skip
                if addresses[6] != 0:
                    convex = sweep(
                        addresses, A, B, f, Q_nodes, q_nodes, Rs, rs, S, at[13], at[12], seen, V,
                        gains, pivots, d_nodes, ee, adjoint, nu,
                    )  # fmt: skip
                else:
                    convex = solve_lq(
                        A, B, f, Qs, qs, Rs, rs, S, at[13], at[12], seen, work, de, ee, adjoint, nu
                    )
                solves += 1
                if not convex:
                    break
                same = active_bounds(u, ee, low_bound, high_bound, low, high, low_new, high_new)
                if same:
                    break
                if bound_round < tuning.bound_rounds - 1:
                    low[:], high[:] = low_new, high_new
            if convex or not curved:
                break
            shift = max(tuning.shift_up * shift, tuning.first_shift * unit)
        solved = ticks() - started
        if not convex:
            status = NO_STEP
            break
        clip(u, ee, low_bound, high_bound)
        if not same:
            respond(A, B, f, de, ee)
        model, step, radius = model_cost(dt, weight, at, Q, q, Rk, r, S, de, ee)
        price, dear = half_largest(adjoint), half_largest(nu)
        before, gap, miss = lagrangian(at, adjoint, nu, w, dt, at[20])
        gained, lacking = before - model, price * gap + dear * miss
        factor = 1.0
        if lacking > 0.0:
            factor = max(1.0, -gained / (0.75 * lacking))
        before += factor * lacking
        predicted = gained + factor * lacking
        noise = tuning.noise * (1.0 + abs(before))
        trials = 1
        if newton:
            trials = tuning.long_searches if fallback else tuning.searches
        alpha, accepted, merit, actual = 1.0, False, np.inf, -np.inf
        for trial in range(trials):
            new[14][0] = x[0]
            for k in range(K):
                for i in range(n):
                    new[14][k + 1, i] = x[k + 1, i] + alpha * de[k, i]
                for i in range(m):
                    new[15][k, i] = u[k, i] + alpha * ee[k, i]
            merit, actual = np.inf, -np.inf
            if evaluate(addresses, parameters, times, dt, R, weight, w, new):
                merit, gap, miss = lagrangian(new, adjoint, nu, w, dt, at[20])
                merit += factor * (price * gap + dear * miss)
                actual = before - merit
                accepted = (
                    not newton
                    or (predicted <= noise and actual >= -noise)
                    or actual >= tuning.armijo * alpha * predicted
                )
            if accepted or trial == trials - 1:
                break
            alpha *= 0.5
        step, radius = alpha * alpha * step, alpha * alpha * radius
        row = table[tried]
        row[0], row[1], row[2], row[3] = new[19][0], new[19][1], new[19][2], new[19][3]
        if w > 0.0:
            row[3] += w * start_share(new[1][0], new[20][0], S_out[0])
        row[4], row[5], row[6], row[7], row[8] = merit, predicted, actual, step, radius
        row[9], row[10], row[11] = shift if curved else 0.0, new[19][4], new[19][5]
        row[12], row[13], row[14], row[15] = 1.0 if accepted else 0.0, solves, linearized, solved
        if tried < xs.shape[0]:
            xs[tried], us[tried], nus[tried] = new[14], new[15], nu
        tried += 1
        if not accepted:
            if not newton or fallback:
                status = STALLED if newton else NO_STEP
                break
            rejected += 1
            shift = max(tuning.shift_up * shift, 0.1 * tuning.first_shift * unit)
            continue
        settling = step * unit
        if newton:
            # Steps that no longer become shorter go round in circles: shorten them.
            stale += 1
            if step < 0.5 * shortest:
                shortest, stale, floor = step, 0, floor / tuning.shift_up
                if floor < 0.01 * tuning.first_shift * unit:
                    floor = 0.0
            elif stale == tuning.patience:
                floor, stale = max(tuning.shift_up * floor, 0.1 * tuning.first_shift * unit), 0
        step += shift * shift * radius if curved else 0.0
        rejected = 0
        if newton:
            if alpha == 1.0 and (actual > 0.7 * predicted or predicted <= noise):
                small = shift <= 0.01 * tuning.first_shift * unit
                shift = 0.0 if small else shift / tuning.shift_down
            elif alpha < 0.3 or actual < 0.1 * predicted:
                shift = max(2.0 * shift, 0.01 * tuning.first_shift * unit)
            shift = max(shift, floor)
        at, new = new, at
        last_adjoint[:], last_nu[:] = adjoint, nu
        if not released and alpha == 1.0 and step + last <= tolerance and _consistent(at, tuning):
            status = CONVERGED
            break
        last = step
    x_out[:], u_out[:], adjoint_out[:], nu_out[:] = at[14], at[15], last_adjoint, last_nu
    A_out[:], B_out[:], cost_out[:] = at[1], at[2], at[19][:4]
    if w > 0.0:
        cost_out[3] += w * start_share(at[1][0], at[20][0], S_out[0])
    covariance(at[1], at[3], at[4], dt, S_out)
    return status, tried


def _compiled(version: int) -> Any:
    # A variable of an enclosing function is part of the key of numba's cache.
    @numba.njit(cache=True, error_model="numpy", nogil=True)
    def solve_many(
        addresses, parameters, times, R, lower, upper, weight, w, tolerance, max_iterations,
        tuning, free_first, d, x_guess, u_guess, x_out, u_out, adjoint_out, nu_out, A_out, B_out,
        S_out, cost_out, table, xs, us, nus, ended,
    ):  # fmt: skip
        if version == -1:
            return
        for i in range(len(x_guess)):
            ended[i, 0], ended[i, 1] = _iterate(
                addresses, parameters[i], times[i], R[i], lower[i], upper[i], weight[i], w,
                tolerance, max_iterations, tuning, free_first[i], d, x_guess[i], u_guess[i],
                x_out[i], u_out[i], adjoint_out[i], nu_out[i], A_out[i], B_out[i], S_out[i],
                cost_out[i], table[i], xs[i], us[i], nus[i],
            )  # fmt: skip

    return solve_many


#: Solve problems of one kind and one grid size; the first axis of every array counts them. Writes
#: trajectories (P, N, n) and (P, K, m), multipliers (P, K, n) and (P, q), A, B, Σ (P, N, n, n) from
#: the first on, which is given, the four costs (effort, penalty, running, w ∫ tr Σ dt), the table
#: (P, max_iterations, columns), the trajectories of each step tried (P, steps to keep, ...), and
#: (how it ended, steps tried).
solve_many = _compiled(stamp(Path(__file__).with_name(f"{name}.py") for name in SOURCES))

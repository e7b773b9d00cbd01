"""The iteration of :mod:`.loop` compiled with numba, for one problem or many.

As :mod:`slipcar.planner.newton.compiled`: it knows a problem by the addresses of its kernels and by
arrays, and the same machine code serves every problem.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numba
import numpy as np

from slipcar.planner.expected.arrays import cost, fill_losses, model_change, priced, quadratic
from slipcar.planner.expected.belief_arrays import expectations, propagate, row_hessians
from slipcar.planner.newton import compiled as newton
from slipcar.planner.newton.caching import stamp
from slipcar.planner.newton.compiled import (
    CONVERGED,
    MAX_ITERATIONS,
    NO_STEP,
    NOT_FINITE,
    STALLED,
    gramian_trace,
    half_largest,
)
from slipcar.planner.newton.iterate_arrays import evaluate, inconsistency, storage
from slipcar.planner.newton.model_arrays import active_bounds, clip, load, respond
from slipcar.planner.newton.riccati import SOFTNESS, solve_lq, workspace
from slipcar.planner.newton.sweep import sweep


@numba.njit(error_model="numpy")
def _consistent(at, soft, tuning):
    """`loop._consistent`."""
    size = 1.0 + 2.0 * half_largest(at[14])
    if not soft and at[19][5] > tuning.feasibility * size:
        return False
    return inconsistency(at) <= tuning.consistency * size


@numba.njit(error_model="numpy")
def _confined(u, lower, upper, inside):
    """`loop._confined`: u within bounds, into `inside`; whether that is another."""
    moved = False
    for k in range(u.shape[0]):
        for i in range(u.shape[1]):
            inside[k, i] = min(max(u[k, i], lower[k, i]), upper[k, i])
            moved = moved or inside[k, i] != u[k, i]
    return moved


@numba.njit(error_model="numpy")
def _iterate(
    addresses, parameters, times, R, lower, upper, weight, tail, W, soft, feedback, w, saturation,
    damping, tolerance, max_iterations, tuning, warm, d, x, u, gains, held, adjoint, nu, A_out,
    B_out, Sigma, c_out, s, values,
):  # fmt: skip
    """One problem, in place from the guess x, u on; how it ended, and how many steps were tried."""
    K, m = u.shape
    n, p, q_ = x.shape[1], len(weight), len(nu)
    dt = times[1:] - times[:-1]
    none = np.zeros(p)
    at, new = storage(K, n, m, d, p, q_), storage(K, n, m, d, p, q_)
    at[14][:], at[15][:] = x, u
    if not evaluate(addresses, parameters, times, dt, R, none, 0.0, at):
        return NOT_FINITE, 0
    Q_nodes, q_nodes, d_nodes = np.zeros((K + 1, n, n)), np.zeros((K + 1, n)), np.zeros((K + 1, n))
    Qs, qs, Rs, rs = Q_nodes[1:], q_nodes[1:], np.empty((K, m, m)), np.empty((K, m))
    Q, q, Rk, r = np.empty((K, n, n)), np.empty((K, n)), np.empty((K, m, m)), np.empty((K, m))
    S = np.zeros((K, m, n))
    size = n + 1 + q_
    V = np.zeros((K + 1, size * (size + 1) // 2))
    laws, pivots = np.empty((K, m, size)), np.empty((K, m))
    work = workspace(0 if addresses[6] else K, n, m, q_)
    de, ee, next_adjoint, next_nu = d_nodes[1:], np.empty((K, m)), np.empty((K, n)), np.zeros(q_)
    low, high = np.zeros((K, m), dtype=np.bool_), np.zeros((K, m), dtype=np.bool_)
    low_new, high_new = low.copy(), high.copy()
    low_bound, high_bound = np.empty((K, m)), np.empty((K, m))
    closed, P = np.empty((K, n, n)), np.empty((K, n, n))
    vg, vh = np.empty((K, n)), np.empty((K, n, n))
    slope, curvature = np.empty((K, p)), np.empty((K, p))
    bend, offset = np.zeros((p, K, n, n)), np.zeros((K, p))
    no_G, no_g = np.zeros((q_, n)), np.zeros(q_)
    unit = 0.0  # of a shift
    for i in range(m):
        unit = max(unit, R[i, i])
    stiffness = tuning.bound_stiffness * 2.0 * np.max(dt) * unit
    if not warm:
        gains[:], held[:], adjoint[:], nu[:] = 0.0, 0.0, 0.0, 0.0
    propagate(
        addresses, parameters, times, at, dt, R, weight, tail, W, feedback, w, saturation,
        damping, not warm, lower, upper, gains, held, closed, Sigma, bend, offset, s, P, vg, vh,
        low_bound, high_bound,
    )  # fmt: skip
    # Where the end is charged its condition is left out: a system so soft has the multiplier 0.
    kappa, seen = 0.0, 1.0 / SOFTNESS
    if not soft:
        gramian = gramian_trace(at[1], at[2], dt, R, at[13])
        if gramian > 0.0:
            kappa = tuning.terminal_curvature * q_ / gramian
        seen = gramian / (1.0 + kappa * gramian)
    first = at[19][0]
    shift, floor, last, shortest, stale = 0.0, 0.0, np.inf, np.inf, 0
    rejected, tried, status = 0, 0, MAX_ITERATIONS
    for _ in range(max_iterations):
        if _confined(at[15], low_bound, high_bound, new[15]):
            new[14][:] = at[14]
            if evaluate(addresses, parameters, times, dt, R, none, 0.0, new):
                at, new = new, at
        A, B, f, xs, us = at[1], at[2], at[16], at[14], at[15]
        G, g = (no_G, no_g) if soft else (at[13], at[12])
        fill_losses(dt, weight, tail, at[7], offset, s, slope, curvature)
        quadratic(
            addresses, parameters, times, dt, R, at, slope, curvature, W, soft, adjoint, nu, vg,
            vh, Q, q, Rk, r, S,
        )  # fmt: skip
        convex, same = False, True
        for _ in range(tuning.inertia_trials):
            for bound_round in range(tuning.bound_rounds):
                load(
                    dt, none, at, Q, q, Rk, r, shift, kappa, low, high, low_bound, high_bound,
                    stiffness, Qs, qs, Rs, rs,
                )  # fmt: skip
                if addresses[6] != 0:
                    convex = sweep(
                        addresses, A, B, f, Q_nodes, q_nodes, Rs, rs, S, G, g, seen, V, laws,
                        pivots, d_nodes, ee, next_adjoint, next_nu,
                    )  # fmt: skip
                else:
                    convex = solve_lq(
                        A, B, f, Qs, qs, Rs, rs, S, G, g, seen, work, de, ee, next_adjoint,
                        next_nu,
                    )  # fmt: skip
                if not convex:
                    break
                same = active_bounds(us, ee, low_bound, high_bound, low, high, low_new, high_new)
                if same:
                    break
                if bound_round < tuning.bound_rounds - 1:
                    low[:], high[:] = low_new, high_new
            if convex:
                break
            shift = max(tuning.shift_up * shift, tuning.first_shift * unit)
        if not convex:
            status = NO_STEP
            break
        tried += 1
        clip(us, ee, low_bound, high_bound)
        if not same:
            respond(A, B, f, de, ee)
        change, step, length, radius = model_change(dt, R, Q, q, Rk, r, S, de, ee)
        price, dear = half_largest(next_adjoint), 0.0 if soft else half_largest(next_nu)
        here = cost(at, dt, weight, tail, W, soft, offset, s, P)
        value, gap, miss = priced(at, next_adjoint, next_nu, soft)
        lacking = price * gap + dear * miss
        gained, factor = value - change, 1.0
        if lacking > 0.0:
            factor = max(1.0, -gained / (0.75 * lacking))
        before = here + value + factor * lacking
        predicted = gained + factor * lacking
        noise = tuning.noise * (1.0 + abs(before))
        most = tuning.longest * (max(first, at[19][0]) + 1e-3 * length)
        alpha = 1.0 if length <= most else np.sqrt(most / length)
        accepted, actual = False, -np.inf
        for trial in range(tuning.searches):
            new[14][0] = xs[0]
            for k in range(K):
                for i in range(n):
                    new[14][k + 1, i] = xs[k + 1, i] + alpha * de[k, i]
                for i in range(m):
                    new[15][k, i] = us[k, i] + alpha * ee[k, i]
            actual = -np.inf
            if evaluate(addresses, parameters, times, dt, R, none, 0.0, new):
                value, gap, miss = priced(new, next_adjoint, next_nu, soft)
                merit = cost(new, dt, weight, tail, W, soft, offset, s, P) + value
                actual = before - merit - factor * (price * gap + dear * miss)
                accepted = (predicted <= noise and actual >= -noise) or (
                    actual >= tuning.armijo * alpha * predicted
                )
            if accepted or trial == tuning.searches - 1:
                break
            alpha *= 0.5
        if not accepted:
            rejected += 1
            shift = max(tuning.shift_up * shift, 0.1 * tuning.first_shift * unit)
            if rejected >= tuning.rejections:
                status = STALLED
                break
            continue
        rejected = 0
        step, radius = alpha * alpha * step, alpha * alpha * radius
        stale += 1
        if step < 0.5 * shortest:
            shortest, stale, floor = step, 0, floor / tuning.shift_up
            if floor < 0.01 * tuning.first_shift * unit:
                floor = 0.0
        elif stale == tuning.patience:
            damping, stale = max(0.5 * damping, tuning.least_damping), 0
            floor = max(tuning.shift_up * floor, 0.1 * tuning.first_shift * unit)
        step += shift * shift * radius
        if alpha == 1.0 and (actual > 0.7 * predicted or predicted <= noise):
            shift = 0.0 if shift <= 0.01 * tuning.first_shift * unit else shift / tuning.shift_down
        elif alpha < 0.3 or actual < 0.1 * predicted:
            shift = max(2.0 * shift, 0.01 * tuning.first_shift * unit)
        shift = max(shift, floor)
        at, new = new, at
        adjoint[:], nu[:] = next_adjoint, next_nu
        if soft:
            for j in range(q_):
                nu[j] = 2.0 * W[j] * at[12][j]
        propagate(
            addresses, parameters, times, at, dt, R, weight, tail, W, feedback, w, saturation,
            damping, False, lower, upper, gains, held, closed, Sigma, bend, offset, s, P, vg, vh,
            low_bound, high_bound,
        )  # fmt: skip
        if alpha == 1.0 and step + last <= tolerance and _consistent(at, soft, tuning):
            status = CONVERGED
            break
        last = step
    others = weight <= 0.0  # those that are charged are known
    row_hessians(addresses, parameters, times, at[14], others, bend)
    expectations(bend, Sigma, others, offset)
    x[:], u[:], A_out[:], B_out[:] = at[14], at[15], at[1], at[2]
    for k in range(K):
        for o in range(p):
            c_out[k, o] = at[7][k, o] + offset[k, o]
    values[0], values[1] = at[19][0], at[19][2]
    values[2] = cost(at, dt, weight, tail, W, soft, offset, s, P)
    return status, tried


def _compiled(version: int) -> Any:
    # A variable of an enclosing function is part of the key of numba's cache.
    @numba.njit(cache=True, error_model="numpy", nogil=True)
    def solve_many(
        addresses, parameters, times, R, lower, upper, weight, tail, W, soft, feedback, w,
        saturation, damping, tolerance, max_iterations, tuning, warm, d, x, u, gains, held,
        adjoint, nu, A, B, Sigma, c, s, values, ended,
    ):  # fmt: skip
        if version == -1:
            return
        for i in range(len(x)):
            ended[i, 0], ended[i, 1] = _iterate(
                addresses, parameters[i], times[i], R[i], lower[i], upper[i], weight[i], tail,
                W[i], soft, feedback, w, saturation, damping, tolerance, max_iterations, tuning,
                warm, d, x[i], u[i], gains[i], held[i], adjoint[i], nu[i], A[i], B[i], Sigma[i],
                c[i], s[i], values[i],
            )  # fmt: skip

    return solve_many


def _sources() -> Any:
    here, there = Path(__file__), Path(newton.__file__)
    own = [here.with_name(f"{name}.py") for name in ("compiled", "arrays", "belief_arrays")]
    return itertools.chain(own, (there.with_name(f"{name}.py") for name in newton.SOURCES))


#: Iterate on problems of one kind and one grid size; the first axis of every array counts them.
#: In place: x (P, N, n), u (P, K, m) and, where `warm`, gains (P, K, m, n), the rows' weights held
#: (P, K, p) and multipliers (P, K, n), (P, q). Writes A, B, Σ (P, N, n, n) from the first on, which
#: is given, rows c and their deviations s (P, K, p), (effort, running cost, objective) and (how it
#: ended, steps tried).
solve_many = _compiled(stamp(_sources()))

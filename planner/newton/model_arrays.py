"""The quadratic model of an iteration in arrays, for the compiled iteration.

The same as `model.quadratic_model` and its neighbours. No function here is cached by itself: see
:mod:`.compiled`.
"""

from __future__ import annotations

import numba
import numpy as np

from slipcar.planner.newton.iterate_arrays import add_curvature, semidefinite


@numba.njit(error_model="numpy")
def quadratic(
    addresses, parameters, times, dt, R, weight, w, at, curved, adjoint, nu, Q, q, Rk, r, S
):  # fmt: skip
    """The quadratic model at an iterate, hinges and shift left out: see `model.quadratic_model`."""
    ell, d_ell, c, Hx, Hxx = at[5], at[6], at[7], at[10], at[11]
    x, u, vg, vh = at[14], at[15], at[17], at[18]
    K, n = q.shape
    m, p = r.shape[1], c.shape[1]
    for k in range(K):
        for i in range(n):
            q[k, i] = dt[k] * Hx[k, i]
            for j in range(n):
                Q[k, i, j] = dt[k] * Hxx[k, i, j]
        for i in range(m):
            r[k, i] = dt[k] * ell[k, i]
            for j in range(m):
                Rk[k, i, j] = 2.0 * dt[k] * R[i, j]
                r[k, i] += 2.0 * dt[k] * R[i, j] * u[k, j]
    S[:] = 0.0
    if curved:
        eta = np.empty((K, p))
        for k in range(K):
            for o in range(p):
                eta[k, o] = 2.0 * weight[o] * dt[k] * max(c[k, o], 0.0)
        add_curvature(addresses, parameters, times, dt, x, u, adjoint, nu, eta, Q, Rk, S)
    else:
        for k in range(K):
            semidefinite(Q[k])
    for k in range(K - 1):
        for i in range(n):
            for j in range(m):
                q[k, i] += dt[k + 1] * d_ell[k + 1, j, i] * u[k + 1, j]
            if w > 0.0:
                q[k, i] += vg[k + 1, i]
                for j in range(n):
                    Q[k, i, j] += vh[k + 1, i, j]


@numba.njit(error_model="numpy")
def load(
    dt, weight, at, Q, q, Rk, r, shift, kappa, low, high, lower, upper, stiffness, Qs, qs, Rs, rs
):  # fmt: skip
    """The LQ problem: the model, hinges that are on, shift, held bounds, terminal curvature."""
    c, C, g, G, u = at[7], at[8], at[12], at[13], at[15]
    K, n = q.shape
    m, p = r.shape[1], c.shape[1]
    for k in range(K):
        for i in range(n):
            qs[k, i] = q[k, i]
            for j in range(n):
                Qs[k, i, j] = Q[k, i, j]
            Qs[k, i, i] += 2.0 * dt[k] * shift
        for o in range(p):
            if c[k, o] > 0.0:
                factor = 2.0 * weight[o] * dt[k]
                for i in range(n):
                    a = factor * C[k, o, i]
                    if a != 0.0:
                        qs[k, i] += a * c[k, o]
                        for j in range(n):
                            Qs[k, i, j] += a * C[k, o, j]
        for i in range(m):
            rs[k, i] = r[k, i]
            for j in range(m):
                Rs[k, i, j] = Rk[k, i, j]
            Rs[k, i, i] += 2.0 * dt[k] * shift
            if high[k, i]:
                Rs[k, i, i] += stiffness
                rs[k, i] -= stiffness * (upper[k, i] - u[k, i])
            elif low[k, i]:
                Rs[k, i, i] += stiffness
                rs[k, i] -= stiffness * (lower[k, i] - u[k, i])
    if kappa > 0.0:
        for j in range(len(g)):
            for i in range(n):
                a = kappa * G[j, i]
                if a != 0.0:
                    qs[K - 1, i] += a * g[j]
                    for v in range(n):
                        Qs[K - 1, i, v] += a * G[j, v]


@numba.njit(error_model="numpy")
def active_bounds(u, e, lower, upper, low, high, low_new, high_new):
    """Bounds (K, m) that the step passes; whether they are those it was computed with."""
    same = True
    for k in range(u.shape[0]):
        for i in range(u.shape[1]):
            below, above = u[k, i] + e[k, i] < lower[k, i], u[k, i] + e[k, i] > upper[k, i]
            same = same and below == low[k, i] and above == high[k, i]
            low_new[k, i], high_new[k, i] = below, above
    return same


@numba.njit(error_model="numpy")
def clip(u, ee, lower, upper):
    """Clip a step of the controls to bounds (K, m)."""
    for k in range(ee.shape[0]):
        for i in range(ee.shape[1]):
            ee[k, i] = min(max(u[k, i] + ee[k, i], lower[k, i]), upper[k, i]) - u[k, i]


@numba.njit(error_model="numpy")
def respond(A, B, f, de, ee):
    """Let the states follow the controls."""
    K, n = de.shape
    for k in range(K):
        for i in range(n):
            value = f[k, i]
            if k > 0:
                for j in range(n):
                    value += A[k, i, j] * de[k - 1, j]
            for j in range(ee.shape[1]):
                value += B[k, i, j] * ee[k, j]
            de[k, i] = value


@numba.njit(error_model="numpy")
def model_cost(dt, weight, at, Q, q, Rk, r, S, de, ee):
    """Cost by the model after a step, ∫‖Δu‖² dt and ∫‖Δx‖² dt."""
    c, C, values = at[7], at[8], at[19]
    K, n = q.shape
    m, p = r.shape[1], c.shape[1]
    cost, step, radius = values[0] + values[2] + values[3], 0.0, 0.0
    for k in range(K):
        for i in range(m):
            step += dt[k] * ee[k, i] * ee[k, i]
            inner = r[k, i]
            for j in range(m):
                inner += 0.5 * Rk[k, i, j] * ee[k, j]
            if k > 0:
                for j in range(n):
                    inner += S[k, i, j] * de[k - 1, j]
            cost += inner * ee[k, i]
        for i in range(n):
            radius += dt[k] * de[k, i] * de[k, i]
            inner = q[k, i]
            for j in range(n):
                inner += 0.5 * Q[k, i, j] * de[k, j]
            cost += inner * de[k, i]
        for o in range(p):
            value = c[k, o]
            for i in range(n):
                value += C[k, o, i] * de[k, i]
            if value > 0.0:
                cost += weight[o] * dt[k] * value * value
    return cost, step, radius

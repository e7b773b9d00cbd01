"""Losses and the quadratic model of :mod:`.loop` in arrays, for its compiled form.

The same quantities as in :mod:`.losses` and :mod:`.loop`, filled in place. No
function here is cached by itself: see :mod:`.compiled`.
"""

from __future__ import annotations

import math

import numba

from slipcar.planner.moments.losses import DENSITY, EDGE, EDGE_DENSITY, EDGE_VALUE
from slipcar.planner.newton.iterate_arrays import add_curvature

_ROOT_HALF = math.sqrt(0.5)


@numba.njit(error_model="numpy")
def row_loss(c, s, tail):
    """`losses.loss` of one row of weight one: value, slope, curvature, derivative by variance."""
    t = c / s
    if tail:
        if t <= EDGE:
            density = DENSITY * math.exp(-0.5 * t * t)
            value, slope, curvature = 0.5 * math.erfc(-t * _ROOT_HALF), density, -t * density
        else:
            over = t - EDGE
            value = EDGE_VALUE + EDGE_DENSITY * over * (1.0 + 0.5 * over)
            slope, curvature = EDGE_DENSITY * (1.0 + over), EDGE_DENSITY
        by_variance = max(-0.5 * t * slope, 0.0) / (s * s)
        return value, slope / s, curvature / (s * s), by_variance
    if t < -38.0:  # nothing is left of the tail
        return 0.0, 0.0, 0.0, 0.0
    density, below = DENSITY * math.exp(-0.5 * t * t), 0.5 * math.erfc(-t * _ROOT_HALF)
    value = (c * c + s * s) * below + c * s * density
    return value, 2.0 * (c * below + s * density), 2.0 * below, below


@numba.njit(error_model="numpy")
def row_weight(weight, tail, dt, o, k):
    """Of row o at node k + 1: penalties are charged per second."""
    return weight[o] if tail[o] else weight[o] * dt[k]


@numba.njit(error_model="numpy")
def fill_losses(dt, weight, tail, c, offset, s, slope, curvature):
    """Slopes and curvatures of all rows."""
    for k in range(c.shape[0]):
        for o in range(c.shape[1]):
            slope[k, o] = curvature[k, o] = 0.0
            w = row_weight(weight, tail, dt, o, k)
            if w > 0.0:
                _, first, second, _ = row_loss(c[k, o] + offset[k, o], s[k, o], tail[o])
                slope[k, o], curvature[k, o] = w * first, w * second


@numba.njit(error_model="numpy")
def cost(at, dt, weight, tail, W, soft, offset, s, P):
    """Expected cost, P and s held: `loop._cost`."""
    sigma, c, g, values = at[3], at[7], at[12], at[19]
    K, n, d = sigma.shape
    total = values[0] + values[2]
    for k in range(K):
        for o in range(c.shape[1]):
            scale = row_weight(weight, tail, dt, o, k)
            if scale > 0.0:
                total += scale * row_loss(c[k, o] + offset[k, o], s[k, o], tail[o])[0]
        for a in range(d):
            for i in range(n):
                b = sigma[k, i, a]
                if b != 0.0:
                    for j in range(n):
                        total += dt[k] * b * P[k, i, j] * sigma[k, j, a]
    if soft:
        for v in range(len(g)):
            total += W[v] * g[v] * g[v]
    return total


@numba.njit(error_model="numpy")
def priced(at, adjoint, nu, soft):
    """Σ λᵀf + νᵀg, and the 1-norms of f and g."""
    defect, g = at[16], at[12]
    value, gap, miss = 0.0, 0.0, 0.0
    for k in range(defect.shape[0]):
        for i in range(defect.shape[1]):
            value += adjoint[k, i] * defect[k, i]
            gap += abs(defect[k, i])
    if not soft:
        for j in range(len(g)):
            value += nu[j] * g[j]
            miss += abs(g[j])
    return value, gap, miss


@numba.njit(error_model="numpy")
def quadratic(
    addresses, parameters, times, dt, R, at, slope, curvature, W, soft, adjoint, nu, vg, vh,
    Q, q, Rk, r, S,
):  # fmt: skip
    """`loop._quadratic`."""
    ell, d_ell, C, Hx, Hxx = at[5], at[6], at[8], at[10], at[11]
    g, G, x, u = at[12], at[13], at[14], at[15]
    K, n = q.shape
    m, p = r.shape[1], C.shape[1]
    for k in range(K):
        for i in range(n):
            q[k, i] = dt[k] * Hx[k, i]
            for j in range(n):
                Q[k, i, j] = dt[k] * Hxx[k, i, j]
        for o in range(p):
            if slope[k, o] != 0.0 or curvature[k, o] != 0.0:
                for i in range(n):
                    a = C[k, o, i]
                    if a != 0.0:
                        q[k, i] += a * slope[k, o]
                        for j in range(n):
                            Q[k, i, j] += a * curvature[k, o] * C[k, o, j]
        for i in range(m):
            r[k, i] = dt[k] * ell[k, i]
            for j in range(m):
                Rk[k, i, j] = 2.0 * dt[k] * R[i, j]
                r[k, i] += 2.0 * dt[k] * R[i, j] * u[k, j]
    S[:] = 0.0
    add_curvature(addresses, parameters, times, dt, x, u, adjoint, nu, slope, Q, Rk, S)
    for k in range(K - 1):
        for i in range(n):
            for j in range(m):
                q[k, i] += dt[k + 1] * d_ell[k + 1, j, i] * u[k + 1, j]
            q[k, i] += vg[k + 1, i]
            for j in range(n):
                Q[k, i, j] += vh[k + 1, i, j]
    if soft:
        for v in range(len(W)):
            for i in range(n):
                a = 2.0 * W[v] * G[v, i]
                if a != 0.0:
                    q[K - 1, i] += a * g[v]
                    for j in range(n):
                        Q[K - 1, i, j] += a * G[v, j]


@numba.njit(error_model="numpy")
def model_change(dt, R, Q, q, Rk, r, S, d, e):
    """Change of the cost by the model; ∫‖Δu‖² dt, ∫ΔuᵀRΔu dt and ∫‖Δx‖² dt."""
    K, n = q.shape
    m = r.shape[1]
    change, step, length, radius = 0.0, 0.0, 0.0, 0.0
    for k in range(K):
        for i in range(m):
            step += dt[k] * e[k, i] * e[k, i]
            inner = r[k, i]
            for j in range(m):
                inner += 0.5 * Rk[k, i, j] * e[k, j]
                length += dt[k] * e[k, i] * R[i, j] * e[k, j]
            if k > 0:
                for j in range(n):
                    inner += S[k, i, j] * d[k - 1, j]
            change += inner * e[k, i]
        for i in range(n):
            radius += dt[k] * d[k, i] * d[k, i]
            inner = q[k, i]
            for j in range(n):
                inner += 0.5 * Q[k, i, j] * d[k, j]
            change += inner * d[k, i]
    return change, step, length, radius

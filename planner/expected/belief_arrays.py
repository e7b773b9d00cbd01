"""Covariance, gains and adjoint weights of :mod:`.belief` in arrays, for the compiled iteration.

Filled in place. No function here is cached by itself: see :mod:`.compiled`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from slipcar.planner.expected.arrays import row_loss, row_weight
from slipcar.planner.moments.losses import FLOOR
from slipcar.planner.newton.iterate_arrays import (
    congruence,
    covariance,
    noise_cost_at,
    semidefinite,
)
from slipcar.planner.newton.native import call


@numba.njit(error_model="numpy")
def row_hessians(addresses, parameters, times, x, chosen, bend):
    """∂²c/∂x² of the chosen rows, (p, K, n, n); others stay as they are."""
    p, K = bend.shape[:2]
    for o in range(p):
        if chosen[o]:
            only = np.zeros((K, p))
            only[:, o] = 1.0
            call(
                addresses[4],
                (
                    K, times[1:].ctypes.data, x[1:].ctypes.data, only.ctypes.data,
                    parameters.ctypes.data, bend[o].ctypes.data,
                ),
            )  # fmt: skip


@numba.njit(error_model="numpy")
def expectations(bend, Sigma, chosen, offset):
    """½ tr(∂²c Σ) of the chosen rows."""
    p, K, n = bend.shape[:3]
    for o in range(p):
        if chosen[o]:
            for k in range(K):
                value = 0.0
                for i in range(n):
                    for j in range(n):
                        value += bend[o, k, i, j] * Sigma[k + 1, i, j]
                offset[k, o] = 0.5 * value


@numba.njit(error_model="numpy")
def deviations(C, Sigma, s):
    """`losses.deviations`; Σ at nodes 0..K."""
    K, p, n = C.shape
    for o in range(p):
        largest = 0.0
        for k in range(K):
            value = 0.0
            for i in range(n):
                a = C[k, o, i]
                if a != 0.0:
                    for j in range(n):
                        value += a * Sigma[k + 1, i, j] * C[k, o, j]
            s[k, o] = math.sqrt(max(value, 0.0))
            largest = max(largest, s[k, o])
        for k in range(K):
            s[k, o] = max(s[k, o], FLOOR * largest + 1e-9)


@numba.njit(error_model="numpy")
def close_loop(A, B, gains, closed):
    """A + BK."""
    K, n, m = B.shape
    for k in range(K):
        for i in range(n):
            for j in range(n):
                value = A[k, i, j]
                for v in range(m):
                    value += B[k, i, v] * gains[k, v, j]
                closed[k, i, j] = value


@numba.njit(error_model="numpy")
def optimal_gain(A, B, P, R, dt, gain):
    """−(dt R + BᵀPB)⁻¹ BᵀPA, by Cholesky's factor."""
    n, m = B.shape
    L, BP = np.empty((m, m)), np.zeros((m, n))
    for i in range(m):
        for v in range(n):
            b = B[v, i]
            if b != 0.0:
                for j in range(n):
                    BP[i, j] += b * P[v, j]
    for i in range(m):
        for j in range(i + 1):
            value = dt * R[i, j]
            for v in range(n):
                value += BP[i, v] * B[v, j]
            for v in range(j):
                value -= L[i, v] * L[j, v]
            L[i, j] = math.sqrt(value) if i == j else value / L[j, j]
    for j in range(n):
        for i in range(m):
            value = 0.0
            for v in range(n):
                value -= BP[i, v] * A[v, j]
            for v in range(i):
                value -= L[i, v] * gain[v, j]
            gain[i, j] = value / L[i, i]
        for i in range(m - 1, -1, -1):
            value = gain[i, j]
            for v in range(i + 1, m):
                value -= L[v, i] * gain[v, j]
            gain[i, j] = value / L[i, i]


@numba.njit(error_model="numpy")
def propagate(
    addresses, parameters, times, at, dt, R, weight, tail, W, feedback, w, saturation, damping,
    fresh, lower, upper, gains, held, closed, Sigma, bend, offset, s, P, vg, vh, low_bound,
    high_bound,
):  # fmt: skip
    """`belief.propagate`; writes from `gains` on, but for Σ_0. `fresh`: without weights as yet."""
    A, B, sigma, d_sigma, C, c, Hxx, G = at[1], at[2], at[3], at[4], at[8], at[7], at[11], at[13]
    K, n, m = B.shape
    p = C.shape[1]
    close_loop(A, B, gains, closed)
    covariance(closed, sigma, d_sigma, dt, Sigma)
    deviations(C, Sigma, s)
    charged = weight > 0.0
    row_hessians(addresses, parameters, times, at[14], charged, bend)
    expectations(bend, Sigma, charged, offset)
    largest = 0.0
    wanted = np.zeros((K, p))
    for k in range(K):
        for o in range(p):
            scale = row_weight(weight, tail, dt, o, k)
            if scale > 0.0:
                wanted[k, o] = scale * row_loss(c[k, o] + offset[k, o], s[k, o], tail[o])[3]
                largest = max(largest, wanted[k, o])
    least = 1e-9 * largest + 1e-30
    for k in range(K):
        for o in range(p):
            if fresh or damping == 1.0 or not tail[o]:
                held[k, o] = wanted[k, o]
            else:
                before, now = max(held[k, o], least), max(wanted[k, o], least)
                held[k, o] = before ** (1.0 - damping) * now**damping
    D, PA = np.empty((n, n)), np.empty((n, n))
    for k in range(K, -1, -1):
        # P at node k + 1 is in P[k]; here node k's is made, or, at first, the last node's.
        if k < K:
            noise_cost_at(dt[k], P[k], sigma[k], d_sigma[k], vg[k], vh[k])
            if feedback:
                optimal_gain(A[k], B[k], P[k], R, dt[k], gains[k])
                for i in range(n):
                    for j in range(n):
                        value = A[k, i, j]
                        for v in range(m):
                            value += B[k, i, v] * gains[k, v, j]
                        closed[k, i, j] = value
            if k == 0:
                break
        D[:] = 0.0
        bent = False
        for i in range(n):
            for j in range(n):
                D[i, j] = Hxx[k - 1, i, j]
                bent = bent or D[i, j] != 0.0
        if bent:
            semidefinite(D)
            for i in range(n):
                for j in range(n):
                    D[i, j] *= 0.5 * dt[k - 1]
        for i in range(n):
            D[i, i] += w * dt[k - 1]
        for o in range(p):
            a = held[k - 1, o]
            if a > 0.0:
                for i in range(n):
                    b = a * C[k - 1, o, i]
                    if b != 0.0:
                        for j in range(n):
                            D[i, j] += b * C[k - 1, o, j]
        if k == K:
            for v in range(len(W)):
                for i in range(n):
                    b = W[v] * G[v, i]
                    if b != 0.0:
                        for j in range(n):
                            D[i, j] += b * G[v, j]
        else:
            congruence(closed[k], P[k], PA, D)
            for i in range(n):
                for j in range(n):
                    D[i, j] += 0.5 * vh[k, i, j]
            if feedback:
                for a in range(m):
                    for b in range(m):
                        r = dt[k] * R[a, b]
                        if r != 0.0:
                            for i in range(n):
                                for j in range(n):
                                    D[i, j] += gains[k, a, i] * r * gains[k, b, j]
        for i in range(n):
            for j in range(n):
                P[k - 1, i, j] = 0.5 * (D[i, j] + D[j, i])
    if feedback:
        covariance(closed, sigma, d_sigma, dt, Sigma)
        deviations(C, Sigma, s)
        expectations(bend, Sigma, charged, offset)
    for k in range(K):
        for i in range(m):
            spread = 0.0
            if feedback:
                for a in range(n):
                    for b in range(n):
                        spread += gains[k, i, a] * Sigma[k, a, b] * gains[k, i, b]
            margin = min(saturation * math.sqrt(max(spread, 0.0)), 0.45 * (upper[i] - lower[i]))
            low_bound[k, i], high_bound[k, i] = lower[i] + margin, upper[i] - margin

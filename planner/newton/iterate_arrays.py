"""What is known at an iterate, for the compiled iteration: evaluation and sums.

The same quantities as `model.evaluate` and its neighbours, in arrays that are filled in place. An
iterate is a tuple of arrays; `storage` names its entries. No function here is cached by itself:
see :mod:`.compiled`.
"""

from __future__ import annotations

import numba
import numpy as np

from slipcar.planner.newton.native import call


@numba.njit(error_model="numpy")
def storage(K, n, m, d, p, q):
    """What is known at an iterate."""
    return (
        np.zeros((K, n)),  # 0 next
        np.zeros((K, n, n)),  # 1 A
        np.zeros((K, n, m)),  # 2 B
        np.zeros((K, n, d)),  # 3 σ
        np.zeros((K, n, d, n)),  # 4 ∂σ/∂x
        np.zeros((K, m)),  # 5 ℓ
        np.zeros((K, m, n)),  # 6 ∂ℓ/∂x
        np.zeros((K, p)),  # 7 c
        np.zeros((K, p, n)),  # 8 C
        np.zeros((K, 1)),  # 9 H
        np.zeros((K, n)),  # 10 ∂H/∂x
        np.zeros((K, n, n)),  # 11 ∂²H/∂x²
        np.zeros(q),  # 12 g
        np.zeros((q, n)),  # 13 G
        np.zeros((K + 1, n)),  # 14 x
        np.zeros((K, m)),  # 15 u
        np.zeros((K, n)),  # 16 defect
        np.zeros((K, n)),  # 17 gradient of the variance penalty, nodes 0..K−1
        np.zeros((K, n, n)),  # 18 its Hessian
        np.zeros(6),  # 19 effort, penalty, running, w ∫ tr Σ, largest defect, largest |g|
        np.zeros((K, n, n)),  # 20 Λ: what noise adds to ∫ tr Σ
    )


@numba.njit(error_model="numpy")
def evaluate(addresses, parameters, times, dt, R, weight, w, at):
    """Fill everything that follows from x and u; False if something is not finite."""
    nxt, A, B, sigma, d_sigma, ell, d_ell, c, C, H, Hx, Hxx, g, G = at[:14]
    x, u, defect, vg, vh, values, Lambda = at[14:]
    K, n = nxt.shape
    m, p = u.shape[1], c.shape[1]
    par = parameters.ctypes.data
    call(
        addresses[0],
        (
            K, times.ctypes.data, dt.ctypes.data, x.ctypes.data, u.ctypes.data, par,
            nxt.ctypes.data, A.ctypes.data, B.ctypes.data, sigma.ctypes.data,
            d_sigma.ctypes.data, ell.ctypes.data, d_ell.ctypes.data,
        ),
    )  # fmt: skip
    call(
        addresses[1],
        (
            K, times[1:].ctypes.data, x[1:].ctypes.data, par, c.ctypes.data, C.ctypes.data,
            H.ctypes.data, Hx.ctypes.data, Hxx.ctypes.data,
        ),
    )  # fmt: skip
    call(addresses[2], (1, x[K:].ctypes.data, par, g.ctypes.data, G.ctypes.data))
    values[:] = 0.0
    for k in range(K):
        for i in range(m):
            value = 0.0
            for j in range(m):
                value += R[i, j] * u[k, j]
            values[0] += dt[k] * value * u[k, i]
            values[2] += dt[k] * ell[k, i] * u[k, i]
        for o in range(p):
            if not c[k, o] <= 0.0:  # also if it is NaN
                values[1] += dt[k] * weight[o] * c[k, o] * c[k, o]
        values[2] += dt[k] * H[k, 0]
        for i in range(n):
            defect[k, i] = nxt[k, i] - x[k + 1, i]
            values[4] = max(values[4], abs(defect[k, i]))
    for j in range(len(g)):
        values[5] = max(values[5], abs(g[j]))
    if w > 0.0:
        values[3] = variance(w, A, sigma, d_sigma, dt, Lambda, vg, vh)
    # A sum is finite only if every summand is (infinities cancel to NaN). Derivatives other than A
    # are left out: where values are finite they are too, or the LQ problem finds out.
    total = values.sum() + g.sum()
    for k in range(K):
        for i in range(n):
            total += defect[k, i]
            for j in range(n):
                total += A[k, i, j]
            if w == 0.0:  # otherwise it is in the variance
                for j in range(sigma.shape[2]):
                    total += sigma[k, i, j]
    return np.isfinite(total)


@numba.njit(error_model="numpy")
def variance(w, A, sigma, d_sigma, dt, Lambda, gradient, hessian):
    """`moments.variance_penalty`, with Λ by its backward sweep."""
    K, n = gradient.shape
    LA = np.empty((n, n))
    for k in range(K - 1, -1, -1):
        Lambda[k] = 0.0
        if k < K - 1:
            congruence(A[k + 1], Lambda[k + 1], LA, Lambda[k])
        for i in range(n):
            Lambda[k, i, i] += dt[k]
    return noise_cost(w, Lambda, sigma, d_sigma, dt, gradient, hessian)


@numba.njit(error_model="numpy")
def congruence(A, P, PA, out):
    """Add AᵀPA to `out`; `PA` is scratch."""
    n = len(A)
    PA[:] = 0.0
    for i in range(n):
        for v in range(n):
            a = P[i, v]
            if a != 0.0:
                for j in range(n):
                    PA[i, j] += a * A[v, j]
    for v in range(n):
        for i in range(n):
            a = A[v, i]
            if a != 0.0:
                for j in range(n):
                    out[i, j] += a * PA[v, j]


@numba.njit(error_model="numpy")
def noise_cost(w, P, sigma, d_sigma, dt, gradient, hessian):
    """The cost w Σ dt tr(P σσᵀ), and its gradient and Hessian by the states, σ linearised."""
    value = 0.0
    for k in range(len(sigma)):
        value += noise_cost_at(w * dt[k], P[k], sigma[k], d_sigma[k], gradient[k], hessian[k])
    return value


@numba.njit(error_model="numpy")
def noise_cost_at(scale, P, sigma, d_sigma, gradient, hessian):
    """The same of one node."""
    n, d = sigma.shape
    value = 0.0
    weighted = np.empty((n, d))
    gradient[:] = 0.0
    hessian[:] = 0.0
    for a in range(d):
        for i in range(n):
            total = 0.0
            for v in range(n):
                total += P[i, v] * sigma[v, a]
            weighted[i, a] = scale * total
            value += weighted[i, a] * sigma[i, a]
        for i in range(n):
            for y in range(n):
                slope = d_sigma[i, a, y]
                if slope != 0.0:
                    gradient[y] += 2.0 * weighted[i, a] * slope
                    for v in range(n):
                        share = 2.0 * scale * P[i, v] * slope
                        if share != 0.0:
                            for z in range(n):
                                hessian[y, z] += share * d_sigma[v, a, z]
    return value


@numba.njit(error_model="numpy")
def semidefinite(M):
    """Project a symmetric matrix to the nearest positive semidefinite one, in place."""
    n = len(M)
    zero = True
    for i in range(n):
        for j in range(n):
            zero = zero and M[i, j] == 0.0
    if zero:
        return
    values, vectors = np.linalg.eigh(M)
    if values[0] >= 0.0:
        return
    M[:] = 0.0
    for v in range(n):
        if values[v] > 0.0:
            for i in range(n):
                for j in range(n):
                    M[i, j] += values[v] * vectors[i, v] * vectors[j, v]


@numba.njit(error_model="numpy")
def lagrangian(at, adjoint, nu, w, dt, Lambda):
    """Cost + Σ λᵀf + νᵀg, Λ of the variance held; and the 1-norms of f and g."""
    sigma, defect, g, values = at[3], at[16], at[12], at[19]
    value, gap, miss = values[0] + values[1] + values[2], 0.0, 0.0
    if w > 0.0:
        for k in range(sigma.shape[0]):
            for i in range(sigma.shape[1]):
                for j in range(sigma.shape[1]):
                    for a in range(sigma.shape[2]):
                        part = sigma[k, i, a] * sigma[k, j, a]
                        value += w * dt[k] * Lambda[k, i, j] * part
    for k in range(defect.shape[0]):
        for i in range(defect.shape[1]):
            value += adjoint[k, i] * defect[k, i]
            gap += abs(defect[k, i])
    for j in range(len(g)):
        value += nu[j] * g[j]
        miss += abs(g[j])
    return value, gap, miss


@numba.njit(error_model="numpy")
def inconsistency(at):
    """Largest entry of the defects carried forward along the linearised dynamics."""
    A, defect = at[1], at[16]
    K, n = defect.shape
    gap, new = np.zeros(n), np.empty(n)
    worst = 0.0
    for k in range(K):
        for i in range(n):
            value = defect[k, i]
            for j in range(n):
                value += A[k, i, j] * gap[j]
            new[i] = value
            worst = max(worst, abs(value))
        gap[:] = new
    return worst


@numba.njit(error_model="numpy")
def covariance(A, sigma, d_sigma, dt, Sigma):
    """`moments.covariance`, from the Σ_0 that is there on."""
    K, n, d = sigma.shape
    scratch, noise = np.empty((n, n)), np.empty((n, n))
    for k in range(K):
        noise_of(sigma[k], noise)
        # Σ of the states that σ depends on adds to the noise: σ′ Σ σ′ᵀ.
        for a in range(d):
            for i in range(n):
                for y in range(n):
                    b = d_sigma[k, i, a, y]
                    if b != 0.0:
                        for z in range(n):
                            c = b * Sigma[k, y, z]
                            if c != 0.0:
                                for j in range(n):
                                    noise[i, j] += c * d_sigma[k, j, a, z]
        spread(A[k], Sigma[k], dt[k], noise, scratch, Sigma[k + 1])


@numba.njit(error_model="numpy")
def start_share(A, Lambda, start):
    """`moments.start_share`; A and Λ of the first interval."""
    n = len(A)
    LA, weight, value = np.empty((n, n)), np.zeros((n, n)), 0.0
    congruence(A, Lambda, LA, weight)
    for i in range(n):
        for j in range(n):
            value += weight[i, j] * start[i, j]
    return value


@numba.njit(error_model="numpy")
def noise_of(sigma, noise):
    """Write σσᵀ."""
    n, d = sigma.shape
    noise[:] = 0.0
    for a in range(d):
        for i in range(n):
            b = sigma[i, a]
            if b != 0.0:
                for j in range(n):
                    noise[i, j] += b * sigma[j, a]


@numba.njit(error_model="numpy")
def spread(A, S, dt, noise, scratch, out):
    """Write A S Aᵀ + dt noise."""
    n = len(A)
    scratch[:] = 0.0
    for i in range(n):
        for v in range(n):
            a = A[i, v]
            if a != 0.0:
                for j in range(n):
                    scratch[i, j] += a * S[v, j]
    for i in range(n):
        for j in range(n):
            value = dt * noise[i, j]
            for v in range(n):
                value += scratch[i, v] * A[j, v]
            out[i, j] = value


@numba.njit(error_model="numpy")
def add_curvature(addresses, parameters, times, dt, x, u, adjoint, nu, eta, Q, R, S):
    """Add the Hessian of the Lagrangian: of the dynamics, the hinges and the terminal condition."""
    K, n = adjoint.shape
    m, p = u.shape[1], eta.shape[1]
    par = parameters.ctypes.data
    xx, ux, uu = np.zeros((K, n, n)), np.zeros((K, m, n)), np.zeros((K, m, m))
    call(
        addresses[3],
        (
            K, times.ctypes.data, dt.ctypes.data, x.ctypes.data, u.ctypes.data,
            adjoint.ctypes.data, par, xx.ctypes.data, ux.ctypes.data, uu.ctypes.data,
        ),
    )  # fmt: skip
    for k in range(K):
        for i in range(m):
            for j in range(m):
                R[k, i, j] += uu[k, i, j]
            for j in range(n):
                S[k, i, j] = ux[k, i, j]
        if k > 0:
            for i in range(n):
                for j in range(n):
                    Q[k - 1, i, j] += xx[k, i, j]
    if p > 0:
        xx[:] = 0.0
        call(
            addresses[4],
            (
                K, times[1:].ctypes.data, x[1:].ctypes.data, eta.ctypes.data, par,
                xx.ctypes.data,
            ),
        )  # fmt: skip
        for k in range(K):
            for i in range(n):
                for j in range(n):
                    Q[k, i, j] += xx[k, i, j]
    last = np.zeros((n, n))
    call(addresses[5], (1, x[K:].ctypes.data, nu.ctypes.data, par, last.ctypes.data))
    for i in range(n):
        for j in range(n):
            Q[K - 1, i, j] += last[i, j]

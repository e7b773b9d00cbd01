"""The LQ problem of one iteration by a Riccati recursion, compiled with numba.

    minimise   Σ_{k=0}^{K-1} ½ e_kᵀR_k e_k + r_kᵀe_k + e_kᵀS_k d_k  +  Σ_{k=1}^{K} ½ d_kᵀQ_k d_k
               + q_kᵀd_k
    s.t.       d_{k+1} = A_k d_k + B_k e_k + f_k,   d_0 = 0,   G d_K + g = 0

Problem-agnostic: it knows matrices, not the car. Q may be indefinite: the recursion succeeds
exactly if the problem is convex in the controls, which makes it the inertia test of Newton's
method. The multiplier ν of the terminal condition enters linearly: with the cost to go

    V_k(d, ν) = ½ dᵀP d + (p + Π ν)ᵀ d + const + sᵀν − ½ νᵀW ν

one backward sweep gives s and W, and the terminal condition is the q x q system W ν = s + g.
"""

from __future__ import annotations

import numba
import numpy as np

#: The system of the terminal condition is regularised by this much, relative to its Gramian.
SOFTNESS = 1e-13


@numba.njit(error_model="numpy")
def workspace(K, n, m, t):
    """Arrays that :func:`solve_lq` writes in: cost to go, gains, and scratch."""
    return (
        np.empty((K, n, n)),  # P at nodes 1..K
        np.empty((K, n)),  # p
        np.empty((K, n, t)),  # Π
        np.empty((K, m, 1 + t + n)),  # feedforward, its part linear in ν, gain (negative)
        np.empty((m, m)),  # Cholesky factor
        np.empty((m, 1 + t + n)),  # right-hand sides before they are solved for
        np.empty((m, n)),  # BᵀP
        np.empty((n, n)),  # P A
        np.empty(n),  # P f + p
        np.empty((t, t)),  # W
        np.empty(t),  # s
    )


@numba.njit(error_model="numpy")
def solve_lq(A, B, f, Q, q, R, r, S, G, g, gramian, work, d, e, adjoint, nu):
    """Solve; write deviations d (K, n), e (K, m), adjoint (K, n) and ν (q,).

    Returns:
        Whether the problem is convex in the controls and the solution finite.
    """
    P_all, p_all, Pi_all, gains, L, raw, BtP, PA, y, W, s = work
    K, n = f.shape
    m, t = B.shape[2], G.shape[0]
    width = 1 + t + n
    W[:] = 0.0
    s[:] = 0.0
    for i in range(n):
        p_all[K - 1, i] = q[K - 1, i]
        for j in range(n):
            P_all[K - 1, i, j] = Q[K - 1, i, j]
        for j in range(t):
            Pi_all[K - 1, i, j] = G[j, i]
    for k in range(K - 1, -1, -1):
        P, p, Pi, Ak, Bk = P_all[k], p_all[k], Pi_all[k], A[k], B[k]
        gain = gains[k]
        for i in range(n):
            value = p[i]
            for j in range(n):
                value += P[i, j] * f[k, j]
            y[i] = value
        BtP[:] = 0.0
        for v in range(n):
            for i in range(m):
                b = Bk[v, i]
                if b != 0.0:
                    for j in range(n):
                        BtP[i, j] += b * P[v, j]
        # Cholesky factor of R + BᵀPB.
        for i in range(m):
            for j in range(i + 1):
                value = R[k, i, j]
                for v in range(n):
                    value += BtP[i, v] * Bk[v, j]
                for v in range(j):
                    value -= L[i, v] * L[j, v]
                if i == j:
                    if not value > 0.0:
                        return False
                    L[i, i] = np.sqrt(value)
                else:
                    L[i, j] = value / L[j, j]
        # Right-hand sides r + Bᵀy, BᵀΠ and S + BᵀPA; then solved with the factor.
        for i in range(m):
            raw[i, 0] = r[k, i]
            for j in range(t):
                raw[i, 1 + j] = 0.0
            for j in range(n):
                raw[i, 1 + t + j] = S[k, i, j]
            for v in range(n):
                b = Bk[v, i]
                if b != 0.0:
                    raw[i, 0] += b * y[v]
                    for j in range(t):
                        raw[i, 1 + j] += b * Pi[v, j]
                b = BtP[i, v]
                for j in range(n):
                    raw[i, 1 + t + j] += b * Ak[v, j]
        for i in range(m):
            for j in range(width):
                gain[i, j] = raw[i, j]
        for i in range(m):
            for v in range(i):
                for j in range(width):
                    gain[i, j] -= L[i, v] * gain[v, j]
            inverse = 1.0 / L[i, i]
            for j in range(width):
                gain[i, j] *= inverse
        for i in range(m - 1, -1, -1):
            for v in range(i + 1, m):
                for j in range(width):
                    gain[i, j] -= L[v, i] * gain[v, j]
            inverse = 1.0 / L[i, i]
            for j in range(width):
                gain[i, j] *= inverse
        for j in range(t):
            value = 0.0
            for i in range(n):
                value += Pi[i, j] * f[k, i]
            for i in range(m):
                value -= raw[i, 1 + j] * gain[i, 0]
            s[j] += value
            for i in range(m):
                a = raw[i, 1 + j]
                for v in range(t):
                    W[j, v] += a * gain[i, 1 + v]
        if k == 0:
            break
        # P⁻ = Q + AᵀPA − (S + BᵀPA)ᵀ(...)⁻¹(S + BᵀPA); p⁻ and Π⁻ likewise.
        PA[:] = 0.0
        for i in range(n):
            for v in range(n):
                a = P[i, v]
                for j in range(n):
                    PA[i, j] += a * Ak[v, j]
        newP, newp, newPi = P_all[k - 1], p_all[k - 1], Pi_all[k - 1]
        for i in range(n):
            newp[i] = q[k - 1, i]
            for j in range(n):
                newP[i, j] = Q[k - 1, i, j]
            for j in range(t):
                newPi[i, j] = 0.0
        for v in range(n):
            for i in range(n):
                a = Ak[v, i]
                if a != 0.0:
                    newp[i] += a * y[v]
                    for j in range(n):
                        newP[i, j] += a * PA[v, j]
                    for j in range(t):
                        newPi[i, j] += a * Pi[v, j]
        for v in range(m):
            for i in range(n):
                a = raw[v, 1 + t + i]
                newp[i] -= a * gain[v, 0]
                for j in range(n):
                    newP[i, j] -= a * gain[v, 1 + t + j]
                for j in range(t):
                    newPi[i, j] -= a * gain[v, 1 + j]
        for i in range(n):
            for j in range(i):
                mean = 0.5 * (newP[i, j] + newP[j, i])
                newP[i, j] = mean
                newP[j, i] = mean
    if t > 0:
        for j in range(t):
            W[j, j] += SOFTNESS * gramian
            s[j] += g[j]
        if not solve_symmetric(W, s):
            return False
        for j in range(t):
            nu[j] = s[j]
    for k in range(K):
        gain = gains[k]
        for i in range(m):
            value = gain[i, 0]
            for j in range(t):
                value += gain[i, 1 + j] * nu[j]
            if k > 0:
                for j in range(n):
                    value += gain[i, 1 + t + j] * d[k - 1, j]
            e[k, i] = -value
        for i in range(n):
            value = f[k, i]
            if k > 0:
                for j in range(n):
                    value += A[k, i, j] * d[k - 1, j]
            for j in range(m):
                value += B[k, i, j] * e[k, j]
            d[k, i] = value
        for i in range(n):
            value = p_all[k, i]
            for j in range(t):
                value += Pi_all[k, i, j] * nu[j]
            for j in range(n):
                value += P_all[k, i, j] * d[k, j]
            adjoint[k, i] = value
            if not np.isfinite(value):
                return False
    return True


@numba.njit(error_model="numpy")
def solve_symmetric(W, s):
    """W ν = s in place by Cholesky; False if W is not positive definite.

    W is Σ BᵀΠ...: positive definite when the linearised dynamics reach every component of the
    terminal condition.
    """
    t = len(s)
    for i in range(t):
        for j in range(i + 1):
            value = W[i, j]
            for v in range(j):
                value -= W[i, v] * W[j, v]
            if i == j:
                if not value > 0.0:
                    return False
                W[i, i] = np.sqrt(value)
            else:
                W[i, j] = value / W[j, j]
    for i in range(t):
        for v in range(i):
            s[i] -= W[i, v] * s[v]
        s[i] /= W[i, i]
    for i in range(t - 1, -1, -1):
        for v in range(i + 1, t):
            s[i] -= W[v, i] * s[v]
        s[i] /= W[i, i]
    return True

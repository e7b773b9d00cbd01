"""The LQ problem of one iteration by a Riccati recursion, in NumPy.

    minimise   Σ_{k=0}^{K-1} ½ e_kᵀR_k e_k + r_kᵀe_k + e_kᵀS_k d_k  +  Σ_{k=1}^{K} ½ d_kᵀQ_k d_k
               + q_kᵀd_k
    s.t.       d_{k+1} = A_k d_k + B_k e_k + f_k,   d_0 = 0,   G d_K + g = 0

With the multiplier ν of the terminal condition the cost to go is a quadratic form in
y = (d, 1, ν), one symmetric matrix V_k:

    T_k = cost of stage k + F_kᵀ V_{k+1} F_k,   F_k: (e, d, 1, ν) -> (d⁺, 1, ν)
    V_k = what is left of T_k when e is eliminated (its Schur complement)

Q may be indefinite. The pivots of the elimination are positive exactly if the problem is convex in
the controls: the inertia test of Newton's method. In ν the form is concave; its stationary point
is the terminal condition. :mod:`.riccati` is the same recursion compiled.
"""

from __future__ import annotations

import dataclasses

import numpy as np

Array = np.ndarray

#: The system of the terminal condition is regularised by this much, relative to its trace.
SOFTNESS = 1e-13


@dataclasses.dataclass(frozen=True)
class LqSolution:
    """Solution of an LQ problem.

    Attributes:
        d: nodes 1..K, (K, n).
        e: (K, m).
        adjoint: λ_1..λ_K, (K, n).
        terminal: ν, (q,).
        gramian: trace of the Gramian of the terminal condition.
    """

    d: Array
    e: Array
    adjoint: Array
    terminal: Array
    gramian: float


def solve_lq(
    A: Array, B: Array, f: Array, Q: Array, q: Array, R: Array, r: Array, S: Array, G: Array,
    g: Array,
) -> LqSolution | None:  # fmt: skip
    """Solve; None if the problem is not convex in the controls, or the solution not finite.

    Args:
        A: (K, n, n).
        B: (K, n, m).
        f: (K, n).
        Q: nodes 1..K, (K, n, n).
        q: (K, n).
        R: (K, m, m).
        r: (K, m).
        S: (K, m, n); that of node 0 has no effect.
        G: (q, n).
        g: (q,).
    """
    K, n = f.shape
    m, t = B.shape[2], len(g)
    F = np.zeros((K, n + 1 + t, m + n + 1 + t))
    F[:, :n, :m], F[:, :n, m : m + n], F[:, :n, m + n] = B, A, f
    F[:, range(n, n + 1 + t), range(m + n, m + n + 1 + t)] = 1.0
    T_all = np.zeros((K, m + n + 1 + t, m + n + 1 + t))
    T_all[:, :m, :m], T_all[:, :m, m + n], T_all[:, m + n, :m] = R, r, r
    T_all[:, :m, m : m + n], T_all[:, m : m + n, :m] = S, S.swapaxes(1, 2)
    T_all[1:, m : m + n, m : m + n] = Q[:-1]
    T_all[1:, m : m + n, m + n] = T_all[1:, m + n, m : m + n] = q[:-1]
    V = np.zeros((n + 1 + t, n + 1 + t))
    V[:n, :n], V[:n, n], V[n, :n] = Q[-1], q[-1], q[-1]
    V[:n, n + 1 :], V[n + 1 :, :n] = G.T, G
    V_all, gains = np.empty((K, n + 1 + t, n + 1 + t)), np.empty((K, m, n + 1 + t))
    for k in range(K - 1, -1, -1):
        V_all[k] = V
        Fk = F[k]
        T = Fk.T.dot(V).dot(Fk)
        T += T_all[k]
        # Gauss–Jordan on the controls: the first m rows become the feedback law.
        for i in range(m):
            pivot = T[i, i]
            if not pivot > 0.0:
                return None
            row = T[i] / pivot
            T -= T[:, i, None] * row
            T[i] = row
        gains[k] = T[:m, m:]
        V = T[m:, m:]
        V = 0.5 * (V + V.T)
    W, s = -V[n + 1 :, n + 1 :], V[n + 1 :, n]
    gramian = float(np.trace(W))
    y = np.zeros(n + 1 + t)
    y[n] = 1.0
    if t > 0:
        if not (np.isfinite(gramian) and gramian > 0.0):
            return None
        W = W + SOFTNESS * gramian * np.eye(t)
        try:
            np.linalg.cholesky(W)
        except np.linalg.LinAlgError:
            return None
        y[n + 1 :] = np.linalg.solve(W, s + g)
    e, d, adjoint = np.empty((K, m)), np.empty((K, n)), np.empty((K, n))
    for k in range(K):
        e[k] = -gains[k].dot(y)
        d[k] = y[:n] = F[k, :n, :m].dot(e[k]) + F[k, :n, m:].dot(y)
        adjoint[k] = V_all[k, :n].dot(y)
    if not np.isfinite(adjoint).all():
        return None
    return LqSolution(d, e, adjoint, y[n + 1 :].copy(), gramian)

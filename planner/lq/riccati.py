"""One stage of the linear-quadratic problem, and its end: a Riccati recursion with multipliers.

    minimise   Σ_{k=0}^{K-1} ½ e_kᵀR_k e_k + r_kᵀe_k + e_kᵀS_k d_k  +  Σ_{k=1}^{K} ½ d_kᵀQ_k d_k
               + q_kᵀd_k
    s.t.       d_{k+1} = A_k d_k + B_k e_k + f_k,   d_0 = 0,   G d_K + g = 0

The cost to go is a quadratic ½ yᵀV y in y = (d, 1, ν): state, one, and the multiplier ν of the
terminal condition, which enters linearly. A stage is then

    T = FᵀV F + stage,   F = [B A f 0; 0 I]  in (e, y),     e eliminated by its pivots

and the block of ν at the beginning is the system W ν = s of the terminal condition. Q may be
indefinite: the problem is convex in the controls exactly if every pivot is positive, which is the
inertia test of Newton's method. Arrays of numbers and of expressions alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.planner.trace.elementwise import choose, larger, magnitude

Array = np.ndarray

#: The system of the terminal condition is regularised by this much, relative to its diagonal.
SOFTNESS = 1e-13


def last_value(Q: Array, q: Array, G: Array) -> Array:
    """V of the last node, (n + 1 + t, n + 1 + t); the constant, entry (n, n), is left at zero."""
    n, t = len(q), len(G)
    V = np.zeros((n + 1 + t, n + 1 + t), dtype=np.result_type(Q, q, G))
    V[:n, :n], V[:n, n], V[n, :n] = Q, q, q
    V[:n, n + 1 :], V[n + 1 :, :n] = G.T, G
    return V


def stage(
    V: Array, A: Array, B: Array, f: Array, Q: Array, q: Array, R: Array, r: Array, S: Array
) -> tuple[Array, Array, Any]:
    """One stage backwards from V of the next node.

    Returns:
        V of this node, the law −e in y (m, n + 1 + t), and how many pivots are not positive.
    """
    n, m = B.shape
    size = len(V)
    # Rows of F beyond the state's are the identity.
    F = np.zeros((size, m + size), dtype=V.dtype)
    F[:n, :m], F[:n, m : m + n], F[:n, m + n] = B, A, f
    F[range(n, size), range(m + n, m + size)] = 1.0
    T = F.T.dot(V).dot(F)
    T[:m, :m] += R
    T[:m, m + n] += r
    T[m + n, :m] += r
    T[:m, m : m + n] += S
    T[m : m + n, :m] += S.T
    T[m : m + n, m : m + n] += Q
    T[m : m + n, m + n] += q
    T[m + n, m : m + n] += q
    bad: Any = 0.0
    for i in range(m):
        bad = bad + choose(T[i, i], 0.0, 1.0)
        # T is symmetric but for the rows above, which are done; one division a pivot.
        column, row = np.concatenate([T[:i, i], T[i, i:]]), T[i] * (1.0 / T[i, i])
        T = T - column[:, None] * row
        T[i] = row
    T[m + n, m + n] = 0.0
    return T[m:, m:], T[:m, m:], bad


def terminal_multiplier(V: Array, g: Array, softness: Any, rounding: Array) -> tuple[Array, Any]:
    """ν of the terminal condition from V at the beginning, by Cholesky; bad pivots counted.

    Args:
        V: of node 0, where d = 0.
        g: (t,).
        softness: this part of W's diagonal is added to it.
        rounding: (t,): a condition that no control moves is met if it lacks no more.
    """
    t = len(g)
    n = len(V) - 1 - t
    W, s = -V[n + 1 :, n + 1 :], V[n, n + 1 :] + g
    L = np.zeros((t, t), dtype=W.dtype)
    bad: Any = 0.0
    y: list[Any] = []
    for i in range(t):
        for j in range(i):
            L[i, j] = (W[i, j] - L[i, :j].dot(L[j, :j])) / L[j, j]
        rest = s[i] - sum(L[i, j] * y[j] for j in range(i))
        pivot = W[i, i] - L[i, :i].dot(L[i, :i]) + softness * W[i, i]
        # What cannot be moved need not be, if it is where it must be.
        pivot = choose(pivot, pivot, choose(magnitude(rest) - rounding[i], pivot, 1.0))
        bad = bad + choose(pivot, 0.0, 1.0)
        L[i, i] = np.sqrt(pivot)
        y.append(rest / L[i, i])
    nu = np.array(y, dtype=W.dtype)
    for i in range(t - 1, -1, -1):
        nu[i] = (y[i] - sum(L[j, i] * nu[j] for j in range(i + 1, t))) / L[i, i]
    return nu, bad


def respond(law: Array, d: Array, nu: Array) -> Array:
    """The control's step e = −law · (d, 1, ν)."""
    n = len(d)
    return -(law[:, :n].dot(d) + law[:, n] + (law[:, n + 1 :].dot(nu) if len(nu) else 0.0))


def adjoint(V: Array, d: Array, nu: Array) -> Array:
    """λ = ∂(cost to go)/∂d, (n,), at d with multipliers ν."""
    n = len(d)
    value = V[:n, :n].dot(d) + V[:n, n]
    return value + V[:n, n + 1 :].dot(nu) if len(nu) else value


def largest(values: Array, start: Any) -> Any:
    """max(start, max |values|)."""
    for value in values:
        start = larger(magnitude(value), start)
    return start

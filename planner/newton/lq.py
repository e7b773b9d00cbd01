"""The LQ problem of one iteration in NumPy and LAPACK.

    minimise   Σ_{k=0}^{K-1} ½ e_kᵀR_k e_k + r_kᵀe_k + e_kᵀS_k d_k
             + Σ_{k=1}^{K}   ½ d_kᵀQ_k d_k + q_kᵀd_k
    s.t.       d_{k+1} = A_k d_k + B_k e_k + f_k,   d_0 = 0,   G d_K + g = 0

Solved as one banded system (:mod:`slipcar.planner.lq.banded`), in which Q may be indefinite.
Whether the problem is then convex in the controls, so that the solution is a minimum, is a question
of inertia. The compiled iteration reads it off the pivots of its recursion (:mod:`.riccati`); here

    H + c CᵀC  is positive definite,    C d = f the dynamics,  c large,

by a banded Cholesky factorisation (Debreu's lemma: H is positive definite where C vanishes).
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np

from slipcar.planner.lq.banded import BandedKkt

Array = np.ndarray

#: The system of the terminal condition is regularised by this much, relative to its Gramian.
SOFTNESS = 1e-13
#: c of the inertia test, relative to the largest entry of Q.
_PENALTY = 1e7


@dataclasses.dataclass(frozen=True)
class LqSolution:
    """Solution of an LQ problem.

    Attributes:
        d: nodes 1..K, (K, n).
        e: (K, m).
        adjoint: λ_1..λ_K, (K, n).
        terminal: ν, (q,).
    """

    d: Array
    e: Array
    adjoint: Array
    terminal: Array


class LqSolver:
    """Solves LQ problems of one shape; index arrays are computed once.

    Args:
        K: intervals.
        n: states.
        m: controls.
        q: terminal conditions.
    """

    def __init__(self, K: int, n: int, m: int, q: int) -> None:
        self._kkt = BandedKkt(K, n, q)
        self._inertia = _Inertia(K, n, m)
        self._held = np.ones(q, dtype=bool)
        self._none = np.zeros((K, 0, n)), np.zeros((K, 0))

    def solve(
        self, A: Array, B: Array, f: Array, Q: Array, q: Array, R: Array, r: Array, S: Array | None,
        G: Array, g: Array, gramian: float, *, convex: bool,
    ) -> LqSolution | None:  # fmt: skip
        """Solve; None if the problem is not convex in the controls, or singular.

        Args:
            A: (K, n, n).
            B: (K, n, m).
            f: (K, n).
            Q: nodes 1..K, (K, n, n).
            q: (K, n).
            R: (K, m, m), positive definite.
            r: (K, m).
            S: (K, m, n) or None for zero; that of node 0 has no effect.
            G: (q, n).
            g: (q,).
            gramian: scale of the terminal condition; see :func:`gramian_trace`.
            convex: whether the problem is known to be convex.
        """
        if not convex and not self._inertia.positive(A, B, Q, R, S):
            return None
        law: Array | None = None
        if S is not None:
            # With e = e′ − R⁻¹ (S d + r) the cross term is gone.
            law = np.linalg.solve(R, np.concatenate([S, r[..., None]], axis=2))
            law[0, :, :-1] = 0.0
            A = A - B @ law[..., :-1]
            f = f - (B @ law[..., -1:])[..., 0]
            Q, q = Q.copy(), q.copy()
            across = S[1:].swapaxes(1, 2)
            Q[:-1] -= across @ law[1:, :, :-1]
            q[:-1] -= (across @ law[1:, :, -1:])[..., 0]
            r = np.zeros_like(r)
        rows, none = self._none
        self._kkt.load(
            SimpleNamespace(A=A, B=B, f=f, Q=Q, q=q, R=R, r=r, a=rows, G=G)  # type: ignore[arg-type]
        )
        softness = np.full(len(g), -SOFTNESS * gramian)
        point = self._kkt.solve(none, none, self._held, softness, -g)
        if point is None:
            return None
        e = point.e
        if law is not None:
            before = np.vstack([np.zeros_like(point.d[:1]), point.d[:-1]])
            e = e - (law[..., :-1] @ before[..., None])[..., 0] - law[..., -1]
        return LqSolution(point.d, e, point.adjoint, point.terminal)


def gramian_trace(A: Array, B: Array, R: Array, G: Array) -> float:
    """Σ tr(G Φ_k B_k R_k⁻¹ B_kᵀΦ_kᵀGᵀ): how far controls of unit cost move the end.

    Args:
        A: (K, n, n).
        B: (K, n, m).
        R: (K, m, m).
        G: (q, n).
    """
    Phi, total = G, 0.0
    moved = B @ np.linalg.inv(R) @ B.swapaxes(1, 2)
    for k in range(len(A) - 1, -1, -1):
        total += float(np.vdot(Phi, Phi.dot(moved[k])))
        Phi = Phi.dot(A[k])
    return total


class _Inertia:
    """Whether the problem is strictly convex where the dynamics hold."""

    def __init__(self, K: int, n: int, m: int) -> None:
        self._shape = (K, n, m)
        block = n + m  # variables e_k, d_{k+1}; stage k couples d_k, e_k and d_{k+1}
        self._size, self._width = K * block, 2 * block
        i = np.arange(n + block)
        first = (np.arange(K) * block - n)[:, None, None]
        row, column = np.broadcast_arrays(first + i[:, None], first + i[None, :])
        self._kept = (row >= column) & (column >= 0)
        self._at = (column * self._width + row - column)[self._kept]

    def positive(self, A: Array, B: Array, Q: Array, R: Array, S: Array | None) -> bool:
        """Arguments as for `LqSolver.solve`."""
        K, n, m = self._shape
        C = np.empty((K, n, 2 * n + m))
        C[..., :n], C[..., n : n + m], C[..., n + m :] = A, B, -np.eye(n)
        largest = max(float(np.max(np.abs(Q))), float(np.min(np.einsum("kii->ki", R).max(axis=1))))
        M = (_PENALTY * largest) * (C.swapaxes(1, 2) @ C)
        M[:, n + m :, n + m :] += Q
        M[:, n : n + m, n : n + m] += R
        if S is not None:
            M[:, n : n + m, :n] += S
        band = np.bincount(self._at, M[self._kept], minlength=self._size * self._width)
        band = band.reshape(self._size, self._width).T
        if not np.isfinite(largest):
            return False
        from scipy.linalg import lapack  # here: compiled plans do without SciPy's import time

        return lapack.dpbtrf(band, lower=1, overwrite_ab=1)[1] == 0

"""The LQ problem at the heart of every structured step, as one banded linear system.

    minimise  Σ ½ eᵀRe + rᵀe + ½ dᵀQd + qᵀd    s.t.   d⁺ = A d + B e + f,   d_0 = 0,
              G d_K − δ ν = s

With the controls eliminated, e = −R⁻¹(r + Bᵀλ), its optimality conditions are

    −λ_k + Q_k d_k + A_kᵀ λ_{k+1} = −q_k
    d_{k+1} = A_k d_k − B_k R_k⁻¹ (r_k + B_kᵀ λ_{k+1}) + f_k,

banded with 2n − 1 off-diagonals in the order λ_1, d_1, λ_2, d_2, ..., d_K, ν.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.convex.convexify import Subproblem

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Point:
    """A primal-dual point of the sub-problem.

    Attributes:
        d: deviations of nodes 1..K, (K, n).
        e: control deviations, (K, m).
        adjoint: λ_1..λ_K, (K, n).
        terminal: ν, (q,).
    """

    d: Array
    e: Array
    adjoint: Array
    terminal: Array

    def towards(self, other: Point, step: float) -> Point:
        """The point a fraction `step` of the way to another."""
        return Point(
            self.d + step * (other.d - self.d),
            self.e + step * (other.e - self.e),
            self.adjoint + step * (other.adjoint - self.adjoint),
            self.terminal + step * (other.terminal - self.terminal),
        )


class BandedKkt:
    """The matrix in LAPACK band storage, with index arrays computed once per shape."""

    def __init__(self, K: int, n: int, q: int) -> None:
        self.shape = (K, n, q)
        self.size = 2 * n * K + q
        self.width = max(2 * n - 1, n + q - 1)
        self.rows = 3 * self.width + 1
        node = 2 * n * np.arange(K)[:, None, None]
        i, j = np.arange(n)[:, None], np.arange(n)[None, :]
        # Rows of block k: n dynamics (for λ_{k+1}), then n adjoint equations (for d_{k+1}).
        self._at_S = self._flat(node + i, node + j)
        self._at_Q = self._flat(node + n + i, node + n + j)
        self._at_A = self._flat(node[1:] + i, node[1:] - n + j)
        self._at_AT = self._flat(node[1:] - n + i, node[1:] + j)
        k = np.arange(n)
        at_minus_I = np.concatenate(
            [
                self._flat(node[..., 0] + k, node[..., 0] + n + k).ravel(),
                self._flat(node[..., 0] + n + k, node[..., 0] + k).ravel(),
            ]
        )
        last, end = 2 * n * K - n, 2 * n * K
        r = np.arange(q)
        self._at_G = self._flat(end + r[:, None], last + k[None, :])
        self._at_GT = self._flat(last + k[None, :], end + r[:, None])
        self._at_nu = self._flat(end + r, end + r)
        # Transposed: LAPACK reads it column by column. Every load overwrites the same entries.
        self._base = np.zeros((self.size, self.rows))
        self._base.reshape(-1)[at_minus_I] = -1.0
        self._sub: Subproblem | None = None

    def _flat(self, row: Array, column: Array) -> Array:
        return column * self.rows + (2 * self.width + row - column)

    def load(self, sub: Subproblem) -> None:
        """Take a sub-problem: fill in what its pieces do not change (once)."""
        if sub is self._sub:
            return
        self._sub = sub
        flat = self._base.reshape(-1)
        self._R_inverse = np.linalg.inv(sub.R)
        self._gain = sub.B @ self._R_inverse
        flat[self._at_S] = -(self._gain @ sub.B.swapaxes(1, 2))
        self._rows = sub.a.swapaxes(1, 2)
        flat[self._at_A] = sub.A[1:]
        flat[self._at_AT] = sub.A[1:].swapaxes(1, 2)
        flat[self._at_GT] = sub.G

    def solve(
        self,
        weight: Array,
        force: Array,
        held: Array,
        nu_diagonal: Array,
        nu_right: Array,
        control: tuple[Array, Array] | None = None,
        ray: tuple[Array, Array, Array] | None = None,
    ) -> Point | None:
        """The LQ problem's solution, or None if the matrix is singular or overflows.

        Args:
            weight: w of the hinge rows, (K, p): adds ½ w (aᵀd)².
            force: l of the hinge rows, (K, p): adds l aᵀd.
            held: which terminal rows read (G d)_j − δ_j ν_j = s_j, (q,) bool; the others read
                δ_j ν_j = s_j.
            nu_diagonal: −δ for held rows, δ for others, (q,).
            nu_right: s, (q,).
            control: blocks added to R, (K, m, m), and vectors added to r, (K, m).
            ray: t (K, m), a (K,) and s (K,): adds ½ a (tᵀe − s)², however stiff.
        """
        K, n, _ = self.shape
        sub = self._sub
        assert sub is not None, "load a sub-problem first"
        band = self._base.copy()
        flat = band.reshape(-1)
        r, R_inverse, gain = sub.r, self._R_inverse, self._gain
        if control is not None:
            R_inverse = np.linalg.inv(sub.R + control[0])
            r = r + control[1]
        offset: Array = np.zeros(1)
        if ray is not None:
            # By Sherman and Morrison's formula, and the pull towards s apart: summed up first,
            # a stiff ray would drown the rest in rounding errors.
            t, a, s = ray
            y = np.matmul(R_inverse, t[..., None])[..., 0]
            share = a / (1.0 + a * np.sum(t * y, axis=1))
            R_inverse = R_inverse - share[:, None, None] * y[:, :, None] * y[:, None, :]
            offset = (share * s)[:, None] * y
        if control is not None or ray is not None:
            gain = sub.B @ R_inverse
            flat[self._at_S] = -(gain @ sub.B.swapaxes(1, 2))
        flat[self._at_Q] = sub.Q + self._rows @ (weight[..., None] * sub.a)
        linear = sub.q + (self._rows @ force[..., None])[..., 0]
        flat[self._at_G] = np.where(held[:, None], sub.G, 0.0)
        flat[self._at_nu] = nu_diagonal
        right = np.empty((self.size, 1))
        blocks = right[: 2 * n * K, 0].reshape(K, 2, n)
        np.subtract((gain @ r[..., None])[..., 0], sub.f, out=blocks[:, 0])
        if ray is not None:
            blocks[:, 0] -= (sub.B @ offset[..., None])[..., 0]
        np.negative(linear, out=blocks[:, 1])
        right[2 * n * K :, 0] = nu_right
        from scipy.linalg import lapack  # here: compiled plans do without SciPy's import time

        w = self.width
        _, _, solution, info = lapack.dgbsv(
            w, w, band.T, right, overwrite_ab=True, overwrite_b=True
        )
        if info != 0 or not np.isfinite(solution).all():
            return None
        blocks = solution[: 2 * n * K, 0].reshape(K, 2, n)
        adjoint, d = blocks[:, 0], blocks[:, 1]
        force = r + (adjoint[:, None] @ sub.B)[:, 0]
        e = offset - (R_inverse @ force[..., None])[..., 0]
        return Point(d, e, adjoint, solution[2 * n * K :, 0])

"""The LQ problem as one banded linear system, whatever the signs of its Hessians.

With the controls eliminated, e = e⁰ − M (S d + Bᵀλ⁺) with M = H⁻¹ and e⁰ = −M h (or M the inverse
on the directions that are free, and e⁰ the step in the others), the optimality conditions are

    −λ_k + (Q − SᵀMS)_k d_k + (A − BMS)_kᵀ λ_{k+1} = −(q + Sᵀe⁰)_k
    d_{k+1} = (A − BMS)_k d_k − (B M Bᵀ)_k λ_{k+1} + (f + B e⁰)_k
    G d_K − δ ν = s

in the order λ_1, d_1, λ_2, d_2, ..., d_K, ν: banded with 2n − 1 off-diagonals.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided

Array = np.ndarray


class PrimalDual(NamedTuple):
    """A point or a step: d of nodes 1..K (K, n), e (K, m), λ_1..λ_K (K, n) and ν (q,)."""

    d: Array
    e: Array
    adjoint: Array
    terminal: Array

    def towards(self, other: PrimalDual, step: float) -> PrimalDual:
        """The point a fraction `step` of the way to another."""
        return PrimalDual(*(a + step * (b - a) for a, b in zip(self, other, strict=True)))


class BandedLq:
    """LQ problems of K intervals, n states, q terminal conditions: `load`, `factor`, `solve`."""

    def __init__(self, K: int, n: int, q: int) -> None:
        from scipy.linalg import lapack  # here: other plans do without SciPy's import time

        self._lapack = lapack
        self.shape = (K, n, q)
        self._width = max(2 * n - 1, n + q - 1)
        # Transposed: LAPACK reads the band storage column by column.
        self._base = np.zeros((2 * n * K + q, 3 * self._width + 1))
        self._band = np.empty_like(self._base)
        last, end = 2 * n * K - n, 2 * n * K
        # Rows of block k: n dynamics (for λ_{k+1}), then n adjoint equations (for d_{k+1}).
        self._at_A = self._block(self._base, 2 * n, n, (K - 1, n, n))
        self._at_AT = self._block(self._base, n, 2 * n, (K - 1, n, n))
        self._at_BMB = self._block(self._base, 0, 0, (K, n, n))
        self._at_GT = self._block(self._base, last, end, (1, n, q))[0]
        self._at_G = self._block(self._base, end, last, (1, q, n))[0]
        self._at_delta = self._block(self._base, end, end, (1, q, q))[0]
        self._at_Q = self._block(self._band, n, n, (K, n, n))
        self._at_other_BMB = self._block(self._band, 0, 0, (K, n, n))
        for row, column in ((0, n), (n, 0)):
            identity = self._block(self._base, row, column, (K, n, n))
            np.einsum("kii->ki", identity)[...] = -1.0

    def _block(self, band: Array, row: int, column: int, shape: tuple[int, int, int]) -> Array:
        """View of the blocks that begin at (row, column) and every 2n further on the diagonal."""
        rows, item = band.shape[1], band.itemsize
        begin = band.reshape(-1)[column * (rows - 1) + row + 2 * self._width :]
        return as_strided(begin, shape, (2 * self.shape[1] * rows * item, item, (rows - 1) * item))

    def load(self, A: Array, B: Array, M: Array, S: Array | None = None) -> None:
        """Take dynamics A (K, n, n) and B (K, n, m), M (K, m, m) and S (K, m, n)."""
        self._B, self._loaded, self._S = B, B @ M, S
        if S is not None:
            A, self._MS = A - self._loaded @ S, M @ S
        self._at_A[...] = A[1:]
        self._at_AT[...] = A[1:].swapaxes(1, 2)
        np.negative(self._loaded @ B.swapaxes(1, 2), out=self._at_BMB)

    def end(self, G: Array, held: Array, delta: Array) -> None:
        """Take G (q, n): rows read G d − δ ν = s where `held` (q,), else δ ν = s; δ (q,) ≥ 0."""
        self._at_GT[...] = G.T
        np.multiply(G, held[:, None], out=self._at_G)
        np.einsum("ii->i", self._at_delta)[...] = np.where(held, -delta, delta)

    def factor(self, Q: Array, M: Array | None = None) -> bool:
        """Factorise with Q of nodes 1..K (K, n, n); False if singular.

        M (K, m, m), where there is no S, goes in place of the loaded one.
        """
        np.copyto(self._band, self._base)
        self._BM = self._loaded
        if M is not None:
            self._BM = self._B @ M
            np.negative(self._BM @ self._B.swapaxes(1, 2), out=self._at_other_BMB)
        self._at_Q[...] = Q
        if self._S is not None:
            self._at_Q[:-1] -= (self._S.swapaxes(1, 2) @ self._MS)[1:]
        w = self._width
        self._factors, self._pivots, info = self._lapack.dgbtrf(
            self._band.T, w, w, overwrite_ab=True
        )
        return info == 0

    def solve(self, e0: Array, drift: Array, q: Array, s: Array) -> PrimalDual | None:
        """The solution for e⁰ (K, m), f + B e⁰ (K, n), q (K, n), s (q,); None if it overflows."""
        K, n, _ = self.shape
        w, right = self._width, np.empty(len(self._base))
        blocks = right[: 2 * n * K].reshape(K, 2, n)
        blocks[:, 0], blocks[:, 1] = drift, q
        if self._S is not None:
            blocks[:-1, 1] += np.matmul(e0[1:, None], self._S[1:])[:, 0]
        np.negative(right, out=right)
        right[2 * n * K :] = s
        solution, _ = self._lapack.dgbtrs(
            self._factors, w, w, right, self._pivots, overwrite_b=True
        )
        if not np.dot(solution, solution) < np.inf:
            return None
        blocks = solution[: 2 * n * K].reshape(K, 2, n)
        adjoint, d = blocks[:, 0], blocks[:, 1]
        e = e0 - np.matmul(adjoint[:, None], self._BM)[:, 0]
        if self._S is not None:
            e[1:] -= np.matmul(self._MS[1:], d[:-1, :, None])[..., 0]
        return PrimalDual(d, e, adjoint, solution[2 * n * K :])

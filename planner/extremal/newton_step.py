"""A Newton step on the conditions of an extremal: banded linear systems, one per active set.

Linearised but for their kinks, the conditions are those of a sub-problem whose Q, S and R are the
blocks of the Lagrangian's Hessian (:mod:`.second_order`): hinges, bounds and the terminal box are
on one piece or another, and which ones is settled as in :mod:`.backends.structured`. On given
pieces, with the controls held on the boundary of U taken out, e = e⁰ − M (s + H e⁰ + S d + Bᵀ δλ⁺),
where M inverts H on the free directions, what is left of a step (d, e, δλ, δν) is

    d⁺ = Â d − B M Bᵀ δλ⁺ + f̂,     δλ = Q̂ d + Âᵀ δλ⁺ + ρ̂,     G d_K = −g,
    Â = A − B M S,   Q̂ = ∂²L/∂x² + Σ h a aᵀ − Sᵀ M S,   S = ∂²L/∂u∂x

in the order λ_1, d_1, λ_2, ... d_K, ν: banded with 2n − 1 off-diagonals, whatever the signs of
the Hessians.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import numpy as np

from slipcar.planner.extremal.maximum_principle import FirstOrder
from slipcar.planner.extremal.second_order import SecondOrder

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Pieces:
    """Which piece every kink is on.

    Attributes:
        hinge: hinges that push, (K, p) bool.
        lower: controls held at their lower bounds, (K, m) bool.
        upper: controls held at their upper bounds, (K, m) bool.
        ball: controls held on the sphere, (K,) bool.
        terminal: side of the terminal box, (q,): ±1 where it is held; 0 where its multiplier
            is zero.
    """

    hinge: Array
    lower: Array
    upper: Array
    ball: Array
    terminal: Array

    def same(self, other: Pieces) -> bool:
        """Whether all are on the same pieces."""
        return all(
            bool((getattr(self, f.name) == getattr(other, f.name)).all())
            for f in dataclasses.fields(self)
        )


@dataclasses.dataclass(frozen=True)
class Step:
    """A step, or the change it makes.

    Attributes:
        d: of nodes 1..K, (K, n).
        e: of the controls, (K, m).
        adjoint: of λ_1..λ_K, (K, n).
        terminal: of ν, (q,).
    """

    d: Array
    e: Array
    adjoint: Array
    terminal: Array

    @property
    def finite(self) -> bool:
        """Whether every number is."""
        return all(np.isfinite(getattr(self, f.name)).all() for f in dataclasses.fields(self))


class NewtonSystem:
    """The linearised conditions on given pieces, factorised.

    Args:
        at: first derivatives.
        second: Hessian blocks.
        adjoint: λ_1..λ_K, (K, n).
        terminal: ν, (q,).
        pieces: where the kinks are.
        tolerance: half-width of the terminal box.
    """

    def __init__(
        self,
        at: FirstOrder,
        second: SecondOrder,
        adjoint: Array,
        terminal: Array,
        pieces: Pieces,
        tolerance: float,
    ) -> None:
        sub, u = at.sub, at.lin.u
        A, B, G = sub.A, sub.B, sub.G
        K, n, q = self._shape = (*sub.f.shape, len(sub.g))
        # Controls: what is held, and the inverse of H on what is free.
        slope = at.slope(adjoint)
        P, offset, curvature = _held_controls(at, slope, pieces)
        eye = np.eye(u.shape[1])
        H = second.uu + curvature[:, None, None] * eye
        M = P @ np.linalg.inv(P @ H @ P + eye - P) @ P
        pull = slope + np.matmul(H, offset[..., None])[..., 0]
        self._e = offset - np.matmul(M, pull[..., None])[..., 0]
        self._M, self._ux, self._B = M, second.ux, B
        BM, S_T = B @ M, second.ux.swapaxes(1, 2)
        # States: hinges on their pieces, the adjoint equation's residual.
        h = sub.h * pieces.hinge
        Q = second.xx + sub.a.swapaxes(1, 2) @ (h[..., None] * sub.a)
        Q[:-1] -= (S_T @ M @ second.ux)[1:]
        rest = sub.q - adjoint + np.matmul((h * sub.b)[:, None], sub.a)[:, 0]
        rest[:-1] += np.matmul(adjoint[1:, None], A[1:])[:, 0]
        rest[:-1] += np.matmul(S_T, self._e[..., None])[1:, :, 0]
        rest[-1] += terminal @ G
        A_hat = A - BM @ second.ux
        held = pieces.terminal != 0

        layout = _layout(K, n, q)
        band = np.zeros((2 * n * K + q, 3 * layout.width + 1))
        flat = band.reshape(-1)
        flat[layout.identity] = -1.0
        flat[layout.S] = -(BM @ B.swapaxes(1, 2))
        flat[layout.Q] = Q
        flat[layout.A] = A_hat[1:]
        flat[layout.AT] = A_hat[1:].swapaxes(1, 2)
        flat[layout.GT] = G
        flat[layout.G] = np.where(held[:, None], G, 0.0)
        flat[layout.nu] = np.where(held, 0.0, 1.0)
        self._width = layout.width
        from scipy.linalg import lapack  # here: plans that do not shoot need no SciPy

        self._factors, self._pivots, info = lapack.dgbtrf(
            band.T, layout.width, layout.width, overwrite_ab=True
        )
        self.regular = info == 0
        self._right = np.empty(len(band))
        blocks = self._right[: 2 * n * K].reshape(K, 2, n)
        blocks[:, 0] = -(sub.f + np.matmul(B, self._e[..., None])[..., 0])
        blocks[:, 1] = -rest
        self._right[2 * n * K :] = np.where(held, tolerance * pieces.terminal - sub.g, -terminal)

    def solve(self, push: Array | float = 0.0) -> Step:
        """The step.

        Args:
            push: added to the gradient of the Lagrangian at nodes 1..K, (K, n).
        """
        K, n, _ = self._shape
        right = self._right.copy()
        right[: 2 * n * K].reshape(K, 2, n)[:, 1] -= push
        w = self._width
        from scipy.linalg import lapack

        found, _ = lapack.dgbtrs(self._factors, w, w, right, self._pivots, overwrite_b=True)
        blocks = found[: 2 * n * K].reshape(K, 2, n)
        adjoint, d = blocks[:, 0], blocks[:, 1]
        pull = np.matmul(adjoint[:, None], self._B)[:, 0]
        pull[1:] += np.matmul(self._ux[1:], d[:-1, :, None])[..., 0]
        e = self._e - np.matmul(self._M, pull[..., None])[..., 0]
        return Step(d, e, adjoint, found[2 * n * K :])


def _held_controls(at: FirstOrder, slope: Array, pieces: Pieces) -> tuple[Array, Array, Array]:
    """Projectors onto free directions (K, m, m), the others' step (K, m), ball's curvature (K,)."""
    sub, u = at.sub, at.lin.u
    offset = np.where(pieces.lower, sub.lower, np.where(pieces.upper, sub.upper, 0.0))
    box = ~(pieces.lower | pieces.upper)
    free = box[:, :, None] * np.eye(u.shape[1])
    curvature = np.zeros(len(u))
    if pieces.ball.any():
        normal = np.where(box, u, 0.0)
        size = np.einsum("ki,ki->k", normal, normal)
        on = pieces.ball & (size > 1e-12 * sub.radius**2)
        n, size = normal[on], size[on]
        free[on] -= n[:, :, None] * n[:, None, :] / size[:, None, None]
        short = 0.5 * (sub.radius**2 - np.einsum("ki,ki->k", u[on], u[on]))
        short -= np.einsum("ki,ki->k", u[on], offset[on])
        offset[on] += n * (short / size)[:, None]
        # Its multiplier, by which ½ ‖u‖² enters the Lagrangian.
        curvature[on] = np.maximum(-np.einsum("ki,ki->k", slope[on], n) / size, 0.0)
    return free, offset, curvature


@dataclasses.dataclass(frozen=True)
class _Layout:
    """Where the blocks of the matrix lie in LAPACK's band storage, transposed and flattened."""

    width: int
    identity: Array
    S: Array
    Q: Array
    A: Array
    AT: Array
    G: Array
    GT: Array
    nu: Array


@lru_cache(maxsize=8)
def _layout(K: int, n: int, q: int) -> _Layout:
    width = max(2 * n - 1, n + q - 1)
    rows = 3 * width + 1

    def flat(row: Array, column: Array) -> Array:
        return column * rows + (2 * width + row - column)

    node = 2 * n * np.arange(K)[:, None, None]
    i, j, k = np.arange(n)[:, None], np.arange(n)[None, :], np.arange(n)
    first, second = node[..., 0] + k, node[..., 0] + n + k
    last, end, r = 2 * n * K - n, 2 * n * K, np.arange(q)
    return _Layout(
        width=width,
        identity=np.concatenate([flat(first, second).ravel(), flat(second, first).ravel()]),
        S=flat(node + i, node + j),
        Q=flat(node + n + i, node + n + j),
        A=flat(node[1:] + i, node[1:] - n + j),
        AT=flat(node[1:] - n + i, node[1:] + j),
        G=flat(end + r[:, None], last + k[None, :]),
        GT=flat(last + k[None, :], end + r[:, None]),
        nu=flat(end + r, end + r),
    )

"""A Newton step on the conditions of an extremal: banded linear systems, one per active set.

Linearised but for their kinks, the conditions are those of a sub-problem whose Q, S and R are the
blocks of the Lagrangian's Hessian (:mod:`.second_order`): hinges, bounds and the terminal box are
on one piece or another, and which ones is settled as in :mod:`slipcar.planner.convex.solvers`. On
given pieces a step (d, e, δλ, δν) solves an LQ problem (:mod:`slipcar.planner.lq.banded`), with
controls held on the boundary of U taken out: M is the inverse of ∂²L/∂u² on the free directions.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.extremal.maximum_principle import FirstOrder
from slipcar.planner.extremal.second_order import SecondOrder
from slipcar.planner.lq.banded import BandedLq, PrimalDual

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


class NewtonSystem:
    """The linearised conditions on given pieces, factorised.

    Args:
        at: first derivatives.
        hessians: of the Lagrangian.
        adjoint: λ_1..λ_K, (K, n).
        terminal: ν, (q,).
        pieces: where the kinks are.
        tolerance: half-width of the terminal box.
    """

    def __init__(
        self,
        at: FirstOrder,
        hessians: SecondOrder,
        adjoint: Array,
        terminal: Array,
        pieces: Pieces,
        tolerance: float,
    ) -> None:
        sub = at.sub
        # Controls: what is held, and the inverse of H on what is free.
        slope = at.slope(adjoint)
        P, offset, curvature = _held_controls(at, slope, pieces)
        eye = np.eye(slope.shape[1])
        H = hessians.uu + curvature[:, None, None] * eye
        M = P @ np.linalg.inv(P @ H @ P + eye - P) @ P
        pull = slope + np.matmul(H, offset[..., None])[..., 0]
        self._e0 = offset - np.matmul(M, pull[..., None])[..., 0]
        # States: hinges on their pieces, the adjoint equation's residual.
        h = sub.h * pieces.hinge
        Q = hessians.xx + sub.a.swapaxes(1, 2) @ (h[..., None] * sub.a)
        self._q = sub.q - adjoint + np.matmul((h * sub.b)[:, None], sub.a)[:, 0]
        self._q[:-1] += np.matmul(adjoint[1:, None], sub.A[1:])[:, 0]
        self._q[-1] += terminal @ sub.G
        held = pieces.terminal != 0
        self._drift = sub.f + np.matmul(sub.B, self._e0[..., None])[..., 0]
        self._side = np.where(held, tolerance * pieces.terminal - sub.g, -terminal)
        K, n = sub.f.shape
        self._lq = BandedLq(K, n, len(sub.g))
        self._lq.load(sub.A, sub.B, M, hessians.ux)
        self._lq.end(sub.G, held, np.where(held, 0.0, 1.0))
        self.regular = self._lq.factor(Q)

    def solve(self, push: Array | float = 0.0) -> PrimalDual | None:
        """The step; None if it overflows.

        Args:
            push: added to the gradient of the Lagrangian at nodes 1..K, (K, n).
        """
        return self._lq.solve(self._e0, self._drift, self._q + push, self._side)


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

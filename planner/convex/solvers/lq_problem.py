"""What is left of a sub-problem once every piece is chosen: an LQ problem, one banded solve.

The smooth part is the sub-problem's own. Hinges that are on, bounds and balls that hold a control
and the terminal condition each add a quadratic to it (:class:`Terms`), and nothing else.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.convex.subproblem import Subproblem
from slipcar.planner.lq.banded import BandedLq, PrimalDual

Array = np.ndarray


@dataclasses.dataclass(frozen=True, slots=True)
class Ray:
    """Adds ½ a (tᵀe − s)², however stiff: t (K, m), a (K,) and s (K,)."""

    t: Array
    a: Array
    s: Array


@dataclasses.dataclass(frozen=True, slots=True)
class End:
    """Terminal rows: (G d)_j − δ_j ν_j = s_j where `held`, δ_j ν_j = s_j elsewhere; all (q,)."""

    held: Array
    delta: Array
    side: Array


@dataclasses.dataclass(frozen=True, slots=True)
class Terms:
    """What the active pieces add to the smooth part.

    Attributes:
        weight: w of the hinge rows, (K, p): adds ½ w (aᵀd)².
        force: l of the hinge rows, (K, p): adds l aᵀd.
        end: the terminal rows.
        block: added to R, (K, m, m), or None.
        push: added to r, (K, m), or None.
        ray: the spheres' stiff quadratics, or None.
    """

    weight: Array
    force: Array
    end: End
    block: Array | None = None
    push: Array | None = None
    ray: Ray | None = None


class LqProblem:
    """LQ problems of one sub-problem; what its pieces do not change is computed once.

    Args:
        K: intervals.
        n: states.
        q: terminal conditions.
    """

    def __init__(self, K: int, n: int, q: int) -> None:
        self._lq = BandedLq(K, n, q)
        self.shape = self._lq.shape
        self._R: Array | None = None

    def load(self, sub: Subproblem) -> None:
        """Take a sub-problem."""
        self._sub, self._rows = sub, sub.a.swapaxes(1, 2)
        if self._R is None or not np.array_equal(sub.R, self._R):
            self._R, self._inverse = sub.R, np.linalg.inv(sub.R)
        self._e0 = -np.matmul(self._inverse, sub.r[..., None])[..., 0]
        self._drift = sub.f + np.matmul(sub.B, self._e0[..., None])[..., 0]
        self._lq.load(sub.A, sub.B, self._inverse)
        self._end: End | None = None

    def solve(self, terms: Terms) -> PrimalDual | None:
        """The solution with these terms; None if the matrix is singular or overflows."""
        sub, end = self._sub, terms.end
        M, e0, drift = None, self._e0, self._drift
        if end is not self._end:
            self._lq.end(sub.G, end.held, end.delta)
            self._end = end
        if terms.block is not None or terms.ray is not None:
            M, e0 = self._controls(terms)
            drift = sub.f + np.matmul(sub.B, e0[..., None])[..., 0]
        if not self._lq.factor(sub.Q + self._rows @ (terms.weight[..., None] * sub.a), M):
            return None
        q = sub.q + np.matmul(terms.force[:, None], sub.a)[:, 0]
        return self._lq.solve(e0, drift, q, end.side)

    def _controls(self, terms: Terms) -> tuple[Array, Array]:
        """The inverse of what R becomes, (K, m, m), and e⁰, (K, m)."""
        M, r = self._inverse, self._sub.r
        if terms.block is not None:
            M = np.linalg.inv(self._sub.R + terms.block)
        if terms.push is not None:
            r = r + terms.push
        if terms.ray is None:
            return M, -np.matmul(M, r[..., None])[..., 0]
        # By Sherman and Morrison's formula, and the pull towards s apart: summed up first,
        # a stiff ray would drown the rest in rounding errors.
        t, a, s = terms.ray.t, terms.ray.a, terms.ray.s
        y = np.matmul(M, t[..., None])[..., 0]
        share = a / (1.0 + a * np.sum(t * y, axis=1))
        M = M - share[:, None, None] * y[:, :, None] * y[:, None, :]
        return M, (share * s)[:, None] * y - np.matmul(M, r[..., None])[..., 0]

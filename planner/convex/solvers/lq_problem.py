"""What is left of a sub-problem once every piece is chosen: an LQ problem, one banded solve."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slipcar.planner.convex.subproblem import Subproblem
from slipcar.planner.lq.banded import BandedLq, PrimalDual

Array = np.ndarray


class End(NamedTuple):
    """Terminal rows: (G d)_j − δ_j ν_j = s_j where `held`, δ_j ν_j = s_j elsewhere; all (q,)."""

    held: Array
    delta: Array
    side: Array


class LqProblem:
    """LQ problems of one sub-problem; what its pieces do not change is computed once."""

    def __init__(self, K: int, n: int, q: int) -> None:
        self._lq = BandedLq(K, n, q)
        self.shape = self._lq.shape
        self._R: Array | None = None

    def load(self, sub: Subproblem) -> None:
        """Take a sub-problem."""
        self.sub, self._rows = sub, sub.a.swapaxes(1, 2)
        if self._R is None or not np.array_equal(sub.R, self._R):
            self._R, self._inverse = sub.R, np.linalg.inv(sub.R)
        self._e0 = -np.matmul(self._inverse, sub.r[..., None])[..., 0]
        self._drift = sub.f + np.matmul(sub.B, self._e0[..., None])[..., 0]
        self._lq.load(sub.A, sub.B, self._inverse)
        self._end: End | None = None

    def solve(
        self, weight: Array, force: Array, end: End, controls: tuple[Array, Array] | None = None
    ) -> PrimalDual | None:
        """The solution with ½ w (aᵀd)² + l aᵀd for the hinges; None if singular or too large.

        w and l are (K, p); `controls` M (K, m, m) and e⁰ (K, m), by default those without limits.
        """
        sub, M, e0, drift = self.sub, None, self._e0, self._drift
        if end is not self._end:
            self._lq.end(sub.G, end.held, end.delta)
            self._end = end
        if controls is not None:
            M, e0 = controls
            drift = sub.f + np.matmul(sub.B, e0[..., None])[..., 0]
        if not self._lq.factor(sub.Q + self._rows @ (weight[..., None] * sub.a), M):
            return None
        q = sub.q + np.matmul(force[:, None], sub.a)[:, 0]
        return self._lq.solve(e0, drift, q, end.side)

"""Beyond plain steps, once the iteration has settled down to a slow linear rate.

The convex model knows no curvature of the dynamics, so that z_{k+1} = F(z_k) contracts (or, near
a saddle, leaves) at a fixed rate per direction, at times as slow as ± 0.97.

* Where the merit function falls by more than the model says, ratio > 1, the model's curvature is
  too large along the step. By the parabola through both, the minimum lies at t = 1/(2 − ratio)
  times the step: go there (a long way, where the ratio is 2: no curvature is left).
* Otherwise combine the last iterates by Anderson's method: with residuals r_i = F(z_i) − z_i

      z = Σ α_i (z_i + r_i),   Σ α_i = 1,   ‖Σ α_i r_i‖ least

  (D. G. Anderson, 1965: GMRES on the linearised iteration), in the norm of the stopping test,
  ∫ ‖e‖² dt; states with the same weights, to obey the linearised dynamics as all of them do.

The caller takes a proposal where it lowers the merit function below the step's.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray

#: Iterates combined, at most; the reduction of ∫ ‖e‖² by a step that is fast enough, and how many
#: slow ones are let pass; the ratio from which steps are lengthened, and how much at most.
_DEPTH, _FAST, _PATIENCE, _LONGER, _LONGEST = 6, 0.1, 2, 1.5, 10.0


class Acceleration:
    """Remembers the last few steps, dt (K,) [s], and proposes where to go instead of the next."""

    def __init__(self, dt: Array) -> None:
        self._weight = np.sqrt(dt)[:, None]
        self.forget()

    def forget(self) -> None:
        """Start anew: the iteration is not what it was (another trust region, other bounds)."""
        self._steps: list[tuple[Array, Array, Array]] = []  # residual, states, controls
        self._last, self._slow = 0.0, 0

    def observe(self, u: Array, new_x: Array, e: Array) -> bool:
        """Note a step e (K, m) from u (K, m) to states new_x (N, n): have steps become slow?"""
        residual = (self._weight * e).ravel()
        size = float(residual @ residual)
        self._slow = self._slow + 1 if size > _FAST * self._last > 0.0 else 0
        self._last = size
        self._steps.append((residual, new_x, u + e))
        del self._steps[:-_DEPTH]
        return self._slow >= _PATIENCE

    def propose(self, x: Array, u: Array, ratio: float) -> list[tuple[Array, Array]]:
        """States (N, n) and controls (K, m) to try in turn instead of the step observed last.

        It was made from x, u; `ratio` is the decrease of the merit function over the model's.
        """
        residual, new_x, new_u = self._steps[-1]
        if ratio > _LONGER:
            self._steps.clear()
            t = min(1.0 / max(2.0 - ratio, 1e-3), _LONGEST)
            return [(x + s * (new_x - x), u + s * (new_u - u)) for s in (t, t / 3.0) if s > 1.0]
        if len(self._steps) < 2:
            return []
        residuals, states, controls = (np.array(parts) for parts in zip(*self._steps, strict=True))
        gamma = np.linalg.lstsq(np.diff(residuals, axis=0).T, residual, rcond=1e-8)[0]
        alpha = np.diff(gamma, prepend=0.0, append=1.0)
        return [(np.einsum("i,ikn->kn", alpha, states), np.einsum("i,ikm->km", alpha, controls))]

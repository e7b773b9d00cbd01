"""What a controller means to do, to be drawn under the car: planned path and uncertainty.

For a Gaussian the region {r : (r − μ)ᵀ Σ⁻¹ (r − μ) ≤ −2 ln(1 − p)} holds probability p in the
plane; its rim is μ + κ Σ^½ (cos φ, sin φ) with κ² = −2 ln(1 − p).
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from slipcar.envs.validate import checked_array

#: Probability that a drawn ellipse holds, and the number of standard deviations that makes.
MASS = 0.95
RADIUS = math.sqrt(-2.0 * math.log1p(-MASS))
_CORNERS = 32


@dataclasses.dataclass(frozen=True, eq=False)
class Overlay:
    """A planned path and, where known, how far the car may be off it; never written to.

    Attributes:
        states: planned states at the nodes ahead, (k, n) with n ≥ 2 whose first two are the
            position [m]; a path (k, 2) will do. k ≥ 1.
        covariances: of the position at those nodes, (k, 2, 2) [m²]; None draws the path alone.

    Raises:
        ValueError: for a wrong shape, an entry that is not finite, or a covariance that is not
            symmetric positive semidefinite; the message names the node.
    """

    states: np.ndarray
    covariances: np.ndarray | None = None

    def __post_init__(self) -> None:
        states = checked_array("states", self.states, (None, None))
        if len(states) < 1 or states.shape[1] < 2:
            raise ValueError(f"states must have shape (k >= 1, n >= 2), not {states.shape}")
        object.__setattr__(self, "states", states)
        if self.covariances is not None:
            S = checked_array("covariances", self.covariances, (len(states), 2, 2))
            _check_semidefinite(S)
            object.__setattr__(self, "covariances", S)

    @property
    def positions(self) -> np.ndarray:
        """Planned positions, (k, 2) [m]."""
        return self.states[:, :2]

    def ellipses(self, nodes: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Rims of the regions that hold :data:`MASS`, counter-clockwise.

        Args:
            nodes: which nodes, indices (j,) or a slice.

        Returns:
            Corners (j, 32, 2) [m].

        Raises:
            ValueError: without covariances.
        """
        if self.covariances is None:
            raise ValueError("an overlay without covariances has no ellipses")
        S = self.covariances[nodes]
        around = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
        circle = np.stack([np.cos(around), np.sin(around)])
        # Cholesky's factor of a 2×2 matrix by hand, which a singular one has as well.
        a = np.sqrt(np.maximum(S[:, 0, 0], 0.0))
        b = np.divide(S[:, 1, 0], a, out=np.zeros_like(a), where=a > 0.0)
        c = np.sqrt(np.maximum(S[:, 1, 1] - b**2, 0.0))
        x = a[:, None] * circle[0]
        y = b[:, None] * circle[0] + c[:, None] * circle[1]
        return self.positions[nodes][:, None] + RADIUS * np.stack([x, y], axis=-1)


def _check_semidefinite(S: np.ndarray) -> None:
    scale = np.maximum(np.abs(S).max(axis=(1, 2)), 1e-300)
    skew = np.abs(S[:, 0, 1] - S[:, 1, 0])
    middle, half = 0.5 * (S[:, 0, 0] + S[:, 1, 1]), 0.5 * (S[:, 0, 0] - S[:, 1, 1])
    smallest = middle - np.hypot(half, 0.5 * (S[:, 0, 1] + S[:, 1, 0]))
    bad = (skew > 1e-9 * scale) | (smallest < -1e-9 * scale)
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        raise ValueError(
            f"covariances[{k}] must be symmetric and positive semidefinite, not {S[k].tolist()}"
        )

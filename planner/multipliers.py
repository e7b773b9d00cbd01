"""Multipliers of the last sub-problem in the paper's terms (𝔭, p⁰, p¹) and p(t)."""

from __future__ import annotations

import dataclasses

import numpy as np

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Multipliers:
    """Pontryagin multipliers (Theorems 3.1 and 3.2): H = pᵀb + p⁰f⁰ is maximised by u.

    The sub-problem's own multipliers are gradients of a cost that is minimised; the paper's
    have the opposite sign. `terminal`, `cost` and `trust_region` are as solved (p⁰ = −1);
    `normalized()` scales them to ‖(𝔭, p⁰, p¹)‖ = 1.

    Attributes:
        terminal: 𝔭, (q,).
        cost: p⁰ ≤ 0.
        trust_region: p¹ ≤ 0.
        adjoint: p at every node, (N, n).
    """

    terminal: Array
    cost: float
    trust_region: float
    adjoint: Array

    @classmethod
    def of(cls, adjoint: Array, terminal: Array, trust_multiplier: float, A: Array) -> Multipliers:
        """From λ_1..λ_K (K, n), ν (q,) and the trust region's weight of a sub-problem."""
        # λ_0 follows from the adjoint equation at node 0, where no cost is charged.
        first = A[0].T @ adjoint[0]
        return cls(-terminal, -1.0, -trust_multiplier, -np.vstack([first, adjoint]))

    def normalized(self) -> Multipliers:
        """Scaled so that (𝔭, p⁰, p¹) has norm one."""
        scale = float(np.sqrt(np.sum(self.terminal**2) + self.cost**2 + self.trust_region**2))
        return Multipliers(
            self.terminal / scale,
            self.cost / scale,
            self.trust_region / scale,
            self.adjoint / scale,
        )

    def as_dict(self) -> dict[str, Array]:
        """Arrays by name, for a file."""
        return {f.name: np.asarray(getattr(self, f.name)) for f in dataclasses.fields(self)}

    @classmethod
    def from_dict(cls, data: dict[str, Array]) -> Multipliers:
        """What :meth:`as_dict` gave."""
        return cls(
            data["terminal"], float(data["cost"]), float(data["trust_region"]), data["adjoint"]
        )

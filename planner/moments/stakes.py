"""What an expected cost charges, beyond effort and running costs."""

from __future__ import annotations

import dataclasses

import numpy as np

Array = np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Stakes:
    """What is charged for rows, ends and spread.

        Σ dt (uᵀRu + tr K ΣKᵀR + H + w tr Σ) + Σ rows + E gᵀWg

    Attributes:
        penalties: weights of E max(0, c)² per second, (p,).
        constraints: how many constraints there are.
        price: ν, what P(constraint > 0) costs at each node; 0 leaves them out.
        terminal: W, (q,); zeros charge nothing.
        soft: charge E gᵀWg for the mean as well, instead of asking that it satisfy g = 0.
        feedback: whether u = ū + K (x − μ), with the gains that make the whole cheapest.
        variance_weight: w.
        saturation: control bounds are kept at so many standard deviations of the correction.
        bridged: whether constraints are to hold between nodes too.
        renewal: how much of a change of the rows' weights an iteration takes over, in (0, 1].
    """

    penalties: Array
    constraints: int
    price: float
    terminal: Array
    soft: bool
    feedback: bool
    variance_weight: float
    saturation: float = 1.0
    bridged: bool = False
    renewal: float = 0.5

    @property
    def priced(self) -> bool:
        """Whether constraints are rows."""
        return self.price > 0.0 and self.constraints > 0

    @property
    def tails(self) -> int:
        """Rows that are constraints, the last ones."""
        return self.constraints if self.priced else 0

    @property
    def weight(self) -> Array:
        """Of every row, (p + tails,)."""
        return np.concatenate([self.penalties, np.full(self.tails, self.price)])

    def at_price(self, price: float) -> Stakes:
        """With constraints at this price."""
        return dataclasses.replace(self, price=price)

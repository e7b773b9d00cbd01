"""What an expected cost charges, beyond effort and running costs."""

from __future__ import annotations

import dataclasses

import numpy as np

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Stakes:
    """What is charged for rows, ends and spread.

        Σ dt (uᵀRu + tr K ΣKᵀR + H + w tr Σ) + Σ rows + E gᵀWg

    Attributes:
        weight: of each row, (p,): that of E max(0, c)² per second for penalties, the price ν of
            P(c > 0) at each node for constraints.
        tail: which rows are priced by their tail, (p,).
        terminal: W, (q,); zeros charge nothing.
        soft: charge E gᵀWg for the mean as well, instead of asking that it satisfy g = 0.
        feedback: whether u = ū + K (x − μ), with the gains that make the whole cheapest.
        variance_weight: w.
        saturation: control bounds are kept at so many standard deviations of the correction.
        damping: how much of a change of the rows' weights an iteration takes over, in (0, 1].
    """

    weight: Array
    tail: Array
    terminal: Array
    soft: bool
    feedback: bool
    variance_weight: float
    saturation: float = 1.0
    damping: float = 0.5

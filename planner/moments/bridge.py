"""Constraints between two looks at a path: the Brownian bridge's chance to touch.

Between two Euler–Maruyama steps the continuous path is a Brownian bridge. The distance to a border
that it keeps, a > 0 at one end and b > 0 at the other, is to first order a bridge of variance V,
h times the square of its diffusion; by the reflection principle it reaches zero with probability

    q = exp(−2 a b / V)

which is exact for half planes under constant noise, whatever the (constant) drift: a bridge does
not depend on it. A path that is looked at n times keeps its constraints with probability
Π (1 − q) over steps and rows, given its steps; the mean over paths is the rate, and no random
number is drawn for it. (Glasserman: *Monte Carlo Methods in Financial Engineering*, §6.4; Gobet
2000.) A walk that is looked at only after every step misses so much of it as if the border were
:data:`OVERSHOOT` standard deviations of a step farther away (Broadie, Glasserman, Kou 1997).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.planner.trace.elementwise import choose, larger

#: −ζ(1/2) / √(2π): how far a discrete walk overshoots, in standard deviations of its steps.
OVERSHOOT = 0.5826
#: Variances below it are none: the exponent is −∞.
_NONE = 1e-300


def crossing(a: Any, b: Any, variance: Any) -> Any:
    """Probability q that a bridge from a to b touches zero; 1 where an end is not above it.

    Args:
        a: distance at the beginning; numbers or expressions, of one shape each.
        b: at the end.
        variance: V ≥ 0 of the step between them.
    """
    return np.exp(exponent(a, b, variance))


def exponent(a: Any, b: Any, variance: Any) -> Any:
    """−2 a b / V of :func:`crossing`; 0 where an end is not above the border."""
    nothing = 0.0 * a
    away = choose(a, choose(b, a * b, nothing), nothing)
    return -2.0 * away / larger(variance, _NONE + nothing)

"""Begin with a lighter goal: a curriculum for worlds that vary.

    W_i = W s^(1 − 2 i/n)  over the first half of n iterations, then W

At the full weight W, arriving is all that is learnt at first: an obstacle costs a hundredth of what
the goal does. A policy that has learnt to go straight corrects every swerve: it hardly ever finds
out what swerving is good for. With a share s of a few hundredths both are learnt together.
"""

from __future__ import annotations

from slipcar.envs import Family
from slipcar.envs.sources import Source, base_of


def eased(source: Source, share: float, iteration: int, iterations: int) -> Source:
    """What an iteration is to train on.

    Args:
        source: what is to be learnt in the end.
        share: s, of the goal weight at first; 1 is the source itself throughout.
        iteration: which one, from 0.
        iterations: n, how many in all.
    """
    left = 1.0 - 2.0 * iteration / iterations
    if share == 1.0 or left <= 0.0:
        return source
    base = base_of(source)
    lighter = base.replace(goal_weight=base.goal_weight * share**left)
    return source.replace(base=lighter) if isinstance(source, Family) else lighter

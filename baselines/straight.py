"""The driver that ignores obstacles: the bottom row of every comparison.

    min E ∫ ‖u‖² dt    s.t.  dx = b dt + σ dB,  x(0) = x⁰,  E[x(T)] = x^f

played open loop on the real scenario: least effort, straight over whatever is in the way.
"""

from __future__ import annotations

from slipcar.envs import Scenario
from slipcar.planner import OpenLoop, plan


def straight(scenario: Scenario | str = "paper") -> OpenLoop:
    """The least-effort plan for `scenario` without its obstacles, open loop.

    The plan belongs to a scenario of the same start, goal, horizon and control bounds, so its
    observations and actions are those of the real one.

    Args:
        scenario: a scenario or a name.

    Raises:
        ValueError: for an unknown name.
    """
    return OpenLoop(plan(Scenario.of(scenario).replace(obstacles=()), variance_weight=0.0))

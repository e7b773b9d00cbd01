"""Deterministic SCP: the planner with its eyes closed to noise.

    min ∫ ‖u‖² + λ Σ_o max(0, c_o(r))² dt    s.t.  ẋ = b(x, u),  x(0) = x⁰,  x(T) = x^f

the stochastic problem with variance weight zero (docs/method.md): what one would plan for a car
that does not slip. The covariance of the plan is still predicted, so that it can be judged.
"""

from __future__ import annotations

from typing import Any

from slipcar.envs import Scenario
from slipcar.planner import Plan, plan


def deterministic_scp(scenario: Scenario | str = "paper", **options: Any) -> Plan:
    """`plan(scenario, variance_weight=0, **options)` under its own name.

    Args:
        scenario: a scenario or a name.
        **options: of :func:`slipcar.planner.plan`, but for `variance_weight`.

    Raises:
        ValueError: if `variance_weight` is among the options, or for a bad option.
    """
    if "variance_weight" in options:
        raise ValueError(
            f"deterministic_scp has variance_weight 0 by definition, not "
            f"{options['variance_weight']!r}; use slipcar.planner.plan for another"
        )
    return plan(Scenario.of(scenario), variance_weight=0.0, **options)

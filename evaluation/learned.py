"""Rows of learned methods: what is shipped, every training of it."""

from __future__ import annotations

from slipcar import baselines
from slipcar.evaluation.runs import Runs

#: Method -> what its row is called.
NAMES = {
    "ppo": "PPO",
    "warm-started": "PPO after SCP data",
    "cloned": "clone of SCP",
    "pathwise": "pathwise gradients",
    "sac": "SAC",
    "tqc": "TQC",
}


def learned_rows(world: str, methods: tuple[str, ...] | None = None) -> dict[str, Runs]:
    """Name -> all shipped trainings of each method for a world; PPO first.

    Args:
        world: "paper" or "random", as in :func:`slipcar.baselines.shipped_methods`.
        methods: which; None takes all that are shipped.
    """
    order = {method: i for i, method in enumerate(NAMES)}
    shipped = sorted(
        baselines.shipped_methods(world), key=lambda method: order.get(method, len(order))
    )
    return {
        NAMES.get(method, method): Runs.of(baselines.shipped_runs(method, world))
        for method in shipped
        if methods is None or method in methods
    }

"""Rows of learned methods: what is shipped, every training of it."""

from __future__ import annotations

from collections.abc import Mapping

from slipcar import baselines
from slipcar.evaluation.runs import Runs

#: Method -> what its row is called.
NAMES = {
    "ppo": "PPO",
    "warm-started": "PPO after SCP data",
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


def trainings(rows: Mapping[str, object]) -> list[str]:
    """What a reader must be told of rows with several trainings."""
    return [
        f"{name}: mean over {len(runs.controllers)} trainings ({', '.join(runs.labels)}); its "
        "errors and intervals are of the method, trainings and paths together."
        for name, runs in rows.items()
        if isinstance(runs, Runs) and len(runs.controllers) > 1
    ]

"""What the animations of a report show: the world, iterates of a plan, paths of every row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.comparison_record import ComparisonRecord
from slipcar.evaluation.rollout import sample_paths
from slipcar.evaluation.runs import Runs

#: Brownian paths of the animation: the first of the evaluation's.
PATHS = 12
#: Decimals of positions [m] and angles [rad]: a tenth of a millimetre.
_DECIMALS = 4
#: Up to so many rows are all shown at first.
_AT_ONCE = 4


def scene(
    comparison: ComparisonRecord, names: Sequence[str] | None = None, paths: int = PATHS
) -> dict[str, Any]:
    """Plain data for the animations of a report.

    Args:
        comparison: whose rows drive; with one step between nodes, whatever its substeps.
        names: of the rows that drive; None takes all that finished.
        paths: how many of the evaluation's Brownian paths, its first.

    Returns:
        `obstacles` [x, y, radius], `clearance`, `start` and `goal` [x, y, θ], `times`;
        `iterates`: positions [x, y] of the guess and of every accepted iterate of the reference
        row's plan, and what each costs; `rows`: of each its name, whether its loop is closed,
        whether it is `shown` at first, `paths` [path][node] of [x, y, θ], and `hits` [path]: the
        first node within an obstacle, or null. SI units.
    """
    scenario, results = comparison.scenario, comparison.results
    names = [name for name in (results if names is None else names) if name in results]
    closed = [name for name in names if results[name].closed_loop]
    # All at once hide each other: at first the reference and two that steer.
    shown = {comparison.reference, *closed[:2]} if len(names) > _AT_ONCE else set(names)
    return {
        "obstacles": _rounded(scenario.obstacles),
        "clearance": scenario.clearance,
        "start": _rounded(scenario.start[:3]),
        "goal": _rounded(scenario.goal[:3]),
        "times": _rounded(scenario.times),
        "seed": comparison.seed,
        "substeps": comparison.substeps,
        "iterates": iterates(comparison),
        "rows": [
            _row(name, comparison.controllers[name], scenario, paths, comparison.seed)
            | {"closed": name in closed, "shown": name in shown}
            for name in names
        ],
    }


def iterates(comparison: ComparisonRecord) -> dict[str, Any] | None:
    """The iterates that led to the illustrated plan; None if no row has a plan with a history."""
    name, plan = illustrated(comparison)
    if plan is None:
        return None
    steps = [
        {"path": _rounded(step.mean[:, :2]), "effort": step.effort, "penalty": step.penalty}
        for step in getattr(plan, "history", ())
        if step.accepted
    ]
    if not steps:
        return None
    guess = getattr(plan, "guess", None)
    if guess is not None:
        steps.insert(0, {"path": _rounded(guess[:, :2])})
    if getattr(plan, "expected", None) is not None:
        steps.append({"path": _rounded(plan.mean[:, :2])})
    return {"name": name, "guess": guess is not None, "steps": steps}


def illustrated(comparison: ComparisonRecord) -> tuple[str, Any | None]:
    """The row whose plan is shown, and the plan: the reference's, else the first that has one."""
    for name in (comparison.reference, *comparison.controllers):
        plan = getattr(comparison.controllers[name], "plan", None)
        if plan is not None:
            return name, plan
    return comparison.reference, None


def _row(name: str, controller: Any, scenario: Scenario, paths: int, seed: int) -> dict[str, Any]:
    if isinstance(controller, Runs):  # of several trainings the first drives
        name, controller = f"{name}, {controller.labels[0]}", controller.controllers[0]
    states, _ = sample_paths(controller, scenario, paths, seed)
    inside = scenario.signed_distance(states[:, 1:]) < 0.0
    hits = [int(row.argmax()) + 1 if row.any() else None for row in inside]
    return {"name": name, "paths": _rounded(states[..., :3]), "hits": hits}


def _rounded(values: np.ndarray) -> list[Any]:
    return np.round(np.asarray(values, dtype=float), _DECIMALS).tolist()

"""How fast each method reaches an extremal: residual of the maximum principle at every iterate.

The residual is the certificate's, of the non-linear problem (paper, Theorem 3.3), so it means the
same for every method: the paper's scheme, the same with shooting at its end, Newton's method
(docs/planner.md).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.planner import plan
from slipcar.planner.extremal.certificate import violations
from slipcar.planner.extremal.maximum_principle import model_for
from slipcar.planner.extremal.shooting import START_WITHIN, retry_within, shoot_from

Array = np.ndarray

#: ∫ ‖Δu‖² dt that no step gets below: iterations go on until rounding errors end them.
_FOREVER = 1e-24
_ITERATIONS = 60


@dataclasses.dataclass(frozen=True)
class Curve:
    """One method on one problem.

    Attributes:
        residuals: largest relative residual at every accepted iterate, (k,).
        iterations: at which iteration each was reached, (k,); shooting's are counted on.
        seconds: after how long, (k,).
    """

    residuals: Array
    iterations: Array
    seconds: Array


def residual_curves(
    problem: Any, *, repeats: int = 3, interpreted: bool = False
) -> dict[str, Curve]:
    """The methods, side by side, each from the problem's own guess.

    Args:
        problem: anything that `plan` takes.
        repeats: times that each is run; of each iteration the fastest counts, because one hiccup
            of the machine is not the method's.
        interpreted: also Newton's method without compiled code.

    Returns:
        Curves by name: `"convex"`, `"shooting"` (missing if no shot converges), `"newton"`, and
        `"newton, NumPy"` if asked for.
    """
    if repeats < 1:
        raise ValueError(f"repeats must be >= 1, not {repeats}")
    found: dict[str, Curve] = {}
    convex, found["convex"] = _run(problem, repeats, method="convex")
    if (first := first_shot(convex)) is not None:
        found["shooting"] = _shot_curve(convex, found["convex"], first, repeats)
    _, found["newton"] = _run(problem, repeats, method="newton")
    if interpreted:
        _, found["newton, NumPy"] = _run(problem, repeats, method="newton", compiled=False)
    return found


def residuals_of(plan: Any) -> tuple[Array, Array]:
    """Largest relative residual of the maximum principle at every accepted iterate.

    Returns:
        Residuals and the seconds they were reached after, (accepted iterations,) each.
    """
    model = model_for(plan)
    seconds = np.cumsum([h.seconds for h in plan.history])
    found = [
        (
            violations(
                model,
                h.mean,
                h.controls,
                h.terminal_multiplier,
                variance_weight=plan.options["variance_weight"],
                terminal_tolerance=plan.options["terminal_tolerance"],
            ).largest,
            s,
        )
        for h, s in zip(plan.history, seconds, strict=True)
        if h.accepted
    ]
    values = np.array(found).reshape(-1, 2)
    return values[:, 0], values[:, 1]


def first_shot(
    plan: Any, start_within: float = START_WITHIN, attempts: int = 4
) -> tuple[int, Any, float] | None:
    """The first shot that converges: tried from an iterate whose residual is small enough, and
    again each time it has halved.

    Args:
        plan: whose history to start from.
        start_within: residual at which the first is tried.
        attempts: at most so many.

    Returns:
        Index into the history, the shot, and the seconds lost before: in shots that failed and
        in finding iterates too far away. None if none converges.
    """
    limit, lost = start_within, 0.0
    for k, h in enumerate(plan.history):
        if not h.accepted or attempts == 0:
            continue
        # The fastest of three: one hiccup of the machine is not the method's.
        shots = [shoot_from(plan, k, start_within=limit) for _ in range(3)]
        shot = min(shots, key=lambda s: s.seconds)
        if shot.converged:
            return k, shot, lost
        lost += shot.seconds
        limit = retry_within(shot, limit)
        attempts -= shot.attempted
    return None


def _run(problem: Any, repeats: int, **options: Any) -> tuple[Any, Curve]:
    """A plan and its curve; plans of the same problem are the same, their times are not."""
    plans = [
        plan(problem, tolerance=_FOREVER, max_iterations=_ITERATIONS, **options)
        for _ in range(repeats)
    ]
    residuals, _ = residuals_of(plans[0])
    taken = np.array([k for k, h in enumerate(plans[0].history) if h.accepted], dtype=int)
    lasted = np.min([[h.seconds for h in found.history] for found in plans], axis=0)
    return plans[0], Curve(residuals, taken + 1, np.cumsum(lasted)[taken])


def _shot_curve(found: Any, alone: Curve, first: tuple[int, Any, float], repeats: int) -> Curve:
    """From the iterate that the shot started at."""
    k, shot, lost = first
    began = int(np.searchsorted(alone.iterations, k + 1))
    shots = [shot, *(shoot_from(found, k) for _ in range(repeats - 1))]
    reached = np.array([[h.seconds for h in again.history] for again in shots])
    lasted = np.min(np.diff(reached, axis=1, prepend=0.0), axis=0)
    return Curve(
        residuals=shot.residuals,
        iterations=alone.iterations[began] + np.arange(len(shot.residuals)),
        seconds=alone.seconds[began] + lost + np.cumsum(lasted),
    )

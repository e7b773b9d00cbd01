"""Where an iteration starts: the problem's own guess, given trajectories, an earlier plan.

A plan of another time grid is resampled, linearly in the states, piecewise constantly in the
controls: at the same times where the new grid lies within the old one (replanning on the way),
stretched to the new horizon otherwise.

A guess that leads nowhere, or to something dearer, must not make a plan worse than the problem's
own guess would: unless it can be trusted, both are tried (:func:`run_guarded`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.feasibility import inconsistency, lacks
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import Model, checked_trajectory
from slipcar.planner.status import Status

Array = np.ndarray


def given_guess(model: Model, guess: Any) -> tuple[Array, Array]:
    """States (N, n) and controls (N−1, m): the problem's own, from a plan, or a pair of arrays.

    Raises:
        ValueError: for anything else, a wrong shape, a non-finite entry, or a plan of other
            dimensions.
    """
    if guess is None:
        return model.guess()
    if hasattr(guess, "mean") and hasattr(guess, "controls") and hasattr(guess, "times"):
        return checked_trajectory(model, *_resampled(model, guess))
    if not isinstance(guess, (tuple, list)) or len(guess) != 2:
        raise ValueError(f"guess must be a Plan or a pair (states, controls), not {guess!r}")
    return checked_trajectory(model, *guess)


def _resampled(model: Model, plan: Any) -> tuple[Array, Array]:
    old, new = plan.times, model.times
    n, m = plan.mean.shape[1], plan.controls.shape[1]
    if (n, m) != (model.state_dim, model.control_dim):
        raise ValueError(
            f"guess: a plan with {n} states and {m} controls does not fit a problem with "
            f"{model.state_dim} and {model.control_dim}"
        )
    if np.array_equal(old, new):
        return plan.mean, plan.controls
    slack = 1e-9 * (old[-1] - old[0])
    if new[0] < old[0] - slack or new[-1] > old[-1] + slack:
        new = old[0] + (new - new[0]) * ((old[-1] - old[0]) / (new[-1] - new[0]))
    states = np.column_stack([np.interp(new, old, column) for column in plan.mean.T])
    middle = 0.5 * (new[:-1] + new[1:])
    interval = np.clip(np.searchsorted(old, middle, side="right") - 1, 0, len(old) - 2)
    return states, plan.controls[interval]


def run_guarded(
    model: Model,
    options: Options,
    run: Callable[..., Outcome],
    guess: tuple[Array, Array],
    *,
    trusted: bool,
) -> tuple[Array, Outcome]:
    """The better outcome of a given guess and the problem's own, and the states it began with.

    `run` iterates from states and controls, `own=True` saying that they are the problem's. If
    `trusted`, its own guess is left out where the given one obeys the dynamics and the terminal
    condition at least as well and its outcome converges.
    """

    def off(x: Array, u: Array) -> float:
        at = linearize(model, x, u)
        return max(inconsistency(at), float(lacks(at, options.terminal_tolerance).max(initial=0.0)))

    warm, own = run(*guess), model.guess()
    same = all(np.array_equal(a, b) for a, b in zip(guess, own, strict=True))
    trusted = trusted and warm.status.ok
    if warm.status is Status.STOPPED or same or (trusted and off(*guess) <= off(*own)):
        return guess[0], warm
    cold = run(*own, own=True)
    if cold.status.ok != warm.status.ok:
        better = cold.status.ok
    elif not cold.status.ok:
        better = off(cold.x, cold.u) < off(warm.x, warm.u)
    else:  # cheaper by more than rounding errors
        better = cold.objective < warm.objective - 1e-6 * (1.0 + abs(warm.objective))
    words = "the plan from {} guess: {} led to {o.status} at {o.objective:.6g}"
    if better:
        return own[0], cold.said(words.format("the problem's own", "the given one", o=warm))
    return guess[0], warm.said(words.format("the given", "the problem's own", o=cold))

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
from slipcar.planner.problem.feasibility import inconsistency
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import Model, checked_trajectory
from slipcar.planner.status import Status

Array = np.ndarray


def given_guess(model: Model, guess: Any) -> tuple[Array, Array]:
    """States (N, n) and controls (N−1, m) from a plan or a pair of arrays.

    Raises:
        ValueError: for anything else, a wrong shape, a non-finite entry, or a plan of other
            dimensions.
    """
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
    if len(old) == len(new) and np.array_equal(old, new):
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

    Args:
        model: the problem.
        options: of the iteration.
        run: the iteration from states (N, n) and controls (N−1, m); `own=True` says that they
            are the problem's own guess.
        guess: where to start.
        trusted: whether the problem's own guess may be left out if the given one obeys the
            dynamics and the terminal condition at least as well and its outcome converges.
    """
    warm = run(*guess)
    if warm.status is Status.STOPPED:
        return guess[0], warm
    own = model.guess()
    if all(np.array_equal(a, b) for a, b in zip(guess, own, strict=True)):
        return guess[0], warm
    if trusted and warm.status.ok:
        off = [
            inconsistency(linearize(model, *start), options.terminal_tolerance)
            for start in (guess, own)
        ]
        if off[0] <= off[1]:
            return guess[0], warm
    cold = run(*own, own=True)
    if _better(model, options, cold, warm):
        say = f"the plan from the problem's own guess: the given one led to {_told(warm)}"
        return own[0], cold.said(say)
    say = f"the plan from the given guess: the problem's own led to {_told(cold)}"
    return guess[0], warm.said(say)


def _better(model: Model, options: Options, a: Outcome, b: Outcome) -> bool:
    """Whether a is: converged, or lacking less, or cheaper by more than rounding errors."""
    if a.status.ok != b.status.ok:
        return a.status.ok
    if not a.status.ok:
        off = [
            inconsistency(linearize(model, found.x, found.u), options.terminal_tolerance)
            for found in (a, b)
        ]
        return off[0] < off[1]
    return a.objective < b.objective - 1e-6 * (1.0 + abs(b.objective))


def _told(outcome: Outcome) -> str:
    return f"{outcome.status} at {outcome.objective:.6g}"

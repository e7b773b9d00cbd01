"""Disturbed guesses, the same for whoever plans: smooth bumps on states, noise on controls."""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.planner.problem.model import model_of

Array = np.ndarray
Guess = tuple[Array, Array]

#: Height of the bumps in parts of a component's range, and of the noise in parts of the width
#: between a control's bounds.
BUMP, NOISE = 0.3, 0.2


def disturbed(problem: Any, solution: Guess, seed: int) -> Guess:
    """The problem's own guess with half a sine wave and a whole one on every state, ends kept.

    The range of a component is that along the guess; where it does not move there, or a control
    has no bounds, that along a solution.
    """
    model = model_of(problem)
    x, u = model.guess()
    rng = np.random.default_rng(seed)
    s = np.linspace(0.0, np.pi, len(x))[:, None]
    heights = BUMP * _ranges(x, solution[0]) * rng.uniform(-1.0, 1.0, (2, x.shape[1]))
    x = x + heights[0] * np.sin(s) + heights[1] * np.sin(2.0 * s)
    width = model.upper - model.lower
    width = np.where(np.isfinite(width), width, np.ptp(solution[1], axis=0))
    return x, model.admissible(u + NOISE * width * rng.normal(size=u.shape))


def _ranges(x: Array, other: Array) -> Array:
    own = np.ptp(x, axis=0)
    return np.where(own > 0.0, own, np.ptp(other, axis=0))

"""Numbers of the iteration of :mod:`.loop`; each is dimensionless."""

from __future__ import annotations

from typing import NamedTuple


class Tuning(NamedTuple):
    """How the iteration behaves; a named tuple for the same reason as `newton.settings.Tuning`.

    Attributes:
        first_shift: the first multiple of the identity added to a Hessian that is not convex, in
            units of the largest diagonal entry of R.
        shift_up: how it grows until the problem is convex, or when a step is rejected.
        shift_down: how it falls after a good step.
        inertia_trials: so many LQ problems at most to find it.
        bound_rounds: changes of the set of active bounds within one iteration.
        bound_stiffness: active bounds are held by a weight so much stiffer than the control's.
        terminal_curvature: see `newton.settings.Tuning`.
        armijo: sufficient decrease.
        searches: trials of a step, each half the one before.
        rejections: steps rejected in a row before it gives up.
        patience: of steps in a row, none shorter than half the shortest before them: then they go
            round in circles, and both damping and shift are made to shorten them.
        least_damping: how far that goes.
        longest: a step ∫ΔuᵀRΔu dt at most, relative to the effort, or the guess's if larger.
        noise: relative accuracy of the merit function.
        feasibility: what a converged plan may leave of the terminal condition, per unit of state.
        consistency: and between its mean and the path its controls lead to.
    """

    first_shift: float = 0.1
    shift_up: float = 4.0
    shift_down: float = 4.0
    inertia_trials: int = 31
    bound_rounds: int = 6
    bound_stiffness: float = 1e12
    terminal_curvature: float = 1e4
    armijo: float = 1e-3
    searches: int = 6
    rejections: int = 8
    patience: int = 8
    least_damping: float = 0.05
    longest: float = 0.1
    noise: float = 1e-9
    feasibility: float = 1e-6
    consistency: float = 1e-4


TUNING = Tuning()

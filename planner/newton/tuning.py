"""Numbers of the method of :mod:`.loop`, found on the random worlds; each is dimensionless."""

from __future__ import annotations

from typing import NamedTuple


class Tuning(NamedTuple):
    """How the iteration behaves.

    Attributes:
        free_steps: steps taken whole, with convex models, before Newton's method begins.
        released_steps: steps without rows at most, when they are left out at first.
        released: a step ∫ΔuᵀRΔu dt that brings them in sooner, relative to the effort.
        settled: a step ∫ΔuᵀRΔu dt that lets Newton's method begin sooner, relative to the effort.
        bound_rounds: changes of the set of active bounds within one iteration.
        bound_stiffness: active bounds are held by a weight so much stiffer than the control's.
        unseen: hinges that are off at the iterate act in a judged step's model if it would cross
            them at a cost of so many times what it gains.
        terminal_curvature: a multiple of ‖G d + g‖², zero at a solution, lets the recursion see
            that the terminal condition holds: relative to how far the last controls move it.
        first_shift: the first multiple of R added to a Hessian that is not convex.
        shift_up: how it grows until the problem is convex, or when a step is rejected.
        shift_down: how it falls after a good step.
        largest_shift: beyond it the curvature is taken back instead, to a quarter each time.
        least_curvature: where it ends, and from where it grows again, twofold each step.
        bent: a step along which the cost rises by more than this part of what its defects cost has
            a model that is not convex along it.
        inertia_trials: so many LQ problems at most to find a convex one.
        armijo: sufficient decrease.
        searches: trials of a step: the linear one, then roll-outs, each half the one before.
        long_searches: trials of the convex model's step, which is tried after `rejections`.
        rejections: rejected steps in a row before that, or before giving up.
        falls_back: whether there is a convex model to fall back to.
        patience: of Newton's steps in a row, none shorter than half the shortest before them: then
            they go round in circles, and shift and renewal are made to shorten them.
        longest: a judged step ∫ΔuᵀRΔu dt at most, relative to the effort, or the guess's if larger.
        boldness: bold steps end where the merit rises by so many times the cost.
        renewal: how much of a change of the rows' weights an iteration takes over, in (0, 1].
        least_renewal: how far it falls when steps go round in circles.
        dearest: multipliers of the end so large beside the cost, `patience` times in a row, say
            that it cannot be reached.
        noise: relative accuracy of the merit function.
        defective: defects that cost more than this part of the effort are no extremal's.
        long: nor are steps ∫ΔuᵀRΔu dt longer than this part of it, where there are defects.
        feasibility: what a converged plan may leave of the terminal condition, relative to how far
            the states in it move.
        consistency: and of its dynamics, all nodes together, relative to how far each state moves;
            both are for the default tolerance and larger ones, and smaller in proportion to it.
        strictest: by this factor at most.
    """

    free_steps: int = 20
    released_steps: int = 10
    released: float = 0.02
    settled: float = 1.0
    bound_rounds: int = 6
    bound_stiffness: float = 1e12
    unseen: float = 300.0
    terminal_curvature: float = 1e4
    first_shift: float = 0.1
    shift_up: float = 4.0
    shift_down: float = 4.0
    largest_shift: float = 2.0
    least_curvature: float = 0.05
    bent: float = 0.5
    inertia_trials: int = 31
    armijo: float = 1e-3
    searches: int = 8
    long_searches: int = 14
    rejections: int = 5
    falls_back: bool = True
    patience: int = 8
    longest: float = 0.3
    boldness: float = 2.0
    renewal: float = 0.5
    least_renewal: float = 0.05
    dearest: float = 1e12
    noise: float = 1e-9
    defective: float = 0.1
    long: float = 0.02
    feasibility: float = 1e-6
    consistency: float = 5e-5
    strictest: float = 1e-5


#: Of plans of the mean; with every step judged; and of plans that count the noise, which start from
#: one of them.
MEAN = Tuning()
JUDGED = MEAN._replace(free_steps=0)
NOISE = MEAN._replace(free_steps=0, searches=6, rejections=8, falls_back=False, longest=0.1)

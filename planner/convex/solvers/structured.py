"""Newton's method on active sets for the sub-problem: a few LQ problems, each one banded solve.

The sub-problem is a linear-quadratic problem but for convex piecewise quadratics: hinge rows,
limits of the controls and the exact terminal penalty. Which piece each of them is on is the
*active set*; given it, the optimality conditions are linear (:mod:`.lq_problem`). The solution
says which pieces it lies on; when they are the assumed ones, it is the optimum, to machine
precision. This takes one to seven solves as a rule. What does not settle soon (many bounds
active, a terminal condition that cannot be met) goes to :mod:`.interior_point`, whose solution's
active set is then polished here.
"""

from __future__ import annotations

import numpy as np

from slipcar.planner.convex.solvers.interface import Solution, failed
from slipcar.planner.convex.solvers.interior_point import interior_point
from slipcar.planner.convex.solvers.lq_problem import End, LqProblem
from slipcar.planner.convex.subproblem import Pieces, Subproblem
from slipcar.planner.lq.banded import PrimalDual

Array = np.ndarray

#: Solves before the interior point takes over: so many and one more for each `_NODES` nodes (the
#: first sub-problem needs 8 at 41 nodes, 15 at 321, 20 at 481); and those it leaves for polishing.
_SOLVES, _NODES, _POLISHING_SOLVES = 16, 16, 8
#: The terminal condition gives way by this much as its multiplier reaches ρ: keeps the matrix
#: regular where the linearised dynamics cannot reach a direction, and ν then comes out beyond ρ.
_TERMINAL_WIDTH = 1e-10


class StructuredSolver:
    """Solver for sub-problems of one shape; remembers which controls were held as a warm start."""

    def __init__(self) -> None:
        self._lq: LqProblem | None = None
        self._last: Pieces | None = None

    def solve(self, sub: Subproblem) -> Solution:
        """Solve one sub-problem; see the module's docstring."""
        shape = (*sub.f.shape, len(sub.g))
        if self._lq is None or self._lq.shape != shape:
            self._lq, self._last = LqProblem(*shape), None
        self._lq.load(sub)
        # Hinges on at the iterate, limits of the last solution, the terminal condition held.
        hinge, terminal = sub.b > 0.0, np.ones(len(sub.g), dtype=np.int64)
        start = sub.free(hinge, terminal)
        if self._last is not None and sub.limited:
            start = self._last._replace(hinge=hinge, terminal=terminal)
        point, pieces, solves = _newton(self._lq, start, _SOLVES + len(sub.f) // _NODES)
        if point is None or np.abs(point.terminal).max(initial=0.0) > sub.rho:
            point, pieces, spent = _from_inside(self._lq, start)
            solves += spent
        self._last = pieces
        if point is None:
            return failed(sub, solves, f"not solved after {solves} LQ solves")
        e = sub.admissible(point.e)
        objective = sub.objective(point.d, e)
        return Solution(True, point.d, e, point.adjoint, point.terminal, objective, solves)


def _newton(lq: LqProblem, start: Pieces, limit: int) -> tuple[PrimalDual | None, Pieces, int]:
    """The point that lies on the pieces it was computed with, or None; LQ solves."""
    sub, pieces, terminal = lq.sub, start, None
    for solves in range(1, limit + 1):
        weight, controls = sub.h * pieces.hinge, None
        if pieces.hold:
            controls = sub.held_controls(pieces, sub.R, sub.r)
        if pieces.terminal is not terminal:  # which rarely changes
            terminal, end = pieces.terminal, _end(sub, pieces.terminal)
        point = lq.solve(weight, weight * sub.b, end, controls)
        if point is None:
            return None, start, solves
        reached = _reached(sub, point, pieces)
        if reached.same_as(pieces):
            return point, reached, solves
        pieces = reached
    return None, start, limit


def _end(sub: Subproblem, terminal: Array) -> End:
    """Terminal rows on these pieces."""
    softness = _TERMINAL_WIDTH * max(1.0, float(np.abs(sub.g).max(initial=0.0))) / sub.rho
    held = np.abs(terminal) == 1
    side = np.where(held, np.sign(terminal) * sub.tolerance - sub.g, terminal // 2 * sub.rho)
    return End(held, np.where(held, softness, 1.0), side)


def _reached(sub: Subproblem, point: PrimalDual, before: Pieces | None) -> Pieces:
    """Pieces that a point lies on; it was computed on those `before`, or by the interior point."""
    hinge = sub.hinge_arguments(point.d) > 0.0
    if before is not None and sub.tolerance == 0.0:
        terminal = before.terminal
    else:
        # What is held shows no residual: its multiplier tells where it wants to go.
        size = 1.0 + np.abs(sub.g)
        pressed = sub.G @ point.d[-1] + sub.g + point.terminal * size / sub.rho
        beyond = np.abs(pressed) - sub.tolerance
        inside = (beyond <= 0.0) & (sub.tolerance > 0.0)
        terminal = np.where(pressed < 0.0, -1, 1) * np.where(inside, 0, 1 + (beyond > size))
        if before is not None:
            # Only the interior point puts a multiplier at its limit: doing it while the hinges
            # are still unsettled costs many more solves.
            limit = np.abs(before.terminal) == 2
            terminal = np.where(limit, before.terminal, np.clip(terminal, -1, 1))
    if before is not None and not before.hold and sub.strictly_inside(point.e):
        return before._replace(hinge=hinge, terminal=terminal)
    return sub.pieces(hinge, terminal, point.e, sub.slope(point.adjoint, point.e))


def _from_inside(lq: LqProblem, start: Pieces) -> tuple[PrimalDual | None, Pieces, int]:
    """The interior point's solution, polished by Newton's method where that makes it better."""
    sub = lq.sub
    interior, spent = interior_point(sub, lq)
    if interior is None:
        return None, start, spent
    near = _reached(sub, interior, None)
    polished, pieces, solves = _newton(lq, near, _POLISHING_SOLVES)
    # The last interior systems are ill-conditioned: judge what the controls really do.
    best = _replayed(sub, interior)
    if polished is not None:
        candidate, value = _replayed(sub, polished), sub.objective(best.d, best.e)
        if sub.objective(candidate.d, candidate.e) <= value + 1e-9 * (1.0 + abs(value)):
            return candidate, pieces, spent + solves
    return best, near, spent + solves


def _replayed(sub: Subproblem, point: PrimalDual) -> PrimalDual:
    """The point with its controls made admissible and the states they lead to."""
    e = sub.admissible(point.e)
    return point._replace(d=sub.response(e), e=e)

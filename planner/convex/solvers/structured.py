"""Newton's method on active sets for the sub-problem: a few LQ problems, each one banded solve.

The sub-problem is a linear-quadratic problem but for convex piecewise quadratics: hinge rows,
control bounds and the exact terminal penalty. Which piece each of them is on is the *active
set*; given it, the optimality conditions are linear (:mod:`.lq_problem`). The solution says which
pieces it lies on; when they are the assumed ones, it is the optimum, to machine precision.
Whole steps settle this in one to seven solves as a rule; where they do not, an exact line search
on the convex objective shortens those that would raise it. What does not settle soon (many
bounds active, a terminal condition that cannot be met) goes to :mod:`.interior_point`, whose
solution's active set is then polished here.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.convex.solvers.active_set import ActiveSet, ControlLimits, Pieces
from slipcar.planner.convex.solvers.interface import Solution, failed
from slipcar.planner.convex.solvers.interior_point import interior_point
from slipcar.planner.convex.solvers.lq_problem import LqProblem
from slipcar.planner.convex.subproblem import Subproblem
from slipcar.planner.lq.banded import PrimalDual

#: Solves before the interior point takes over: so many and one more for each `_NODES` nodes (the
#: first sub-problem needs 8 at 41 nodes, 15 at 321, 20 at 481); and those it leaves for polishing.
_SOLVES, _NODES, _POLISHING_SOLVES = 20, 16, 8
#: So many steps are whole, whatever they do to the objective: most searches end within them.
_WHOLE_STEPS = 10


@dataclasses.dataclass(frozen=True)
class _Search:
    """How a search for the active set ended: its point, or None; LQ solves."""

    point: PrimalDual | None
    limits: ControlLimits | None
    solves: int


class StructuredSolver:
    """Solver for sub-problems of one shape; remembers the last active limits as a warm start."""

    def __init__(self) -> None:
        self._lq: LqProblem | None = None
        self._limits: ControlLimits | None = None

    def solve(self, sub: Subproblem) -> Solution:
        """Solve one sub-problem; see the module's docstring."""
        shape = (*sub.f.shape, len(sub.g))
        if self._lq is None or self._lq.shape != shape:
            self._lq, self._limits = LqProblem(*shape), None
        self._lq.load(sub)
        pieces = Pieces(sub)
        limit = _SOLVES + len(sub.f) // _NODES
        search = _newton(self._lq, pieces, pieces.start(self._limits), limit)
        if search.point is None or np.abs(search.point.terminal).max(initial=0.0) > sub.rho:
            search = _from_inside(self._lq, pieces, search.solves)
        self._limits, point = search.limits, search.point
        if point is None:
            return failed(sub, search.solves, f"not solved after {search.solves} LQ solves")
        e = sub.admissible(point.e)
        objective = sub.objective(point.d, e)
        return Solution(True, point.d, e, point.adjoint, point.terminal, objective, search.solves)


def _newton(lq: LqProblem, pieces: Pieces, active: ActiveSet, limit: int) -> _Search:
    """The point that lies on the pieces it was computed with, and its limits."""
    point: PrimalDual | None = None
    cost: float | None = None  # of the point; computed only when a line search may be needed
    for solves in range(1, limit + 1):
        target = lq.solve(pieces.terms(active))
        if target is None:
            return _Search(None, None, solves)
        wanted = pieces.active_set(target, active)
        if wanted.same_as(active):
            return _Search(target, wanted.limits, solves)
        # (Across a sphere the objective with its stiffness would let no step pass.)
        if point is None or solves <= _WHOLE_STEPS or pieces.balls:
            point = target
        else:
            cost = pieces.cost(point) if cost is None else cost
            target_cost = pieces.cost(target)
            step = 1.0 if target_cost <= cost else pieces.line_search(point, target)
            if step > 1.0 - 1e-10:
                point, cost = target, target_cost
            else:
                point = point.towards(target, step)
                cost = pieces.cost(point)
                wanted = pieces.active_set(point, active)
        active = wanted
    return _Search(None, None, limit)


def _from_inside(lq: LqProblem, pieces: Pieces, spent: int) -> _Search:
    """The interior point's solution, polished by Newton's method where that makes it better."""
    interior = interior_point(pieces.sub, lq)
    spent += interior.solves
    if interior.point is None:
        return _Search(None, None, spent)
    near = pieces.near(interior.point, interior.press)
    polished = _newton(lq, pieces, near, _POLISHING_SOLVES)
    # The last interior systems are ill-conditioned: judge what the controls really do.
    best, spheres = pieces.replayed(interior.point), near.limits.spheres
    if polished.point is not None and polished.limits is not None:
        candidate, objective = pieces.replayed(polished.point), pieces.sub.objective
        value = objective(best.d, best.e)
        if objective(candidate.d, candidate.e) <= value + 1e-9 * (1.0 + abs(value)):
            best, spheres = candidate, polished.limits.spheres
    return _Search(best, pieces.limits_near(best, spheres), spent + polished.solves)

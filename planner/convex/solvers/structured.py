"""Newton's method on active sets for the sub-problem: a few LQ problems, each one banded solve.

The sub-problem is a linear-quadratic problem but for convex piecewise quadratics: hinge rows,
control bounds and the exact terminal penalty. Which piece each of them is on is the *active
set*; given it, the optimality conditions are linear (:mod:`.kkt`). The solution says which
pieces it lies on; when they are the assumed ones, it is the optimum, to machine precision.
Whole steps settle this in one to seven solves as a rule; where they do not, an exact line search
on the convex objective shortens those that would raise it. What does not settle soon (many
bounds active, a terminal condition that cannot be met) goes to :mod:`.interior_point`, whose
solution's active set is then polished here.
"""

from __future__ import annotations

import dataclasses
from importlib import import_module
from types import ModuleType

import numpy as np

from slipcar.planner.convex.convexify import Subproblem
from slipcar.planner.convex.solvers import Solution, ball, failed
from slipcar.planner.convex.solvers.interior_point import interior_point
from slipcar.planner.lq.banded import BandedKkt, Point

Array = np.ndarray

#: Solves before the interior point takes over: so many and one more for each `_NODES` nodes (the
#: first sub-problem needs 8 at 41 nodes, 15 at 321, 20 at 481); and those it leaves for polishing.
_SOLVES, _NODES, _POLISHING_SOLVES = 20, 16, 8
#: So many steps are whole, whatever they do to the objective: most searches end within them.
_WHOLE_STEPS = 10
#: Active bounds are held by a weight so much stiffer than the cost of control: the control
#: passes its bound by 1e-12 of what its multiplier would make of it, and is clipped in the end.
_BOUND_WIDTH = 1e-12
#: The terminal condition gives way by this much as its multiplier reaches ρ.
_TERMINAL_WIDTH = 1e-10
#: Relative precision of a line search: the last step is always a full one.
_STEP_PRECISION = 1e-3


@dataclasses.dataclass
class _ActiveSet:
    """Which piece every piecewise quadratic is on."""

    hinge: Array  # (K, p) bool
    lower: Array  # (K, m) bool
    upper: Array  # (K, m) bool
    terminal: Array  # (q,) signed: 0 inside the box, ±1 held at its side, ±2 multiplier at ±ρ
    spheres: ball.Spheres | None = None  # of the balls of controls, if there are any

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _ActiveSet):
            return False
        return (
            all(
                a is b or bool((a == b).all())
                for a, b in (
                    (self.hinge, other.hinge),
                    (self.terminal, other.terminal),
                    (self.lower, other.lower),
                    (self.upper, other.upper),
                )
            )
            and self.spheres == other.spheres
        )


class StructuredSolver:
    """Solver for sub-problems of one shape; remembers the last active bounds as a warm start.

    Args:
        compiled: run Newton's method compiled by numba (:mod:`.compiled`), the same steps to
            rounding error; None does so where numba is installed.

    Raises:
        ImportError: if `compiled` is True and numba is missing.
    """

    def __init__(self, compiled: bool | None = None) -> None:
        self._kkt: BandedKkt | None = None
        self._bounds: tuple[Array, Array, ball.Spheres | None] | None = None
        self._compiled: ModuleType | None = None
        if compiled is not False:
            try:
                self._compiled = import_module("slipcar.planner.convex.solvers.compiled")
            except ImportError:
                if compiled:
                    raise

    def solve(self, sub: Subproblem) -> Solution:
        """Solve one sub-problem; see the module's docstring."""
        shape = (*sub.f.shape, len(sub.g))
        if self._kkt is None or self._kkt.shape != shape:
            self._kkt, self._bounds = BandedKkt(*shape), None
        kkt, pieces = self._kkt, _Pieces(sub)
        active = pieces.start(self._bounds)
        point, spheres, solves = self._newton(pieces, active, _SOLVES + len(sub.f) // _NODES)
        interior = point is None or np.max(np.abs(point.terminal), initial=0.0) > sub.rho
        if point is None or interior:
            kkt.load(sub)
            inner, press, more = interior_point(sub, kkt)
            solves += more
            if inner is None:
                self._bounds = None
                return failed(sub, solves, f"not solved after {solves} LQ solves")
            near = pieces.near(inner, press)
            point, spheres, more = self._newton(pieces, near, _POLISHING_SOLVES)
            solves += more
            # The last interior systems are ill-conditioned: judge what the controls really do.
            inner = pieces.replayed(inner)
            best = pieces.objective_of(inner)
            if point is not None:
                point = pieces.replayed(point)
            if point is None or pieces.objective_of(point) > best + 1e-9 * (1.0 + abs(best)):
                point, spheres = inner, near.spheres
        bounds = pieces.bounds_near(point, spheres) if interior else pieces.bounds_at(point)
        self._bounds = (*bounds, spheres)
        e = sub.admissible(point.e)
        return Solution(
            found=True,
            d=point.d,
            e=e,
            adjoint=point.adjoint,
            terminal=point.terminal,
            objective=sub.objective(point.d, e),
            iterations=solves,
        )

    def _newton(
        self, pieces: _Pieces, active: _ActiveSet, limit: int
    ) -> tuple[Point | None, ball.Spheres | None, int]:
        """:func:`_newton`, compiled or not."""
        if self._compiled is None:
            assert self._kkt is not None
            self._kkt.load(pieces.sub)
            return _newton(self._kkt, pieces, active, limit)
        sub = pieces.sub
        arrays = (sub.A, sub.B, sub.f, sub.Q, sub.q, sub.R, sub.r, sub.a, sub.b, sub.h, sub.G)
        held = active.spheres or pieces.no_spheres
        settled, solves, *parts = self._compiled.newton(
            *(np.ascontiguousarray(array) for array in arrays),
            sub.g,
            sub.rho,
            sub.tolerance,
            sub.lower,
            sub.upper,
            pieces.stiffness,
            pieces.softness,
            active.hinge.copy(),
            active.lower.copy(),
            active.upper.copy(),
            active.terminal.copy(),
            sub.center,
            sub.radius,
            ball.STIFFNESS * pieces.stiffest,
            ball.SETTLED,
            held.on,
            held.turn,
            held.press,
            limit,
        )
        point = Point(*parts) if settled else None
        return point, (held if pieces.balls else None), solves


def _newton(
    kkt: BandedKkt, pieces: _Pieces, active: _ActiveSet, limit: int
) -> tuple[Point | None, ball.Spheres | None, int]:
    """The point that lies on the pieces it was computed with, if found; its spheres; the solves."""
    point: Point | None = None
    value: float | None = None  # of the point; found only when a line search may be needed
    for solves in range(1, limit + 1):
        target = kkt.solve(*pieces.lq(active))
        if target is None:
            return None, None, solves
        found = pieces.active_set(target, active)
        if found == active:
            return target, found.spheres, solves
        # (Across a sphere the objective with its stiffness would let no step pass.)
        if point is None or solves <= _WHOLE_STEPS or pieces.balls:
            point = target
        else:
            if value is None:
                value = pieces.objective(point)
            target_value = pieces.objective(target)
            step = 1.0 if target_value <= value else pieces.line_search(point, target)
            if step > 1.0 - 1e-10:
                point, value = target, target_value
            else:
                point = point.towards(target, step)
                value = pieces.objective(point)
                found = pieces.active_set(point, active)
        active = found
    return None, None, limit


class _Pieces:
    """The piecewise quadratics of a sub-problem."""

    def __init__(self, sub: Subproblem) -> None:
        self.sub = sub
        self.bounded = sub.bounded
        self._off = np.zeros(sub.r.shape, dtype=bool)
        self.balls = sub.radius < np.inf
        self.stiffest = float(np.einsum("kii->ki", sub.R).max())
        self.stiffness = self.stiffest / _BOUND_WIDTH
        # Keeps the matrix regular where the linearised dynamics cannot reach a direction: the
        # multiplier then comes out beyond ρ.
        self.softness = (
            _TERMINAL_WIDTH * max(1.0, float(np.max(np.abs(sub.g), initial=0.0))) / sub.rho
        )

    @property
    def no_spheres(self) -> ball.Spheres:
        """What the compiled method is given where there are no balls."""
        return ball.Spheres(np.zeros(0, dtype=bool), self.sub.center[:0], np.zeros(0), 0.0)

    def start(self, before: tuple[Array, Array, ball.Spheres | None] | None) -> _ActiveSet:
        """The hinges on at the iterate, the bounds of the last solution, the condition held."""
        held = np.ones(len(self.sub.g), dtype=np.int64)
        lower, upper, spheres = before or (self._off, self._off, None)
        if not self.bounded:
            lower, upper = self._off, self._off
        spheres = ball.start(self.sub, spheres) if self.balls else None
        return _ActiveSet(self.sub.b > 0.0, lower, upper, held, spheres)

    def hinge_arguments(self, d: Array) -> Array:
        """Linearised c at nodes 1..K, (K, p)."""
        return np.matmul(self.sub.a, d[..., None])[..., 0] + self.sub.b

    def lq(self, active: _ActiveSet) -> tuple:
        """What the LQ problem of an active set adds; arguments of `BandedKkt.solve`."""
        sub = self.sub
        weight = sub.h * active.hinge
        held = np.abs(active.terminal) == 1
        diagonal = np.where(held, -self.softness, 1.0)
        side = np.sign(active.terminal) * sub.tolerance - sub.g
        right = np.where(held, side, active.terminal // 2 * sub.rho)
        control = None
        if self.bounded:
            at_bound = active.lower | active.upper
            if at_bound.any():
                stiff = self.stiffness * at_bound
                bound = np.where(active.upper, sub.upper, np.where(active.lower, sub.lower, 0.0))
                control = (stiff[..., None] * np.eye(stiff.shape[1]), -stiff * bound)
        ray = None
        if active.spheres is not None and active.spheres.on.any():
            block, force, ray = ball.terms(sub, active.spheres)
            control = (
                (block, force) if control is None else (control[0] + block, control[1] + force)
            )
        return weight, weight * sub.b, held, diagonal, right, control, ray

    def active_set(self, point: Point, computed_with: _ActiveSet) -> _ActiveSet:
        """Pieces a Newton point lies on, and those it was computed with."""
        before = computed_with.terminal
        sub, nu = self.sub, point.terminal
        # What is held shows no residual; its multiplier tells where it wants to go. (A held
        # condition is clipped only by the interior point: doing it here, while the hinges are
        # still unsettled, costs many more solves.)
        held = np.abs(before) == 1
        terminal = before
        if sub.tolerance > 0.0:
            residual = sub.G @ point.d[-1] + sub.g
            off = np.where(np.abs(residual) > sub.tolerance, np.sign(residual), 0).astype(np.int64)
            turned = np.where(nu * before < 0.0, -before, before)
            terminal = np.where(held, turned, np.where(before == 0, off, before))
        hinge = self.hinge_arguments(point.d) > 0.0
        spheres = computed_with.spheres
        if spheres is not None:
            spheres = ball.at(sub, point.e, spheres)
        return _ActiveSet(hinge, *self.bounds_at(point), terminal, spheres)

    def near(self, point: Point, press: Array) -> _ActiveSet:
        """Pieces the solution of the interior point lies on, or almost; `press` is of the balls.

        Of a slack and its multiplier, the one that is smaller for its kind is the one that
        vanishes.
        """
        sub, nu = self.sub, point.terminal
        residual = sub.G @ point.d[-1] + sub.g
        beyond = (np.abs(residual) - sub.tolerance) / (1.0 + np.abs(sub.g))
        share = np.abs(nu) / sub.rho
        sign = np.where(nu < 0.0, -1, 1)
        terminal = np.where(beyond > 1.0 - share, 2 * sign, sign)
        if sub.tolerance > 0.0:
            terminal = np.where(-beyond > share, 0, terminal)
        hinge = self.hinge_arguments(point.d) > 0.0
        spheres = ball.near(sub, point.e, press) if self.balls else None
        return _ActiveSet(hinge, *self.bounds_near(point, spheres), terminal, spheres)

    def bounds_at(self, point: Point) -> tuple[Array, Array]:
        """Lower and upper bounds that a Newton point passes (active ones by a hair)."""
        if not self.bounded:
            return self._off, self._off
        return point.e < self.sub.lower, point.e > self.sub.upper

    def bounds_near(self, point: Point, spheres: ball.Spheres | None) -> tuple[Array, Array]:
        """Lower and upper bounds that hold the interior point's solution, as in :meth:`near`."""
        if not self.bounded:
            return self._off, self._off
        sub, slope = self.sub, self.slope(point)
        if spheres is not None:  # what they hold the bounds need not
            slope += spheres.press[:, None] * spheres.turn
        slope /= max(1.0, float(np.max(np.abs(slope))))
        size = 1.0 + np.abs(point.e)
        return (point.e - sub.lower) / size < slope, (sub.upper - point.e) / size < -slope

    def slope(self, point: Point) -> Array:
        """Gradient of the objective with respect to the controls, (K, m)."""
        slope = np.matmul(self.sub.R, point.e[..., None])[..., 0] + self.sub.r
        return slope + np.matmul(point.adjoint[:, None], self.sub.B)[:, 0]

    def objective(self, point: Point) -> float:
        """The objective with bounds as stiff penalties, for comparing points."""
        sub = self.sub
        d, e = point.d, point.e
        hinge = np.maximum(self.hinge_arguments(d), 0.0)
        value = 0.5 * np.vdot(e, np.matmul(sub.R, e[..., None])) + np.vdot(sub.r, e)
        value += 0.5 * np.vdot(d, np.matmul(sub.Q, d[..., None])) + np.vdot(sub.q, d)
        value += 0.5 * np.vdot(sub.h, hinge * hinge)
        if self.bounded:
            over = np.maximum(e - sub.upper, 0.0) + np.maximum(sub.lower - e, 0.0)
            value += 0.5 * self.stiffness * np.vdot(over, over)
        return float(value)

    def replayed(self, point: Point) -> Point:
        """The point with its controls made admissible and the states they lead to."""
        e = self.sub.admissible(point.e)
        return dataclasses.replace(point, d=self.sub.response(e), e=e)

    def objective_of(self, point: Point) -> float:
        """The sub-problem's own objective."""
        return self.sub.objective(point.d, point.e)

    def line_search(self, a: Point, b: Point) -> float:
        """Step in (0, 1] that minimises :meth:`objective` from a towards b.

        The derivative along the step is continuous, piecewise linear and increasing.
        """
        sub = self.sub
        dd, de = b.d - a.d, b.e - a.e
        R_de, Q_dd = np.matmul(sub.R, de[..., None]), np.matmul(sub.Q, dd[..., None])
        linear = float(
            np.vdot(sub.q, dd) + np.vdot(sub.r, de) + np.vdot(a.e, R_de) + np.vdot(a.d, Q_dd)
        )
        square = float(np.vdot(de, R_de) + np.vdot(dd, Q_dd))
        c = self.hinge_arguments(a.d)
        dc = self.hinge_arguments(b.d) - c
        # Between two points inside the bounds all are inside.
        bounded = self.bounded and any(
            (p.e > sub.upper).any() or (p.e < sub.lower).any() for p in (a, b)
        )

        def slope(t: float) -> tuple[float, float]:
            """Derivative along the step and, piecewise constant, its own derivative."""
            argument = c + t * dc
            push = sub.h * dc * (argument > 0.0)
            value = linear + t * square + float(np.vdot(push, argument))
            change = square + float(np.vdot(push, dc))
            if bounded:
                e = a.e + t * de
                high, low = e - sub.upper, sub.lower - e
                over = np.where(high > 0.0, high, np.where(low > 0.0, -low, 0.0))
                value += self.stiffness * float(np.vdot(over, de))
                change += self.stiffness * float(np.vdot((over != 0.0) * de, de))
            return value, change

        if slope(1.0)[0] <= 0.0:
            return 1.0
        # Newton on a piecewise linear increasing function, kept inside a shrinking bracket.
        low, high, t = 0.0, 1.0, 0.0
        for _ in range(60):
            value, change = slope(t)
            if value > 0.0:
                high = t
            else:
                low = t
            guess = t - value / change if change > 0.0 else -1.0
            new = guess if low < guess < high else 0.5 * (low + high)
            if abs(new - t) <= _STEP_PRECISION * new:
                return new
            t = new
        return high

"""The piecewise quadratics of a sub-problem, and which piece each of them is on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from slipcar.planner.convex.solvers import ball
from slipcar.planner.convex.solvers.lq_problem import End, Terms
from slipcar.planner.convex.subproblem import Subproblem
from slipcar.planner.lq.banded import PrimalDual

Array = np.ndarray

#: Active bounds are held by a weight so much stiffer than the cost of control: the control
#: passes its bound by 1e-12 of what its multiplier would make of it, and is clipped in the end.
_BOUND_WIDTH = 1e-12
#: The terminal condition gives way by this much as its multiplier reaches ρ.
_TERMINAL_WIDTH = 1e-10
#: Relative precision of a line search: the last step is always a full one.
_STEP_PRECISION = 1e-3


@dataclasses.dataclass(frozen=True, slots=True)
class ControlLimits:
    """Where the controls are held.

    Attributes:
        lower: at their lower bounds, (K, m) bool.
        upper: at their upper bounds, (K, m) bool.
        spheres: on the spheres of balls of controls, if there are any.
    """

    lower: Array
    upper: Array
    spheres: ball.Spheres | None = None

    def same_as(self, other: ControlLimits) -> bool:
        """Whether all are held alike."""
        alike = self is other or bool(
            (self.lower == other.lower).all() and (self.upper == other.upper).all()
        )
        if alike and self.spheres is not None and other.spheres is not None:
            return self.spheres.same_as(other.spheres)
        return alike


@dataclasses.dataclass(frozen=True, slots=True)
class ActiveSet:
    """Which piece every piecewise quadratic is on.

    Attributes:
        hinge: hinges that push, (K, p) bool.
        terminal: of the terminal penalty, (q,) signed: 0 inside the box, ±1 held at its side,
            ±2 multiplier at ±ρ.
        limits: where the controls are held.
    """

    hinge: Array
    terminal: Array
    limits: ControlLimits

    def same_as(self, other: ActiveSet) -> bool:
        """Whether all are on the same pieces."""
        return (
            bool((self.hinge == other.hinge).all())
            and (self.terminal is other.terminal or bool((self.terminal == other.terminal).all()))
            and self.limits.same_as(other.limits)
        )


class Pieces:
    """The pieces of one sub-problem: what they add to an LQ problem, and which a point is on.

    Args:
        sub: the sub-problem.
    """

    def __init__(self, sub: Subproblem) -> None:
        self.sub, self.bounded, self.balls = sub, sub.bounded, sub.radius < np.inf
        off = np.zeros(sub.r.shape, dtype=bool)
        self.no_limits = ControlLimits(off, off)
        self.stiffness = float(sub.R.diagonal(axis1=1, axis2=2).max()) / _BOUND_WIDTH
        # Keeps the matrix regular where the linearised dynamics cannot reach a direction: the
        # multiplier then comes out beyond ρ.
        self._softness = _TERMINAL_WIDTH * max(1.0, float(np.abs(sub.g).max(initial=0.0))) / sub.rho
        self._terminal: Array | None = None

    def start(self, before: ControlLimits | None) -> ActiveSet:
        """Hinges on at the iterate, limits of the last solution, the terminal condition held."""
        limits, spheres = self.no_limits, None
        if before is not None and self.bounded:
            limits = before
        if self.balls:
            spheres = ball.start(self.sub, None if before is None else before.spheres)
        limits = ControlLimits(limits.lower, limits.upper, spheres)
        held = np.ones(len(self.sub.g), dtype=np.int64)
        return ActiveSet(self.sub.b > 0.0, held, limits)

    def terms(self, active: ActiveSet) -> Terms:
        """What an active set adds to the LQ problem."""
        sub = self.sub
        weight = sub.h * active.hinge
        limits, block, push, ray = active.limits, None, None, None
        if self.bounded and (at_bound := limits.lower | limits.upper).any():
            stiff = self.stiffness * at_bound
            bound = np.where(limits.upper, sub.upper, np.where(limits.lower, sub.lower, 0.0))
            block, push = stiff[..., None] * np.eye(stiff.shape[1]), -stiff * bound
        if limits.spheres is not None and limits.spheres.on.any():
            bent, pressed, ray = ball.terms(sub, limits.spheres)
            block = bent if block is None else block + bent
            push = pressed if push is None else push + pressed
        end = self._end(active.terminal)
        return Terms(weight, weight * sub.b, end, block, push, ray)

    def _end(self, terminal: Array) -> End:
        """The terminal rows, remembered: they rarely change."""
        if terminal is not self._terminal:
            held = np.abs(terminal) == 1
            side = np.sign(terminal) * self.sub.tolerance - self.sub.g
            delta = np.where(held, self._softness, 1.0)
            self._rows = End(held, delta, np.where(held, side, terminal // 2 * self.sub.rho))
            self._terminal = terminal
        return self._rows

    def active_set(self, point: PrimalDual, computed_with: ActiveSet) -> ActiveSet:
        """Pieces a Newton point lies on, and those it was computed with."""
        sub, terminal, limits = self.sub, computed_with.terminal, self.no_limits
        # What is held shows no residual; its multiplier tells where it wants to go. (A held
        # condition is clipped only by the interior point: doing it here, while the hinges are
        # still unsettled, costs many more solves.)
        if sub.tolerance > 0.0:
            residual = sub.G @ point.d[-1] + sub.g
            off = np.where(np.abs(residual) > sub.tolerance, np.sign(residual), 0).astype(np.int64)
            turned = np.where(point.terminal * terminal < 0.0, -terminal, terminal)
            inside = np.where(terminal == 0, off, terminal)
            terminal = np.where(np.abs(terminal) == 1, turned, inside)
        spheres = computed_with.limits.spheres
        if self.bounded or spheres is not None:
            spheres = None if spheres is None else ball.at(sub, point.e, spheres)
            limits = self.limits_at(point, spheres)
        return ActiveSet(sub.hinge_arguments(point.d) > 0.0, terminal, limits)

    def near(self, point: PrimalDual, press: Array) -> ActiveSet:
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
        spheres = ball.near(sub, point.e, press) if self.balls else None
        hinge = sub.hinge_arguments(point.d) > 0.0
        return ActiveSet(hinge, terminal, self.limits_near(point, spheres))

    def limits_at(self, point: PrimalDual, spheres: ball.Spheres | None) -> ControlLimits:
        """Bounds that a Newton point passes (active ones by a hair)."""
        if not self.bounded:
            return dataclasses.replace(self.no_limits, spheres=spheres)
        return ControlLimits(point.e < self.sub.lower, point.e > self.sub.upper, spheres)

    def limits_near(self, point: PrimalDual, spheres: ball.Spheres | None) -> ControlLimits:
        """Bounds that hold the interior point's solution, as in :meth:`near`."""
        if not self.bounded:
            return dataclasses.replace(self.no_limits, spheres=spheres)
        sub = self.sub
        slope = np.matmul(sub.R, point.e[..., None])[..., 0] + sub.r
        slope += np.matmul(point.adjoint[:, None], sub.B)[:, 0]
        if spheres is not None:  # what they hold the bounds need not
            slope += spheres.press[:, None] * spheres.turn
        slope /= max(1.0, float(np.max(np.abs(slope))))
        size = 1.0 + np.abs(point.e)
        lower, upper = (point.e - sub.lower) / size < slope, (sub.upper - point.e) / size < -slope
        return ControlLimits(lower, upper, spheres)

    def replayed(self, point: PrimalDual) -> PrimalDual:
        """The point with its controls made admissible and the states they lead to."""
        e = self.sub.admissible(point.e)
        return dataclasses.replace(point, d=self.sub.response(e), e=e)

    def cost(self, point: PrimalDual) -> float:
        """The objective with bounds as stiff penalties and no terminal penalty."""
        sub, d, e = self.sub, point.d, point.e
        value = sub.cost(d, e)
        if self.bounded:
            over = np.maximum(e - sub.upper, 0.0) + np.maximum(sub.lower - e, 0.0)
            value += 0.5 * self.stiffness * float(np.vdot(over, over))
        return value

    def line_search(self, a: PrimalDual, b: PrimalDual) -> float:
        """Step in (0, 1] that minimises :meth:`cost` from a towards b.

        The derivative along the step is continuous, piecewise linear and increasing: Newton's
        method on it, kept inside a shrinking bracket.
        """
        slope = self._slope_along(a, b)
        if slope(1.0)[0] <= 0.0:
            return 1.0
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

    def _slope_along(self, a: PrimalDual, b: PrimalDual) -> Callable[[float], tuple[float, float]]:
        """Derivative of :meth:`cost` along the step and, piecewise constant, its own derivative."""
        sub, dd, de = self.sub, b.d - a.d, b.e - a.e
        R_de, Q_dd = np.matmul(sub.R, de[..., None]), np.matmul(sub.Q, dd[..., None])
        linear = float(
            np.vdot(sub.q, dd) + np.vdot(sub.r, de) + np.vdot(a.e, R_de) + np.vdot(a.d, Q_dd)
        )
        square = float(np.vdot(de, R_de) + np.vdot(dd, Q_dd))
        c = sub.hinge_arguments(a.d)
        dc = sub.hinge_arguments(b.d) - c
        # Between two points inside the bounds all are inside.
        bounded = self.bounded and any(
            (p.e > sub.upper).any() or (p.e < sub.lower).any() for p in (a, b)
        )

        def slope(t: float) -> tuple[float, float]:
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

        return slope

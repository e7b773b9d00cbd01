"""A primal-dual interior-point method for the sub-problem, one banded LQ solve a step.

It settles what Newton's method on active sets does not: many control bounds active at once, a
terminal condition that cannot be met. Every inequality s ≥ 0 has a multiplier z with
s z = μ → 0; linearised and eliminated, each only adds to the LQ problem's diagonal:

* bounds: R gets z/s, r the rest;
* balls, in the form s + (‖u‖² − r²)/(2r) = 0: R gets (z/s) t tᵀ + (z/r) I with t = u/r;
* the terminal slacks of the exact penalty and the box round the condition: softness δ of its
  row, G d − δ ν = s.

Hinges are no inequalities: each step takes them as they are on at the last point. μ falls the
faster the longer the last step was; the method stops at a gap of 1e-11 of the objective and leaves
the last digits to Newton's method.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slipcar.planner.convex.solvers.lq_problem import End, LqProblem
from slipcar.planner.convex.subproblem import Subproblem
from slipcar.planner.lq.banded import PrimalDual

Array = np.ndarray

_MAX_STEPS = 100
_GAP = 1e-11
#: What is good enough to be polished when so many steps have brought nothing better.
_ENOUGH, _IDLE = 1e-6, 8


class _ByKind(NamedTuple):
    """One array for each kind of inequality; infinite slacks have z = 0."""

    lower: Array  # bounds on e, (K, m)
    upper: Array
    plus: Array  # terminal slack s⁺, its multiplier ρ − ν, (q,)
    minus: Array
    high: Array  # τ − w of the terminal box, (q,)
    low: Array  # τ + w
    ball: Array  # (K,), or (0,) where there are no balls

    def flat(self) -> Array:
        """All of them in a row."""
        return np.concatenate([values.ravel() for values in self])

    def split(self, flat: Array) -> _ByKind:
        """Views of a row, in the shapes of these."""
        ends = np.cumsum([values.size for values in self])[:-1]
        parts = zip(np.split(flat, ends), self, strict=True)
        return _ByKind(*(part.reshape(values.shape) for part, values in parts))


class _State(NamedTuple):
    """Slacks and multipliers (each a row of all kinds), a point, and w, the residual in the box."""

    s: Array
    z: Array
    point: PrimalDual
    w: Array

    def gap(self) -> float:
        """Mean of s z over the finite inequalities."""
        finite = np.isfinite(self.s)
        return float(np.mean(self.s[finite] * self.z[finite])) if finite.any() else 0.0

    def longest_step(self, change: _State) -> float:
        """Longest step in [0, 1] that keeps every slack and multiplier non-negative."""
        value, delta = np.concatenate(self[:2]), np.concatenate(change[:2])
        shrinking = delta < 0.0
        return float(np.min(value[shrinking] / -delta[shrinking], initial=1.0))


def interior_point(sub: Subproblem, lq: LqProblem) -> tuple[PrimalDual | None, int]:
    """Solve the sub-problem loaded in `lq`: its solution, or None; LQ solves."""
    kinds, state = _start(sub)
    best, best_error, best_step, sigma = state, np.inf, 0, 0.5
    size = 1.0 + np.abs(sub.G @ state.point.d[-1] + sub.g)
    scale = max(1.0, float(np.max(np.abs(sub.r))), sub.rho * 1e-3)
    for steps in range(1, _MAX_STEPS + 1):
        change = _direction(sub, lq, kinds, state, sigma * state.gap())
        if change is None:
            break
        step = min(1.0, 0.99 * state.longest_step(change))
        sigma = min(0.5, max(0.02, (1.0 - step) ** 2))
        state = _State(
            state.s + step * change.s,
            state.z + step * change.z,
            state.point.towards(change.point, step),
            state.w + step * change.w,
        )
        error = _error(sub, kinds, state, size, scale)
        if error < _GAP:
            return state.point, steps
        if error < 0.5 * best_error:
            best_error, best_step, best = error, steps, state
        elif best_error < _ENOUGH and steps > best_step + _IDLE:
            break  # rounding errors have taken over
    return best.point if best_error < _ENOUGH else None, steps


def _error(sub: Subproblem, kinds: _ByKind, state: _State, size: Array, scale: float) -> float:
    """The gap relative to the cost, or what a condition lacks relative to its size.

    Hinges were taken as they were on before: that is checked in the adjoint equation.
    """
    point, s = state.point, kinds.split(state.s)
    residual = sub.G @ point.d[-1] + sub.g - state.w - s.plus + s.minus
    off = float(np.max(np.abs(residual) / size, initial=0.0))
    if s.ball.size:
        off = max(off, float(np.max(np.abs(s.ball + _passed(sub, point.e)))) / sub.radius)
    off = max(off, sub.adjoint_residual(point.d, point.adjoint, point.terminal))
    return max(state.gap() / max(scale, abs(sub.objective(point.d, point.e))), off)


def _start(sub: Subproblem) -> tuple[_ByKind, _State]:
    """A strictly feasible one: controls inside their bounds, states by the dynamics."""
    q, balls = len(sub.g), sub.radius < np.inf
    width = np.where(np.isfinite(sub.upper - sub.lower), 0.1 * (sub.upper - sub.lower), 1.0)
    e = np.clip(0.0, sub.lower + width, sub.upper - width)
    if balls:
        u = e - sub.center
        within = 0.5 * sub.radius / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300)
        shrunk = np.minimum(within, 1.0) * u + sub.center
        e = shrunk if ((sub.lower < shrunk) & (shrunk < sub.upper)).all() else e
    d = sub.response(e)
    residual = sub.G @ d[-1] + sub.g
    size = 1.0 + np.abs(residual)
    box = np.full(q, sub.tolerance if sub.tolerance > 0.0 else np.inf)
    ball = np.maximum(-_passed(sub, e), 0.1 * sub.radius) if balls else np.zeros(0)
    plus, minus = np.maximum(residual, 0.0) + size, np.maximum(-residual, 0.0) + size
    s = _ByKind(e - sub.lower, sub.upper - e, plus, minus, box, box, ball)
    # The multipliers of slacks are ρ ∓ ν; one where nothing is known.
    z = _ByKind(*(np.where(np.isfinite(slack), 1.0, 0.0) for slack in s))
    z = z._replace(plus=np.full(q, sub.rho), minus=np.full(q, sub.rho))
    point = PrimalDual(d, e, np.zeros_like(d), np.zeros(q))
    return s, _State(s.flat(), z.flat(), point, np.zeros(q))


def _passed(sub: Subproblem, e: Array) -> Array:
    """(‖u‖² − r²)/(2r) ≤ 0 for the balls, (K,)."""
    u = e - sub.center
    return 0.5 * (np.sum(u * u, axis=1) / sub.radius - sub.radius)


def _direction(
    sub: Subproblem, lq: LqProblem, kinds: _ByKind, state: _State, mu: float
) -> _State | None:
    """Newton's target for s z = μ, with the change of slacks and multipliers and of w.

    Every kind of inequality is eliminated into the LQ problem, and recovered from its solution.
    """
    s, z = kinds.split(state.s), kinds.split(state.z)
    stiff, push = kinds.split(state.z / state.s), kinds.split(mu / state.s)
    (d, e, _, nu), w = state.point, state.w
    weight = sub.h * (sub.hinge_arguments(d) > 0.0)
    # The terminal slacks soften their row, and so does the box, Δw = ν / (z/s) + lean.
    soft = s.plus / z.plus + s.minus / z.minus
    side = -sub.g + mu / z.plus - mu / z.minus - soft * nu
    inverse, lean = np.zeros_like(w), np.zeros_like(w)
    if sub.tolerance > 0.0:
        inverse = 1.0 / (stiff.high + stiff.low)
        lean = (push.low - push.high) * inverse
        soft, side = soft + inverse, side + w + lean
    end = End(np.ones(len(w), dtype=bool), soft, side)
    target = lq.solve(weight, weight * sub.b, end, _controls(sub, e, s, z, stiff, push))
    if target is None:
        return None
    de, dw = target.e - e, target.terminal * inverse + lean
    ball = s.ball
    if ball.size:
        ball = -s.ball - _passed(sub, e) - np.sum((e - sub.center) * de, axis=1) / sub.radius
    dnu = target.terminal - nu
    plus, minus = (mu + s.plus * dnu) / z.plus, (mu - s.minus * dnu) / z.minus
    # The larger slack follows from the condition itself: its multiplier ρ ∓ ν is a small
    # difference, and dividing by it would lose all digits.
    residual, larger = sub.G @ target.d[-1] + sub.g - w - dw, s.plus >= s.minus
    plus, minus = np.where(larger, residual + minus, plus), np.where(larger, minus, plus - residual)
    moves = _ByKind(de, -de, plus - s.plus, minus - s.minus, -dw, dw, ball)
    ds = np.where(np.isfinite(state.s), moves.flat(), 0.0)
    dz = (mu - state.z * ds) / state.s - state.z  # s z = μ, linearised
    change = kinds.split(dz)
    change.plus[~larger], change.minus[larger] = -dnu[~larger], dnu[larger]
    return _State(ds, dz, target, dw)


def _controls(
    sub: Subproblem, e: Array, s: _ByKind, z: _ByKind, stiff: _ByKind, push: _ByKind
) -> tuple[Array, Array]:
    """M (K, m, m) and e⁰ (K, m) with what bounds and balls add to R and r."""
    eye, bounds = np.eye(e.shape[1]), stiff.lower + stiff.upper
    H, r = sub.R + bounds[..., None] * eye, sub.r + push.upper - push.lower - bounds * e
    if not s.ball.size:
        M = np.linalg.inv(H)
        return M, -np.matmul(M, r[..., None])[..., 0]
    t, curvature = (e - sub.center) / sub.radius, (z.ball / sub.radius)[:, None]
    r = r + push.ball[:, None] * t - curvature * e
    reach = np.sum(t * e, axis=1) - s.ball - _passed(sub, e)
    # ½ z/s (tᵀe − reach)² by Sherman and Morrison's formula, and the pull towards its plane
    # apart: summed up first, it would drown the rest in rounding errors.
    M = np.linalg.inv(H + curvature[..., None] * eye)
    y = np.matmul(M, t[..., None])[..., 0]
    share = stiff.ball / (1.0 + stiff.ball * np.sum(t * y, axis=1))
    M = M - share[:, None, None] * y[:, :, None] * y[:, None, :]
    return M, (share * reach)[:, None] * y - np.matmul(M, r[..., None])[..., 0]

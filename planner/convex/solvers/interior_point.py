"""A primal-dual interior-point method for the sub-problem, one banded LQ solve a step.

It settles what Newton's method on active sets does not: many control bounds active at once, a
terminal condition that cannot be met. Every inequality s ≥ 0 has a multiplier z with
s z = μ → 0; linearised and eliminated, each only adds to the LQ problem's diagonal:

* bounds: R gets z/s, r the rest;
* balls, in the form s + (‖u‖² − r²)/(2r) = 0: R gets (z/s) t tᵀ + (z/r) I with t = u/r;
* hinges ½ h t², t ≥ c, t ≥ 0: a weight on their row;
* the terminal slacks of the exact penalty and the box round the condition: softness δ of its
  row, G d − δ ν = s.

μ falls the faster the longer the last step was. A hinge that is off has t and its multiplier
both vanish, which makes the end linear rather than superlinear: the method stops at a gap of
1e-9 of the objective and leaves the last digits to Newton's method.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from slipcar.planner.convex.solvers.lq_problem import End, LqProblem, Ray, Terms
from slipcar.planner.convex.subproblem import Subproblem
from slipcar.planner.lq.banded import PrimalDual

Array = np.ndarray

_MAX_STEPS = 100
_GAP = 1e-9
#: What is good enough to be polished when so many steps have brought nothing better.
_ENOUGH, _IDLE = 1e-6, 8


class _Pair(NamedTuple):
    """Slacks s ≥ 0 of inequalities and their multipliers z ≥ 0; or the change of both."""

    s: Array
    z: Array


class _Pairs(NamedTuple):
    """Those of every inequality; infinite slacks with z = 0 where there is none."""

    lower: _Pair  # bounds on e, (K, m)
    upper: _Pair
    above: _Pair  # t − c of the hinges, (K, p)
    t: _Pair
    plus: _Pair  # terminal slack s⁺, its multiplier ρ − ν, (q,)
    minus: _Pair
    high: _Pair  # τ − w of the terminal box, (q,)
    low: _Pair  # τ + w
    ball: _Pair  # (K,), or (0,) where there are no balls

    def gap(self) -> float:
        """Mean of s z over the finite inequalities."""
        joined = np.concatenate([s[i := np.isfinite(s)] * z[i] for s, z in self])
        return float(joined.mean()) if joined.size else 0.0

    def moved(self, change: _Pairs, step: float) -> _Pairs:
        """These and a part of their change."""
        pairs = zip(self, change, strict=True)
        return _Pairs(*(_Pair(a.s + step * b.s, a.z + step * b.z) for a, b in pairs))

    def longest_step(self, change: _Pairs) -> float:
        """Longest step in [0, 1] that keeps every slack and multiplier non-negative."""
        step = 1.0
        for pair, moves in zip(self, change, strict=True):
            for value, delta in zip(pair, moves, strict=True):
                shrinking = delta < 0.0
                if shrinking.any():
                    step = min(step, float(np.min(value[shrinking] / -delta[shrinking])))
        return step


@dataclasses.dataclass(frozen=True)
class _State:
    """Where the method is: a point, slacks and multipliers, and w, the residual in the box."""

    point: PrimalDual
    pairs: _Pairs
    w: Array


@dataclasses.dataclass(frozen=True)
class Interior:
    """What the method found.

    Attributes:
        point: the solution, or None if it failed.
        press: multipliers of the balls, (K,) or (0,).
        solves: LQ solves.
    """

    point: PrimalDual | None
    press: Array
    solves: int


def interior_point(sub: Subproblem, lq: LqProblem) -> Interior:
    """Solve the sub-problem loaded in `lq`."""
    state = best = _start(sub)
    best_error, best_step, sigma = np.inf, 0, 0.5
    size = 1.0 + np.abs(sub.G @ state.point.d[-1] + sub.g)
    scale = max(1.0, float(np.max(np.abs(sub.r))), sub.rho * 1e-3)
    for steps in range(1, _MAX_STEPS + 1):
        direction = _direction(sub, lq, state, sigma * state.pairs.gap())
        if direction is None:
            break
        step = min(1.0, 0.99 * state.pairs.longest_step(direction.pairs))
        sigma = min(0.5, max(0.02, (1.0 - step) ** 2))
        state = _State(
            state.point.towards(direction.point, step),
            state.pairs.moved(direction.pairs, step),
            state.w + step * direction.w,
        )
        error = _error(sub, state, size, scale)
        if error < _GAP:
            return Interior(state.point, state.pairs.ball.z, steps)
        if error < 0.5 * best_error:
            best_error, best_step, best = error, steps, state
        elif best_error < _ENOUGH and steps > best_step + _IDLE:
            break  # rounding errors have taken over
    good = best_error < _ENOUGH
    return Interior(best.point if good else None, best.pairs.ball.z, steps)


def _error(sub: Subproblem, state: _State, size: Array, scale: float) -> float:
    """The gap relative to the cost, or what a condition lacks relative to its size."""
    point, pairs = state.point, state.pairs
    residual = sub.G @ point.d[-1] + sub.g - state.w - pairs.plus.s + pairs.minus.s
    off = [np.abs(residual) / size]
    if len(pairs.ball.s):
        off.append(np.abs(pairs.ball.s + _passed(sub, point.e)) / sub.radius)
    cost = max(scale, abs(sub.objective(point.d, point.e)))
    return max(pairs.gap() / cost, float(np.max(np.concatenate(off), initial=0.0)))


def _start(sub: Subproblem) -> _State:
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
    c, residual = sub.hinge_arguments(d), sub.G @ d[-1] + sub.g
    t, size = np.maximum(c, 0.0) + 1.0, 1.0 + np.abs(residual)
    pull, rho = 0.5 * sub.h * t + 1e-6, np.full(q, sub.rho)
    box = np.full(q, sub.tolerance if sub.tolerance > 0.0 else np.inf)
    pairs = _Pairs(
        lower=_one(e - sub.lower),
        upper=_one(sub.upper - e),
        above=_Pair(t - c, pull),
        t=_Pair(t, pull),
        plus=_Pair(np.maximum(residual, 0.0) + size, rho),
        minus=_Pair(np.maximum(-residual, 0.0) + size, rho),
        high=_one(box),
        low=_one(box),
        ball=_one(np.maximum(-_passed(sub, e), 0.1 * sub.radius) if balls else np.zeros(0)),
    )
    return _State(PrimalDual(d, e, np.zeros_like(d), np.zeros(q)), pairs, np.zeros(q))


def _one(slack: Array) -> _Pair:
    """Multipliers of one where there is an inequality."""
    return _Pair(slack, np.where(np.isfinite(slack), 1.0, 0.0))


def _passed(sub: Subproblem, e: Array) -> Array:
    """(‖u‖² − r²)/(2r) ≤ 0 for the balls, (K,)."""
    u = e - sub.center
    return 0.5 * (np.sum(u * u, axis=1) / sub.radius - sub.radius)


def _direction(sub: Subproblem, lq: LqProblem, state: _State, mu: float) -> _State | None:
    """Newton's target for s z = μ; the change of slacks and multipliers, and of the box's w.

    Every kind of inequality is eliminated into the LQ problem, and recovered from its solution.
    """
    pairs = state.pairs
    block, push, bounds_of = _bounds(state, mu)
    ray, ball_of = None, lambda target: _Pair(pairs.ball.s, pairs.ball.z)
    if len(pairs.ball.s):
        bent, pressed, ray, ball_of = _balls(sub, state, mu)
        block, push = block + bent, push + pressed
    omega, force, hinges_of = _hinges(sub, state, mu)
    soft, side, terminal_of = _terminal(sub, state, mu)
    end = End(np.ones(len(sub.g), dtype=bool), soft, side)
    target = lq.solve(Terms(omega, force, end, block, push, ray))
    if target is None:
        return None
    dw, terminal = terminal_of(target)
    change = _Pairs(**bounds_of(target), **hinges_of(target), **terminal, ball=ball_of(target))
    return _State(target, change, dw)


def _moved(pair: _Pair, ds: Array, mu: float) -> _Pair:
    """Changes of a slack, by ds, and of its multiplier, by s z = μ linearised."""
    s, z = pair
    return _Pair(np.where(np.isfinite(s), ds, 0.0), (mu - z * ds) / s - z)


def _bounds(
    state: _State, mu: float
) -> tuple[Array, Array, Callable[[PrimalDual], dict[str, _Pair]]]:
    """What bounds add to R (K, m, m) and r (K, m): z/s, and the rest."""
    e, lower, upper = state.point.e, state.pairs.lower, state.pairs.upper
    stiff = lower.z / lower.s + upper.z / upper.s
    push = mu / upper.s - mu / lower.s - stiff * e

    def recover(target: PrimalDual) -> dict[str, _Pair]:
        de = target.e - e
        return {"lower": _moved(lower, de, mu), "upper": _moved(upper, -de, mu)}

    return stiff[..., None] * np.eye(e.shape[1]), push, recover


def _balls(
    sub: Subproblem, state: _State, mu: float
) -> tuple[Array, Array, Ray, Callable[[PrimalDual], _Pair]]:
    """What balls s + (‖u‖² − r²)/(2r) = 0 add to R and r, and along t = u/r."""
    e, (s, z) = state.point.e, state.pairs.ball
    turn = (e - sub.center) / sub.radius
    off, curvature = s + _passed(sub, e), (z / sub.radius)[:, None]
    push = (mu / s)[:, None] * turn - curvature * e
    ray = Ray(turn, z / s, np.sum(turn * e, axis=1) - off)

    def recover(target: PrimalDual) -> _Pair:
        return _moved(state.pairs.ball, -off - np.sum(turn * (target.e - e), axis=1), mu)

    return curvature[..., None] * np.eye(e.shape[1]), push, ray, recover


def _hinges(
    sub: Subproblem, state: _State, mu: float
) -> tuple[Array, Array, Callable[[PrimalDual], dict[str, _Pair]]]:
    """Weight ω and force on the hinges' rows, (K, p): the force is that + ω Δc, Δt eliminated."""
    above, t = state.pairs.above, state.pairs.t
    g1, g2 = above.z / above.s, t.z / t.s
    D = sub.h + g1 + g2
    rest = mu / above.s + mu / t.s - sub.h * t.s
    omega = g1 * (sub.h + g2) / D
    force = mu / above.s - g1 * rest / D - omega * (t.s - above.s - sub.b)

    def recover(target: PrimalDual) -> dict[str, _Pair]:
        dc = np.matmul(sub.a, (target.d - state.point.d)[..., None])[..., 0]
        dt = (rest + g1 * dc) / D
        return {"above": _moved(above, dt - dc, mu), "t": _moved(t, dt, mu)}

    return omega, force, recover


def _terminal(
    sub: Subproblem, state: _State, mu: float
) -> tuple[Array, Array, Callable[[PrimalDual], tuple[Array, dict[str, _Pair]]]]:
    """Softness δ and side s of the terminal rows, (q,), for the slacks and the box."""
    plus, minus, high, low = state.pairs.plus, state.pairs.minus, state.pairs.high, state.pairs.low
    nu, w, boxed = state.point.terminal, state.w, sub.tolerance > 0.0
    soft = plus.s / plus.z + minus.s / minus.z
    side = -sub.g + mu / plus.z - mu / minus.z - soft * nu
    inverse, lean = np.zeros_like(w), np.zeros_like(w)
    if boxed:
        inverse = 1.0 / (high.z / high.s + low.z / low.s)
        lean = (mu / low.s - mu / high.s) * inverse
        soft, side = soft + inverse, side + w + lean

    def recover(target: PrimalDual) -> tuple[Array, dict[str, _Pair]]:
        dnu, dw = target.terminal - nu, target.terminal * inverse + lean
        ds_plus = (mu + plus.s * dnu) / plus.z - plus.s
        ds_minus = (mu - minus.s * dnu) / minus.z - minus.s
        # The larger slack follows from the condition itself: its multiplier ρ ∓ ν is a small
        # difference, and dividing by it would lose all digits.
        residual = sub.G @ target.d[-1] + sub.g - w - dw
        above = plus.s >= minus.s
        ds_plus, ds_minus = (
            np.where(above, residual + minus.s + ds_minus - plus.s, ds_plus),
            np.where(above, ds_minus, plus.s + ds_plus - residual - minus.s),
        )
        dz_plus = np.where(above, (mu - plus.z * ds_plus) / plus.s - plus.z, -dnu)
        dz_minus = np.where(above, dnu, (mu - minus.z * ds_minus) / minus.s - minus.z)
        return dw, {
            "plus": _Pair(ds_plus, dz_plus),
            "minus": _Pair(ds_minus, dz_minus),
            "high": _moved(high, -dw, mu),
            "low": _moved(low, dw, mu),
        }

    return soft, side, recover

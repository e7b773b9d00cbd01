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

import numpy as np

from slipcar.planner.convex.convexify import Subproblem
from slipcar.planner.lq.banded import BandedKkt, Point

Array = np.ndarray

_MAX_STEPS = 100
_GAP = 1e-9
#: What is good enough to be polished when so many steps have brought nothing better.
_ENOUGH, _IDLE = 1e-6, 8


@dataclasses.dataclass
class _Pairs:
    """Slacks and multipliers of every inequality.

    Bounds on e are (K, m), hinges (K, p), balls (K,), the rest (q,).
    """

    lower: Array
    z_lower: Array
    upper: Array
    z_upper: Array
    above: Array  # t − c
    z_above: Array
    t: Array
    z_t: Array
    plus: Array  # terminal slack s⁺, its multiplier ρ − ν
    z_plus: Array
    minus: Array
    z_minus: Array
    high: Array  # τ − w
    z_high: Array
    low: Array  # τ + w
    z_low: Array
    ball: Array  # (K,), or (0,) where there are no balls
    z_ball: Array

    def couples(self) -> list[tuple[Array, Array]]:
        f = [getattr(self, field.name) for field in dataclasses.fields(self)]
        return list(zip(f[::2], f[1::2], strict=True))

    def gap(self) -> float:
        """Mean of s z over the finite inequalities."""
        joined = np.concatenate([s[i := np.isfinite(s)] * z[i] for s, z in self.couples()])
        return float(joined.mean()) if joined.size else 0.0

    def moved(self, change: _Pairs, step: float) -> _Pairs:
        ours = [getattr(self, f.name) for f in dataclasses.fields(self)]
        theirs = [getattr(change, f.name) for f in dataclasses.fields(self)]
        return _Pairs(*(a + step * b for a, b in zip(ours, theirs, strict=True)))


def interior_point(sub: Subproblem, kkt: BandedKkt) -> tuple[Point | None, Array, int]:
    """Solve the sub-problem loaded in `kkt`.

    Returns:
        The point (None if it fails), multipliers of the balls (K,) or (0,), LQ solves.
    """
    K, n = sub.f.shape
    q, boxed, balls = len(sub.g), sub.tolerance > 0.0, sub.radius < np.inf
    # A strictly feasible start: controls inside their bounds, states by the dynamics.
    e = _inside(sub.lower, sub.upper)
    if balls:
        u = e - sub.center
        within = 0.5 * sub.radius / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300)
        shrunk = np.minimum(within, 1.0) * u + sub.center
        e = shrunk if ((sub.lower < shrunk) & (shrunk < sub.upper)).all() else e
    d = sub.response(e)
    point = Point(d, e, np.zeros((K, n)), np.zeros(q))
    c = np.matmul(sub.a, d[..., None])[..., 0] + sub.b
    residual = sub.G @ d[-1] + sub.g
    t = np.maximum(c, 0.0) + 1.0
    size = 1.0 + np.abs(residual)
    infinite, none = np.full(q, np.inf), np.zeros(q)
    box = np.full(q, sub.tolerance) if boxed else infinite
    lower, upper = e - sub.lower, sub.upper - e
    with np.errstate(invalid="ignore"):
        pairs = _Pairs(
            lower=lower,
            z_lower=np.where(np.isfinite(lower), 1.0, 0.0),
            upper=upper,
            z_upper=np.where(np.isfinite(upper), 1.0, 0.0),
            above=t - c,
            z_above=0.5 * sub.h * t + 1e-6,
            t=t,
            z_t=0.5 * sub.h * t + 1e-6,
            plus=np.maximum(residual, 0.0) + size,
            z_plus=np.full(q, sub.rho),
            minus=np.maximum(-residual, 0.0) + size,
            z_minus=np.full(q, sub.rho),
            high=box,
            z_high=np.ones(q) if boxed else none,
            low=box,
            z_low=np.ones(q) if boxed else none,
            ball=np.maximum(-_passed(sub, e), 0.1 * sub.radius) if balls else np.zeros(0),
            z_ball=np.ones(K if balls else 0),
        )
    w, sigma = np.zeros(q), 0.5
    best = (np.inf, 0, point, pairs.z_ball)
    scale = max(1.0, float(np.max(np.abs(sub.r))), sub.rho * 1e-3)
    for steps in range(1, _MAX_STEPS + 1):
        found = _direction(sub, kkt, point, pairs, w, sigma * pairs.gap())
        if found is None:
            break
        target, change, dw = found
        step = min(1.0, 0.99 * _longest(pairs, change))
        sigma = min(0.5, max(0.02, (1.0 - step) ** 2))
        point = point.towards(target, step)
        pairs = pairs.moved(change, step)
        w = w + step * dw
        missing = np.abs(sub.G @ point.d[-1] + sub.g - w - pairs.plus + pairs.minus) / size
        size_of_cost = max(scale, abs(sub.objective(point.d, point.e)))
        if balls:
            off = np.abs(pairs.ball + _passed(sub, point.e)) / sub.radius
            missing = np.concatenate([missing, off])
        off_by = max(pairs.gap() / size_of_cost, float(np.max(missing, initial=0.0)))
        if off_by < _GAP:
            return point, pairs.z_ball, steps
        if off_by < 0.5 * best[0]:
            best = (off_by, steps, point, pairs.z_ball)
        elif best[0] < _ENOUGH and steps > best[1] + _IDLE:
            break  # rounding errors have taken over
    return (best[2] if best[0] < _ENOUGH else None), best[3], steps


def _inside(lower: Array, upper: Array) -> Array:
    """Zero where it lies well inside the bounds, else a tenth of the way in."""
    width = np.where(np.isfinite(upper - lower), 0.1 * (upper - lower), 1.0)
    return np.clip(0.0, lower + width, upper - width)


def _passed(sub: Subproblem, e: Array) -> Array:
    """(‖u‖² − r²)/(2r) ≤ 0 for the balls, (K,)."""
    u = e - sub.center
    return 0.5 * (np.sum(u * u, axis=1) / sub.radius - sub.radius)


def _longest(pairs: _Pairs, change: _Pairs) -> float:
    """Longest step in [0, 1] that keeps every slack and multiplier non-negative."""
    step = 1.0
    for (s, z), (ds, dz) in zip(pairs.couples(), change.couples(), strict=True):
        for value, delta in ((s, ds), (z, dz)):
            shrinking = delta < 0.0
            if shrinking.any():
                step = min(step, float(np.min(value[shrinking] / -delta[shrinking])))
    return step


def _direction(
    sub: Subproblem, kkt: BandedKkt, point: Point, pairs: _Pairs, w: Array, mu: float
) -> tuple[Point, _Pairs, Array] | None:
    """Newton's target for s z = μ, the change of slacks and multipliers, and of the box's w."""
    p = pairs
    # Bounds.
    over_l, over_u = p.z_lower / p.lower, p.z_upper / p.upper
    push = mu / p.upper - mu / p.lower - (over_l + over_u) * point.e
    # Hinges: the force on their row is force + omega Δc once Δt is eliminated.
    g1, g2 = p.z_above / p.above, p.z_t / p.t
    D = sub.h + g1 + g2
    rest = mu / p.above + mu / p.t - sub.h * p.t
    omega = g1 * (sub.h + g2) / D
    c = p.t - p.above
    force = mu / p.above - g1 * rest / D - omega * (c - sub.b)
    # Terminal slacks and the box.
    soft = p.plus / p.z_plus + p.minus / p.z_minus
    right = -sub.g + mu / p.z_plus - mu / p.z_minus - soft * point.terminal
    if sub.tolerance > 0.0:
        W = p.z_high / p.high + p.z_low / p.low
        lean = (mu / p.low - mu / p.high) / W
        soft, right = soft + 1.0 / W, right + w + lean
    held = np.ones(len(sub.g), dtype=bool)
    block = (over_l + over_u)[..., None] * np.eye(push.shape[1])
    ray, balls = None, len(p.ball) > 0
    if balls:
        u = point.e - sub.center
        turn, over_b = u / sub.radius, p.z_ball / p.ball
        off = p.ball + _passed(sub, point.e)
        ray = turn, over_b, np.sum(turn * point.e, axis=1) - off
        curvature = p.z_ball / sub.radius
        block = block + curvature[:, None, None] * np.eye(push.shape[1])
        push = push + (mu / p.ball)[:, None] * turn - curvature[:, None] * point.e
    target = kkt.solve(omega, force, held, -soft, right, (block, push), ray)
    if target is None:
        return None
    de = target.e - point.e
    dc = np.matmul(sub.a, (target.d - point.d)[..., None])[..., 0]
    dt = (rest + g1 * dc) / D
    dnu = target.terminal - point.terminal
    dw = target.terminal / W + lean if sub.tolerance > 0.0 else np.zeros_like(w)
    dplus = (mu + p.plus * dnu) / p.z_plus - p.plus
    dminus = (mu - p.minus * dnu) / p.z_minus - p.minus
    # The larger slack follows from the condition itself: its multiplier ρ ∓ ν is a small
    # difference, and dividing by it would lose all digits.
    residual = sub.G @ target.d[-1] + sub.g - w - dw
    above = p.plus >= p.minus
    dplus, dminus = (
        np.where(above, residual + p.minus + dminus - p.plus, dplus),
        np.where(above, dminus, p.plus + dplus - residual - p.minus),
    )
    dball = -off - np.sum(turn * de, axis=1) if balls else p.ball
    change = _Pairs(
        lower=np.where(np.isfinite(p.lower), de, 0.0),
        z_lower=mu / p.lower - over_l * de - p.z_lower,
        upper=np.where(np.isfinite(p.upper), -de, 0.0),
        z_upper=mu / p.upper + over_u * de - p.z_upper,
        above=dt - dc,
        z_above=mu / p.above - g1 * (dt - dc) - p.z_above,
        t=dt,
        z_t=mu / p.t - g2 * dt - p.z_t,
        plus=dplus,
        z_plus=np.where(above, (mu - p.z_plus * dplus) / p.plus - p.z_plus, -dnu),
        minus=dminus,
        z_minus=np.where(above, dnu, (mu - p.z_minus * dminus) / p.minus - p.z_minus),
        high=np.where(np.isfinite(p.high), -dw, 0.0),
        z_high=mu / p.high + p.z_high / p.high * dw - p.z_high,
        low=np.where(np.isfinite(p.low), dw, 0.0),
        z_low=mu / p.low - p.z_low / p.low * dw - p.z_low,
        ball=dball,
        z_ball=mu / p.ball - over_b * dball - p.z_ball if balls else p.z_ball,
    )
    return target, change, dw

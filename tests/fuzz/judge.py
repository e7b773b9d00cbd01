"""What a plan claims, checked from the problem's functions with NumPy, by no code of the planner.

Every check returns findings, as sentences; an empty list is a clean bill.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray

#: Relative misses that count as none: of a step, of a sum of costs, of the end, of a bound.
STEP, SUM, END, BOUND = 1e-4, 1e-6, 1e-4, 1e-9
#: Rounding, relative to what a state is put together from.
ROUNDING = 1e-9
#: What is less is nothing; and a part of a state that is hardly any.
TINY, LEAST = 1e-100, 1e-4


def findings(problem: Any, plan: Any) -> list[str]:
    """All that is wrong with a plan of a problem, whatever its status."""
    with np.errstate(all="ignore"):
        found = _anyway(problem, plan)
        if plan.status.ok and not found:
            found += _dynamics(problem, plan) + _end(problem, plan) + _moments(plan)
            if plan.options["variance_weight"] == 0.0 or not plan.covariance.any():
                found += _stationary(problem, plan)
        return found


def stepped(problem: Any, integrator: str, t: Array, dt: Array, x: Array, u: Array) -> Array:
    """x⁺ by Euler's step, or the classical Runge–Kutta one; batched."""
    h, b = dt[..., None], problem.drift
    k1 = b(t, x, u)
    if integrator == "euler":
        return x + h * k1
    k2 = b(t + dt / 2, x + h / 2 * k1, u)
    k3 = b(t + dt / 2, x + h / 2 * k2, u)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + b(t + dt, x + h * k3, u))


def rolled(problem: Any, integrator: str, times: Array, u: Array) -> Array:
    """States (N, n) that controls (K, m) lead to."""
    path, dt = [np.array(problem.start, float)], np.diff(times)
    for k, control in enumerate(u):
        path.append(stepped(problem, integrator, times[k], dt[k], path[-1], control))
    return np.array(path)


# --------------------------------------------------------------------------- whatever the status


def _anyway(problem: Any, p: Any) -> list[str]:
    """Finite, starting where it shall, within bounds, with costs that add up, and words."""
    found = [f"{name} is not finite" for name in ("mean", "controls") if not _is_finite(p, name)]
    if found:
        return found
    if not p.status.ok and not p.message:
        found.append(f"{p.status.name} without a message")
    if "nan" in p.message.lower().split() and "not finite" not in p.message:
        found.append(f"a message with nan: {p.message}")
    if not (np.abs(p.mean[0] - problem.start) <= 1e-12 * np.abs(p.mean).max(axis=0) + 1e-300).all():
        found.append("the mean does not start at the start")
    found += outside(problem, p.controls)
    if p.status.name != "SOLVER_FAILED":
        names = ("effort", "obstacle_cost", "running_cost")
        names += ("covariance", "variance") if p.status.ok else ()
        found += [f"{name} is not finite" for name in names if not _is_finite(p, name)]
        found += _costs(problem, p)
    return found


def _is_finite(p: Any, name: str) -> bool:
    return bool(np.isfinite(getattr(p, name)).all())


def outside(problem: Any, u: Array, part: float = BOUND) -> list[str]:
    """Controls (K, m) beyond their bounds by more than a part of them."""
    found, bounds = [], getattr(problem, "control_bounds", None)
    if bounds is not None:
        bounds = np.asarray(bounds, float)
        lower, upper = (-bounds, bounds) if bounds.ndim == 1 else bounds
        size = np.max(np.where(np.isfinite([lower, upper]), np.abs([lower, upper]), 0.0), axis=0)
        out = np.max(np.maximum(lower - u, u - upper), axis=0)
        if (out > part * size).any():
            found.append(f"controls are outside their bounds by {np.max(out / size):.2g} of them")
    radius = getattr(problem, "control_radius", None)
    if radius is not None and np.linalg.norm(u, axis=1).max() > (1.0 + part) * radius:
        found.append("controls are outside their ball")
    return found


def _costs(problem: Any, p: Any) -> list[str]:
    """What the sums say, as far as rounding of states leaves them certain (no sine of 1e90)."""
    here, near = (_terms(problem, p, p.mean * part) for part in (1.0, 1.0 + 1e-13))
    return [
        f"{name} is {getattr(p, name):.9g}, but its terms add up to {terms.sum():.9g}"
        for name, terms in here.items()
        if not abs(getattr(p, name) - terms.sum())
        <= SUM * np.abs(terms).sum() + 10.0 * abs(near[name].sum() - terms.sum())
    ]


def _terms(problem: Any, p: Any, x: Array) -> dict[str, Array]:
    """The sums of docs/planner.md: controls at the beginning of intervals, states at their end."""
    t, dt, u = p.times, np.diff(p.times), p.controls
    effort = np.einsum("k,ki,ij,kj->k", dt, u, problem.control_weight, u)
    parts = {"effort": effort, "obstacle_cost": np.zeros(1), "running_cost": np.zeros(1)}
    if getattr(problem, "penalty", None) is not None:
        hinge = np.maximum(problem.penalty(t[1:], x[1:]), 0.0)
        parts["obstacle_cost"] = dt[:, None] * problem.penalty_weight * hinge**2
    running = []
    if getattr(problem, "state_cost", None) is not None:
        running.append(dt * problem.state_cost(t[1:], x[1:]))
    if getattr(problem, "control_cost", None) is not None:
        running.append(np.ravel(dt[:, None] * problem.control_cost(t[:-1], x[:-1]) * u))
    if running:
        parts["running_cost"] = np.concatenate(running)
    return parts


# --------------------------------------------------------------------------- converged plans


def _dynamics(problem: Any, p: Any) -> list[str]:
    """Steps one by one; and rolled out, where rounding errors do not grow too much on the way."""
    found, x, u, how = [], p.mean, p.controls, p.options["integrator"]
    t, dt = p.times, np.diff(p.times)
    miss = stepped(problem, how, t[:-1], dt, x[:-1], u) - x[1:]
    size = TINY + np.abs(x).max(axis=0)
    size += np.abs(dt[:, None] * problem.drift(t[:-1], x[:-1], u)).max(axis=0)
    if not (np.abs(miss) <= STEP * size).all():
        found.append(f"the mean misses its own steps by {np.max(np.abs(miss) / size):.2g}")
    alone = rolled(problem, how, t, u)
    shaken = rolled(problem, how, t, u * (1.0 + 1e-9 * np.resize([1.0, -1.0, 1.0], u.shape)))
    grown = np.max(np.abs(shaken - alone) / size)
    off = np.max(np.abs(alone - x) / size)
    if grown < 1e-7 and not off <= 2e-3 + 1e3 * grown:
        found.append(f"rolled out, the controls leave the mean by {off:.2g} of it")
    return found


def _end(problem: Any, p: Any) -> list[str]:
    """|g(x(T))| beyond its box, relative to how far it moves when the states do."""
    if p.options["terminal_weight"] is not None or _soft(problem, p):
        return []
    x = p.mean
    terms = np.abs(x).max(axis=0) + np.abs(p.B).max(0) @ np.abs(p.controls).max(0)
    sizes = np.ptp(x, axis=0) + ROUNDING * terms
    G = _slopes(problem.terminal, x[-1], np.abs(x).max(axis=0) + sizes)
    beyond = np.maximum(np.abs(problem.terminal(x[-1])) - p.options["terminal_tolerance"], 0.0)
    unit = np.abs(G) @ sizes + ROUNDING * np.abs(G) @ terms
    bad = ~(beyond <= END * unit + TINY)
    return [
        f"CONVERGED, but g[{j}] = {beyond[j]:.2g} where it moves by {unit[j]:.2g}"
        for j in np.flatnonzero(bad)
    ]


def _soft(problem: Any, p: Any) -> bool:
    return bool(p.options["feedback"] and getattr(problem, "terminal_weight", None) is not None)


def _moments(p: Any) -> list[str]:
    """Covariances are symmetric and positive semidefinite, risks are probabilities."""
    found, S = [], p.covariance
    size = np.sqrt(np.einsum("kii->ki", S).max(axis=0, initial=0.0).clip(0.0)) + 1e-150
    unit = S / np.outer(size, size)
    if not np.allclose(unit, np.swapaxes(unit, 1, 2), atol=1e-9):
        found.append("covariance is not symmetric")
    elif np.linalg.eigvalsh(unit).min() < -1e-8:
        found.append(f"covariance has the eigenvalue {np.linalg.eigvalsh(unit).min():.2g}")
    if p.expected is not None and not np.isfinite(p.expected.total):
        found.append("the expected cost is not finite")
    return found


def _stationary(problem: Any, p: Any) -> list[str]:
    """No direction within the bounds lowers the cost to first order and keeps the end.

    The gradient of the reduced cost, by an adjoint recursion of Euler steps whose derivatives are
    differences. Plans of the mean alone, by Euler's steps, in a box.
    """
    if p.expected is not None or p.options["integrator"] != "euler" or _ball(problem):
        return []
    if p.options["terminal_tolerance"] > 0.0:
        return []
    x, u, t, dt = p.mean, p.controls, p.times, np.diff(p.times)
    X, later = np.abs(x).max(axis=0) + TINY, t[1:]
    A = dt[:, None, None] * _slopes(lambda y: problem.drift(t[:-1], y, u), x[:-1], X)
    B = _pushes(problem, t, dt, x, u)
    # A control is of its own size, but at least of what moves a state by a part of it.
    U = np.abs(u).max(axis=0) + LEAST * np.min(X[:, None] / (np.abs(B).max(axis=0) + TINY), axis=0)
    H = _slopes(lambda y: _charged(problem, later, y)[..., None], x[1:], X)[:, 0] * dt[:, None]
    L = np.zeros_like(x[:-1])
    gradient = 2.0 * dt[:, None] * u @ problem.control_weight
    if getattr(problem, "control_cost", None) is not None:
        gradient = gradient + dt[:, None] * problem.control_cost(t[:-1], x[:-1])
        ell = _slopes(lambda y: problem.control_cost(t[:-1], y), x[:-1], X)
        L = dt[:, None] * np.einsum("kji,kj->ki", ell, u)
    G = _slopes(problem.terminal, x[-1], X)
    adjoint = np.concatenate([H[-1][:, None], G.T], axis=1)  # of the cost, and of each end
    whole = np.empty((len(u), u.shape[1], 1 + len(G)))
    for k in range(len(u) - 1, -1, -1):
        whole[k] = np.einsum("ij,iq->jq", B[k], adjoint)
        whole[k, :, 0] += gradient[k]
        adjoint = adjoint + A[k].T @ adjoint
        adjoint[:, 0] += L[k] + (H[k - 1] if k else 0.0)
    costs = abs(p.effort) + abs(p.obstacle_cost) + abs(p.running_cost)
    effort = 2.0 * dt.max() * np.abs(problem.control_weight) @ U
    terms, own = np.abs(gradient).max(axis=0) + effort, -p.multipliers.terminal
    return _gained(problem, u, whole, terms, U, costs, own)


def _pushes(problem: Any, t: Array, dt: Array, x: Array, u: Array) -> Array:
    """dt ∂b/∂u, (K, n, m), exactly: b is affine in u, so two points tell it all."""
    zero = np.zeros_like(u)
    rest = problem.drift(t[:-1], x[:-1], zero)
    scale = np.abs(u).max(axis=0) + TINY
    columns = []
    for j in range(u.shape[1]):
        there = zero.copy()
        there[:, j] = scale[j]
        columns.append((problem.drift(t[:-1], x[:-1], there) - rest) / scale[j])
    return dt[:, None, None] * np.stack(columns, axis=-1)


def _charged(problem: Any, t: Array, x: Array) -> Array:
    """H + Σ w max(0, c)², (...,)."""
    rate = np.zeros(x.shape[:-1])
    if getattr(problem, "state_cost", None) is not None:
        rate = rate + problem.state_cost(t, x)
    if getattr(problem, "penalty", None) is not None:
        rate = rate + np.maximum(problem.penalty(t, x), 0.0) ** 2 @ problem.penalty_weight
    return rate


def _gained(
    problem: Any, u: Array, whole: Array, terms: Array, U: Array, costs: float, own: Array
) -> list[str]:
    """What controls gain to first order, each moved by its size whither its bounds let it.

    Parts of the largest term of the gradient, or of the cost if that is less; with the plan's own
    multipliers of the end or those of least squares, for any prove an extremal.
    """
    lower, upper = np.broadcast_to(_box(problem, u.shape[1]), (2, u.shape[1]))
    down, up = ((u > lower + 1e-6 * U).ravel(), (u < upper - 1e-6 * U).ravel())
    scaled = (whole * U[:, None]).reshape(u.size, -1)
    if not np.isfinite(scaled).all():
        return []
    ends = scaled[:, 1:] / (column := np.linalg.norm(scaled[:, 1:], axis=0) + 1e-300)
    fitted = np.linalg.lstsq(ends[down & up], -scaled[down & up, 0], rcond=None)[0]
    worst = np.inf
    for nu in (own * column, fitted):
        slope = scaled[:, 0] + ends @ nu
        gain = np.where(slope > 0.0, slope * down, -slope * up)
        size = np.abs(scaled[:, 0]).max() + np.max(terms * U) + np.abs(ends * nu).max(initial=0.0)
        size += TINY
        worst = min(worst, gain.max() / size, gain.sum() / (costs + TINY))
    if worst <= 0.03:
        return []
    return [f"no extremal: controls gain {worst:.2g} of the reduced gradient's terms"]


def _ball(problem: Any) -> bool:
    return getattr(problem, "control_radius", None) is not None


def _box(problem: Any, m: int) -> Array:
    bounds = getattr(problem, "control_bounds", None)
    if bounds is None:
        return np.array([np.full(m, -np.inf), np.full(m, np.inf)])
    bounds = np.asarray(bounds, float)
    return np.array([-bounds, bounds]) if bounds.ndim == 1 else bounds


def _slopes(f: Any, x: Array, size: Array) -> Array:
    """∂f/∂x (..., ·, n) by central differences, each state by a part of its size."""
    columns = []
    for j in range(x.shape[-1]):
        h = np.zeros(x.shape[-1])
        h[j] = max(1e-5 * size[j], TINY)
        columns.append((f(x + h) - f(x - h)) / (2.0 * h[j]))
    return np.stack(columns, axis=-1)

"""What the method assumes of a problem's functions, checked on points near the guess.

* shapes: every function answers (K, ...) for K points;
* b affine in u (paper §2): second differences in u vanish;
* σ depends on no uncertain state (paper §6.1, "z"), where the variance is charged: a state is
  uncertain if its start is, if its row of σ is not zero, or if its drift depends on an uncertain
  one. The adjoint weights of the penalty leave out how σ then spreads with Σ; covariances and
  expected costs do not (:mod:`.moments`, :mod:`.expected.belief`), and need no such thing;
* on request, every Jacobian against differences: this finds wrong ones among those given.

Points are the guess and seeded random ones around it; those where the functions are not finite
are passed over here (along the guess itself they are an error later on).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.problem.answers import answers
from slipcar.planner.problem.jacobians import Jacobians, differences, richardson
from slipcar.planner.problem.model import Model

Array = np.ndarray

_POINTS = 16
#: Relative to the size of the function: what counts as an exact zero of ∂b/∂x, of ∂σ/∂x, of a
#: second difference in u; and how near a Jacobian must come to its differences.
_PATTERN, _SIGMA, _AFFINE, _JACOBIAN = 1e-12, 1e-9, 1e-7, 1e-5
#: Steps of controls that second differences are taken over, in parts of 1 + |u|: their unit is the
#: user's, and a parabola is straight where it is looked at too closely.
_STEPS = (1.0, 1e-3, 1e-6, 1e3, 1e6)
_quiet = np.errstate(over="ignore", invalid="ignore", divide="ignore")


@dataclasses.dataclass(frozen=True)
class Facts:
    """What the structure of traced functions rules out, whatever their numbers.

    Attributes:
        affine: whether the drift is affine in the control.
        depends: whether entry i of the drift can depend on state j, (n, n).
        noisy: whether noise can reach a state directly, (n,).
        sigma_depends: whether the diffusion can depend on a state, (n,).
    """

    affine: bool
    depends: Array
    noisy: Array
    sigma_depends: Array

    def settle(self, start_covariance: Array) -> bool:
        """Whether nothing is left to be looked at: affine, and no noise in what σ depends on."""
        return self._calm if not start_covariance.any() else self._settled(start_covariance)

    @functools.cached_property
    def _calm(self) -> bool:
        """The same from a known start."""
        return self._settled(np.zeros((len(self.noisy), len(self.noisy))))

    def _settled(self, start_covariance: Array) -> bool:
        uncertain = self.noisy | (np.diag(start_covariance) > 0.0)
        for _ in range(len(uncertain)):
            grown = uncertain | (self.depends & uncertain).any(axis=1)
            if (grown == uncertain).all():
                break
            uncertain = grown
        return self.affine and not (uncertain & self.sigma_depends).any()


def check(model: Model, x: Array, u: Array, facts: Facts | None, *, charged: bool) -> None:
    """What the method assumes, by the functions' structure or, where that leaves doubt, at points.

    Args:
        model: the problem.
        x: states of the guess, (N, n).
        u: its controls, (N−1, m).
        facts: of a trace that was looked at before; None looks at points.
        charged: whether `variance_weight` is to charge the noise.

    Raises:
        ValueError: naming the function, the entry and what is assumed of it.
    """
    if facts is not None and facts.settle(model.start_covariance):
        return
    flaw = check_assumptions(model, x, u)
    if charged and flaw:
        raise ValueError(
            f"{flaw}. variance_weight (1 unless told otherwise) charges the noise with σ at the "
            f"mean, which holds only if σ depends on states that stay deterministic (paper §6.1). "
            f"Plan with expected=True, feedback=True or risk=..., whose covariance counts what "
            f"noisy states do to σ, or with variance_weight=0"
        )


@_quiet
def check_assumptions(model: Model, x: Array, u: Array) -> str:
    """Shapes and affine controls, near states x (N, n) and controls u.

    Returns:
        Which entry of the diffusion depends on which uncertain state, and why it is one; empty
        if none does, as in the paper.

    Raises:
        ValueError: naming the function, the entry and what is assumed of it.
    """
    t, y, v = _points(model, x, u)
    given = answers(model.problem, t, y, v)
    _check_affine(model, t, y, v)
    A, _ = model.drift_jacobian(t, y, v)
    return _uncertain_diffusion(
        model, y, np.asarray(A), given["diffusion"], model.diffusion_jacobian(t, y)
    )


def _points(model: Model, x: Array, u: Array) -> tuple[Array, Array, Array]:
    """A few nodes of the guess, and random points around them: times, states, controls."""
    K, half = len(u), _POINTS // 2
    rng = np.random.default_rng(0)
    k = np.linspace(0, K - 1, half).astype(int)
    spread_x = 0.1 * (1.0 + np.abs(x[:-1]).max(axis=0))
    spread_u = 0.1 * (1.0 + np.abs(u).max(axis=0))
    y = np.concatenate([x[k], x[k] + spread_x * rng.normal(size=(half, x.shape[1]))])
    v = np.concatenate([u[k], u[k] + spread_u * rng.normal(size=(half, u.shape[1]))])
    return np.tile(model.times[k], 2), y, model.admissible(v)


def _check_affine(model: Model, t: Array, x: Array, u: Array) -> None:
    """Second differences of the drift, over steps of many sizes that stay within U."""
    rng = np.random.default_rng(1)
    for size in _STEPS:
        step = size * (1.0 + np.abs(u)) * rng.uniform(-1.0, 1.0, u.shape)
        ends = model.admissible(u + step), model.admissible(u - step)
        middle = 0.5 * (ends[0] + ends[1])
        ahead, b, behind = (np.asarray(model.drift(t, x, v)) for v in (ends[0], middle, ends[1]))
        bend = np.abs(ahead - 2.0 * b + behind)
        total = np.abs(ahead) + np.abs(b) + np.abs(behind)
        bent = bend > _AFFINE * (total + total.max(axis=1, keepdims=True)) + 1e-300
        if bent.any():
            point, i = (int(j) for j in np.argwhere(bent)[0])
            raise ValueError(
                f"drift must be affine in the control (paper §2), but component {i} is not: at "
                f"x = {_show(x[point])} and u = {_show(middle[point])} it bends by "
                f"{bend[point, i]:.3g} over a step of {_show((ends[0] - middle)[point])}; make the "
                f"bent part a state and its rate the control"
            )


def _uncertain_diffusion(model: Model, x: Array, A: Array, sigma: Array, d_sigma: Array) -> str:
    largest = np.nanmax(np.abs(sigma), initial=0.0)
    scale = 1.0 + np.abs(x).max(axis=0)
    moved = (np.abs(d_sigma) * scale > _SIGMA * largest).any(axis=0)  # (n, d, n)
    if largest == 0.0 or not moved.any():
        return ""
    A = np.abs(A) * scale
    negligible = _PATTERN * A.max(axis=(1, 2), keepdims=True)
    depends = (negligible < A).any(axis=0)
    noisy = (sigma != 0.0).any(axis=(0, 2))
    unknown = np.diag(model.start_covariance) > 0.0
    path = {int(i): f"noise → x[{i}]" for i in np.flatnonzero(noisy)}
    path |= {int(i): f"start → x[{i}]" for i in np.flatnonzero(unknown & ~noisy)}
    fresh = list(path)
    while fresh:
        fresh = [
            _reach(path, int(i), j)
            for j in fresh
            for i in np.flatnonzero(depends[:, j])
            if int(i) not in path
        ]
    for j in path:
        entries = np.argwhere(moved[:, :, j])
        if len(entries):
            row, column = (int(i) for i in entries[0])
            return f"diffusion[{row}, {column}] depends on x[{j}], which is uncertain ({path[j]})"
    return ""


def _reach(path: dict[int, str], i: int, by: int) -> int:
    path[i] = f"{path[by]} → x[{i}]"
    return i


@_quiet
def check_given(model: Model, x: Array, u: Array) -> None:
    """Derivatives that the problem gives against those of its traced functions.

    Newton's method takes the latter; the rest of the planner the former.

    Raises:
        ValueError: naming the function, the entry and both values.
    """
    exact = Jacobians(model.problem, model.state_dim, model.control_dim, given=False)
    t, y, v = _points(model, x, u)
    pairs: list[tuple[str, Any, Any]] = []
    both: Any
    if model.jacobians.is_given("drift"):
        both = zip(model.jacobians.drift(t, y, v), exact.drift(t, y, v), strict=True)
        pairs += [(f"drift_jacobian[{i}]", *pair) for i, pair in enumerate(both)]
    for name in ("diffusion", "penalty", "control_cost", "terminal"):
        if model.has(name) and model.jacobians.is_given(name):
            slopes = model.jacobians.state(name, t, y), exact.state(name, t, y)
            pairs.append((f"{name}_jacobian", *slopes))
    if model.jacobians.is_given("state_cost"):
        both = zip(model.jacobians.state_cost(t, y), exact.state_cost(t, y), strict=True)
        pairs += [(f"state_cost_derivatives[{i}]", *pair) for i, pair in enumerate(both)]
    for name, given, traced in pairs:
        _refuse_difference(model, name, np.asarray(given), traced, 0.0 * np.abs(traced), y)


@_quiet
def check_derivatives(model: Model, x: Array, u: Array) -> None:
    """Every Jacobian, given or traced, against central differences.

    Raises:
        ValueError: naming the function, the entry and both values.
    """
    t, y, v = _points(model, x, u)
    slopes, own = model.jacobians, model.problem
    A, B = slopes.drift(t, y, v)
    pairs: list[tuple[str, Any, Callable[[Array], Any], Array]] = [
        ("drift_jacobian[0]", A, lambda z: own.drift(t, z, v), y),
        ("drift_jacobian[1]", B, lambda z: own.drift(t, y, z), v),
    ]
    for name in ("diffusion", "penalty", "control_cost", "terminal"):
        if model.has(name):
            function: Any = getattr(own, name)
            at = (lambda z, f=function: f(z)) if name == "terminal" else (
                lambda z, f=function: f(t, z))  # fmt: skip
            pairs.append((f"{name}_jacobian", slopes.state(name, t, y), at, y))
    if model.has("state_cost"):
        gradient, hessian = slopes.state_cost(t, y)
        label, cost = "state_cost_derivatives", model.state_cost
        pairs += [
            (f"{label}[0]", gradient, lambda z: cost(t, z), y),  # type: ignore[misc]
            (f"{label}[1]", hessian, lambda z: slopes.state_cost(t, z)[0], y),
        ]
    for name, given, function, z in pairs:
        _compare(model, name, np.asarray(given), function, z)


def _compare(model: Model, name: str, given: Array, f: Callable[[Array], Any], x: Array) -> None:
    """Raise where a Jacobian (P, ..., n) is not what differences of f with respect to x are."""
    best, spread = richardson(lambda step: differences(f, x, step))
    allowed = 10.0 * spread + 1e-9 * (1.0 + np.nanmax(np.abs(np.asarray(f(x))), initial=0.0))
    _refuse_difference(model, name, given, best, allowed, x)


def _refuse_difference(
    model: Model, name: str, given: Array, best: Array, allowed: Array, x: Array
) -> None:
    """Raise where two Jacobians (P, ..., n) at points x (P, n) are further apart than allowed."""
    size = np.maximum(np.abs(given), np.abs(best))
    wrong = np.abs(given - best) > allowed + _JACOBIAN * (size + _largest(size))
    if not wrong.any():
        return
    index = tuple(int(i) for i in np.argwhere(wrong)[0])
    own = getattr(model.problem, name.split("[")[0], None) is not None
    source = "your function" if own else "traced"
    advice = "" if own else "; is the function smooth there? otherwise give its derivative"
    raise ValueError(
        f"{name}{list(index[1:])} ({source}) is {given[index]:.9g} at "
        f"{_show(x[index[0]])}, but differences give {best[index]:.9g}{advice}"
    )


def _largest(size: Array) -> Array:
    """Largest entry of each point's Jacobian, shaped to broadcast."""
    axes = tuple(range(1, size.ndim))
    return np.max(np.nan_to_num(size), axis=axes, keepdims=True, initial=0.0)


def _show(values: Array) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in values) + ")"

"""What `plan` solves: the protocol a problem satisfies, and its checked, completed form.

    minimise  E ∫₀ᵀ [ uᵀRu + Σ_i w_i max(0, c_i(t,x))² ] dt
    s.t.      dx = b(t,x,u) dt + σ(t,x) dB,   x(0) = start,   E[g(x(T))] = 0,   lower ≤ u ≤ upper

b is affine in u; σ may depend only on states that the noise never reaches (paper §6.1).
`slipcar.envs.Scenario` satisfies the protocol; the two packages do not know each other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from slipcar.planner.derivatives import complex_step_jacobian

Array = np.ndarray


@runtime_checkable
class Problem(Protocol):
    """A stochastic optimal control problem, as functions batched over leading axes.

    The members below are required. These are used when they are there:

    * `drift_jacobian(t, x, u)` -> ∂b/∂x (..., n, n), ∂b/∂u (..., n, m); complex-step otherwise,
      for which `drift` must be analytic and let complex arrays pass. The same holds for
      `diffusion_jacobian(t, x)` -> (..., n, d, n), `terminal_jacobian(x)` -> (..., q, n) and
      `penalty_jacobian(t, x)` -> (..., p, n).
    * `penalty(t, x)` -> c (..., p) with `penalty_weight` (p,): the cost Σ w max(0, c)².
    * `control_bounds`: None, (m,) for |u| ≤ bound, or (2, m) for lower and upper.
    * `initial_guess()` -> states (N, n), controls (N−1, m); otherwise the uncontrolled path
      (or the start at all times, if that path grows without bound).
    * `angles`: state components of period 2π, so that feedback wraps their errors.
    * `decode_observation(obs)` -> (t, x) and `encode_control(u)` -> action, for controllers
      that act in an environment.

    Attributes:
        start: x(0), (n,).
        times: nodes of the time grid, (N,), increasing, N ≥ 2 [s].
        control_weight: R, (m, m), symmetric positive definite (assumption A₄).
    """

    @property
    def start(self) -> Array: ...  # noqa: D102
    @property
    def times(self) -> Array: ...  # noqa: D102
    @property
    def control_weight(self) -> Array: ...  # noqa: D102

    def drift(self, t: Array, x: Array, u: Array) -> Array:
        """b(t, x, u): times (...,), states (..., n), controls (..., m) -> (..., n)."""
        ...

    def diffusion(self, t: Array, x: Array) -> Array:
        """σ(t, x): (..., n, d) for d Brownian motions."""
        ...

    def terminal(self, x: Array) -> Array:
        """g(x): states (..., n) -> (..., q); E[g(x(T))] = 0."""
        ...


@dataclasses.dataclass(frozen=True)
class Model:
    """A problem, checked and completed: what the planner computes with.

    Attributes:
        problem: the object it was made from.
        start: (n,).
        times: (N,) [s].
        dt: (N−1,) interval lengths [s].
        R: control weight, (m, m).
        lower: lower control bounds, (m,), −inf where unbounded.
        upper: upper control bounds, (m,).
        weight: penalty weights, (p,).
        drift: (t, x, u) -> (..., n).
        drift_jacobian: (t, x, u) -> ((..., n, n), (..., n, m)).
        diffusion: (t, x) -> (..., n, d).
        diffusion_jacobian: (t, x) -> (..., n, d, n).
        penalty: (t, x) -> (..., p).
        penalty_jacobian: (t, x) -> (..., p, n).
        terminal: x -> (..., q).
        terminal_jacobian: x -> (..., q, n).
    """

    problem: Problem
    start: Array
    times: Array
    dt: Array
    R: Array
    lower: Array
    upper: Array
    weight: Array
    drift: Callable[[Array, Array, Array], Array]
    drift_jacobian: Callable[[Array, Array, Array], tuple[Array, Array]]
    diffusion: Callable[[Array, Array], Array]
    diffusion_jacobian: Callable[[Array, Array], Array]
    penalty: Callable[[Array, Array], Array]
    penalty_jacobian: Callable[[Array, Array], Array]
    terminal: Callable[[Array], Array]
    terminal_jacobian: Callable[[Array], Array]

    @property
    def state_dim(self) -> int:
        """Dimension of the state, n."""
        return len(self.start)

    @property
    def control_dim(self) -> int:
        """Dimension of the control, m."""
        return len(self.R)

    @property
    def bounded(self) -> bool:
        """Whether any control bound is finite."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    def guess(self) -> tuple[Array, Array]:
        """The problem's own, else the uncontrolled path, else (it escapes) resting at the start."""
        N, n, m = len(self.times), self.state_dim, self.control_dim
        own = getattr(self.problem, "initial_guess", None)
        if own is not None:
            x, u = own()
        else:
            u = np.clip(np.zeros((N - 1, m)), self.lower, self.upper)
            x = np.empty((N, n))
            x[0] = self.start
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                for k in range(N - 1):
                    x[k + 1] = x[k] + self.dt[k] * self.drift(self.times[k], x[k], u[k])
            if not np.isfinite(x).all():
                x[:] = self.start
        return checked_trajectory(self, x, u)


def checked_trajectory(model: Model, x: Any, u: Any) -> tuple[Array, Array]:
    """States (N, n) starting at `start` and controls (N−1, m) within bounds, as float64.

    Raises:
        ValueError: for a wrong shape or a non-finite entry.
    """
    N = len(model.times)
    x = _finite("guess: states", x, (N, model.state_dim)).copy()
    u = _finite("guess: controls", u, (N - 1, model.control_dim))
    x[0] = model.start
    return x, np.clip(u, model.lower, model.upper)


def model_of(problem: Problem) -> Model:
    """Check a problem at the boundary and complete it with complex-step Jacobians.

    Raises:
        TypeError: if a required member is missing, naming it.
        ValueError: if a shape, value or function result is wrong, naming it.
    """
    required = ("start", "times", "control_weight", "drift", "diffusion", "terminal")
    missing = [name for name in required if not hasattr(problem, name)]
    if getattr(problem, "penalty", None) is not None and not hasattr(problem, "penalty_weight"):
        missing.append("penalty_weight (needed with penalty)")
    if missing:
        raise TypeError(
            f"{type(problem).__name__} is not a slipcar.planner.Problem: it lacks {missing}"
        )
    start = _finite("start", problem.start, (None,))
    times = _finite("times", problem.times, (None,))
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise ValueError(f"times must be at least 2 increasing nodes, not {times!r}")
    R = _finite("control_weight", problem.control_weight, (None, None))
    if R.shape[0] != R.shape[1] or not np.allclose(R, R.T) or np.linalg.eigvalsh(R)[0] <= 0:
        raise ValueError(f"control_weight must be symmetric positive definite, not {R!r}")
    lower, upper = control_limits(getattr(problem, "control_bounds", None), len(R))
    n, m = len(start), len(R)

    t2, x2, u2 = times[:2], np.stack([start, start]), np.zeros((2, m))
    _finite("drift(t, x, u) at the start", problem.drift(t2, x2, u2), (2, n))
    d = _finite("diffusion(t, x) at the start", problem.diffusion(t2, x2), (2, n, None)).shape[2]
    q = _finite("terminal(x) at the start", problem.terminal(x2), (2, None)).shape[1]
    penalty = getattr(problem, "penalty", None)
    if penalty is None:
        weight = np.zeros(0)
        penalty = _no_penalty
        penalty_jacobian: Any = _no_penalty_jacobian
    else:
        p = _finite("penalty(t, x) at the start", penalty(t2, x2), (2, None)).shape[1]
        weight = _finite("penalty_weight", problem.penalty_weight, (p,))  # type: ignore[attr-defined]
        if (weight < 0).any():
            raise ValueError(f"penalty_weight must be >= 0, not {weight!r}")
        penalty_jacobian = getattr(problem, "penalty_jacobian", None)
        if penalty_jacobian is None:
            penalty_jacobian = _state_jacobian(penalty)
        _finite("penalty_jacobian(t, x)", penalty_jacobian(t2, x2), (2, p, n))

    drift_jacobian = getattr(problem, "drift_jacobian", None) or _drift_jacobian(problem.drift)
    A, B = drift_jacobian(t2, x2, u2)
    _finite("drift_jacobian(t, x, u)[0]", A, (2, n, n))
    _finite("drift_jacobian(t, x, u)[1]", B, (2, n, m))
    diffusion_jacobian = getattr(problem, "diffusion_jacobian", None)
    diffusion_jacobian = diffusion_jacobian or _state_jacobian(problem.diffusion)
    _finite("diffusion_jacobian(t, x)", diffusion_jacobian(t2, x2), (2, n, d, n))
    terminal_jacobian = getattr(problem, "terminal_jacobian", None)
    if terminal_jacobian is None:

        def terminal_jacobian(x: Array) -> Array:
            return complex_step_jacobian(problem.terminal, x)

    _finite("terminal_jacobian(x)", terminal_jacobian(x2), (2, q, n))
    return Model(
        problem=problem,
        start=start,
        times=times,
        dt=np.diff(times),
        R=R,
        lower=lower,
        upper=upper,
        weight=weight,
        drift=problem.drift,
        drift_jacobian=drift_jacobian,
        diffusion=problem.diffusion,
        diffusion_jacobian=diffusion_jacobian,
        penalty=penalty,
        penalty_jacobian=penalty_jacobian,
        terminal=problem.terminal,
        terminal_jacobian=terminal_jacobian,
    )


def _finite(name: str, value: Any, shape: tuple[int | None, ...]) -> Array:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers, not {value!r}") from error
    if array.ndim != len(shape) or any(
        want is not None and got != want for got, want in zip(array.shape, shape, strict=True)
    ):
        wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
        raise ValueError(f"{name} must have shape {wanted}, not {array.shape}")
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}{list(index)} must be finite, not {array[index]}")
    return array


def control_limits(given: Any, m: int) -> tuple[Array, Array]:
    """Lower and upper bounds, each (m,), from what `Problem.control_bounds` may be.

    Raises:
        ValueError: for another shape, NaN, or lower ≥ upper.
    """
    if given is None:
        return np.full(m, -np.inf), np.full(m, np.inf)
    try:
        bounds = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        bounds = np.full(0, np.nan)
    if bounds.shape == (m,):
        bounds = np.stack([-bounds, bounds])
    if bounds.shape != (2, m) or np.isnan(bounds).any() or not (bounds[0] < bounds[1]).all():
        raise ValueError(
            f"control_bounds must be None, ({m},) positive bounds on |u|, or (2, {m}) lower < "
            f"upper, not {given!r}"
        )
    return bounds[0], bounds[1]


def _no_penalty(t: Array, x: Array) -> Array:
    return np.zeros((*x.shape[:-1], 0))


def _no_penalty_jacobian(t: Array, x: Array) -> Array:
    return np.zeros((*x.shape[:-1], 0, x.shape[-1]))


def _state_jacobian(f: Callable[[Array, Array], Array]) -> Callable[[Array, Array], Array]:
    def jacobian(t: Array, x: Array) -> Array:
        return complex_step_jacobian(lambda y: f(t, y), x)

    return jacobian


def _drift_jacobian(
    drift: Callable[[Array, Array, Array], Array],
) -> Callable[[Array, Array, Array], tuple[Array, Array]]:
    def jacobian(t: Array, x: Array, u: Array) -> tuple[Array, Array]:
        A = complex_step_jacobian(lambda y: drift(t, y, u), x)
        B = complex_step_jacobian(lambda v: drift(t, x, v), u)
        return A, B

    return jacobian

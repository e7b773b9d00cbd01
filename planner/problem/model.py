"""What `plan` solves: the protocol a problem satisfies, and its checked, completed form.

    minimise  E ∫₀ᵀ [ uᵀRu + H(t,x) + ℓ(t,x)ᵀu + Σ_i w_i max(0, c_i(t,x))² ] dt
    s.t.      dx = b(t,x,u) dt + σ(t,x) dB,   x(0) = start,   E[g(x(T))] = 0,
              lower ≤ u ≤ upper,   ‖u‖₂ ≤ radius

b is affine in u; x(0) may be uncertain (`start_covariance`). Where `variance_weight` is to charge
the noise, σ may depend only on states that stay certain (paper §6.1).
Costs of the state are charged at nodes 1..N−1, each with the dt of the interval that ends there,
those of the control with the dt of its interval; both are taken at the mean, and the noise is
charged by `variance_weight` in :func:`slipcar.planner.plan`.
`slipcar.envs.Scenario` satisfies the protocol; the two packages do not know each other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from slipcar.planner.problem.control_set import control_ball, control_limits, project_controls
from slipcar.planner.problem.derivatives import complex_step_jacobian, gradient_and_hessian
from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.recent import Recent

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
    * `state_cost(t, x)` -> H (...,): any twice differentiable running cost. The sub-problem
      has its gradient and its Hessian, projected to positive semidefinite: nothing changes where
      H is convex. `state_cost_derivatives(t, x)` -> gradient (..., n), Hessian (..., n, n);
      otherwise complex-step gradients and their central differences.
    * `control_cost(t, x)` -> ℓ (..., m): the running cost ℓᵀu, affine in u (L of the paper),
      linearised as the paper does. `control_cost_jacobian(t, x)` -> (..., m, n).
    * `control_bounds`: None, (m,) for |u| ≤ bound, or (2, m) for lower and upper.
    * `control_radius`: None, or r > 0 for ‖u‖₂ ≤ r; box and ball may be combined.
    * `constraint(t, x)` -> h (..., p): violated where positive, for `risk` and `risk_price`; its
      derivatives are traced or taken by complex steps. It costs nothing otherwise.
    * `terminal_weight` (q,) ≥ 0: W of E gᵀWg, what plans with feedback charge instead of asking
      for g(μ) = 0.
    * `initial_guess()` -> states (N, n), controls (N−1, m); otherwise the uncontrolled path
      (or the start at all times, if that path grows without bound).
    * `start_covariance` (n, n): of x(0), symmetric positive semidefinite, with the mean `start`;
      zero otherwise.
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
        start_covariance: (n, n), zero where the start is known.
        times: (N,) [s].
        dt: (N−1,) interval lengths [s].
        R: control weight, (m, m).
        lower: lower control bounds, (m,), −inf where unbounded.
        upper: upper control bounds, (m,).
        radius: of the ball of controls, inf where there is none.
        weight: penalty weights, (p,).
        drift: (t, x, u) -> (..., n).
        drift_jacobian: (t, x, u) -> ((..., n, n), (..., n, m)).
        diffusion: (t, x) -> (..., n, d).
        diffusion_jacobian: (t, x) -> (..., n, d, n).
        penalty: (t, x) -> (..., p).
        penalty_jacobian: (t, x) -> (..., p, n).
        terminal: x -> (..., q).
        terminal_jacobian: x -> (..., q, n).
        state_cost: (t, x) -> (...,), or None.
        state_cost_derivatives: (t, x) -> ((..., n), (..., n, n)), or None.
        control_cost: (t, x) -> (..., m), or None.
        control_cost_jacobian: (t, x) -> (..., m, n), or None.
        own_guess: instead of the problem's `initial_guess`, where the start is another.
        integrator: of the mean, `"euler"` or `"rk4"`; see :mod:`.integrators`.
    """

    problem: Problem
    start: Array
    start_covariance: Array
    times: Array
    dt: Array
    R: Array
    lower: Array
    upper: Array
    radius: float
    weight: Array
    drift: Callable[[Array, Array, Array], Array]
    drift_jacobian: Callable[[Array, Array, Array], tuple[Array, Array]]
    diffusion: Callable[[Array, Array], Array]
    diffusion_jacobian: Callable[[Array, Array], Array]
    penalty: Callable[[Array, Array], Array]
    penalty_jacobian: Callable[[Array, Array], Array]
    terminal: Callable[[Array], Array]
    terminal_jacobian: Callable[[Array], Array]
    state_cost: Callable[[Array, Array], Array] | None = None
    state_cost_derivatives: Callable[[Array, Array], tuple[Array, Array]] | None = None
    control_cost: Callable[[Array, Array], Array] | None = None
    control_cost_jacobian: Callable[[Array, Array], Array] | None = None
    integrator: str = "euler"
    own_guess: Callable[[], tuple[Array, Array]] | None = None

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

    def admissible(self, u: Array) -> Array:
        """The nearest controls within bounds and ball, (..., m)."""
        return project_controls(u, self.lower, self.upper, self.radius)

    def guess(self) -> tuple[Array, Array]:
        """The problem's own, else the uncontrolled path, else (it escapes) resting at the start."""
        N, n, m = len(self.times), self.state_dim, self.control_dim
        own = self.own_guess or getattr(self.problem, "initial_guess", None)
        if own is not None:
            x, u = own()
        else:
            u = self.admissible(np.zeros((N - 1, m)))
            x = np.empty((N, n))
            x[0] = self.start
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                for k in range(N - 1):
                    t, dt = self.times[k], self.dt[k]
                    moved = change(self.integrator, self.drift, t, dt, x[k], u[k])
                    if np.shape(moved) != (n,):
                        raise ValueError(
                            f"drift(t, x, u) must have shape ({n},) for one point, not "
                            f"{np.shape(moved)}"
                        )
                    x[k + 1] = x[k] + moved
            if not np.isfinite(x).all():
                x[:] = self.start
        return checked_trajectory(self, x, u)


def penalty_cost(model: Model, x: Array) -> float:
    """Σ dt Σ w max(0, c)² along states (N, n)."""
    c = np.maximum(model.penalty(model.times[1:], x[1:]), 0.0)
    return float(np.vdot(model.dt[:, None] * model.weight, c * c))


def checked_trajectory(model: Model, x: Any, u: Any) -> tuple[Array, Array]:
    """States (N, n) starting at `start` and admissible controls (N−1, m), as float64.

    Raises:
        ValueError: for a wrong shape or a non-finite entry.
    """
    N = len(model.times)
    x = _finite("guess: states", x, (N, model.state_dim)).copy()
    u = _finite("guess: controls", u, (N - 1, model.control_dim))
    x[0] = model.start
    return x, model.admissible(u)


_MODELS = Recent()


def model_of(problem: Problem) -> Model:
    """Check a problem at the boundary and complete it with complex-step Jacobians.

    For an immutable problem (a frozen dataclass of immutable values) that was seen lately this
    is the same model as then.

    Raises:
        TypeError: if a required member is missing, naming it.
        ValueError: if a shape, value or function result is wrong, naming it.
    """
    model = _MODELS.get(problem)
    if model is None:
        model = _checked(problem)
        _MODELS.keep(problem, model)
    return model


def _checked(problem: Problem) -> Model:
    required = ("start", "times", "control_weight", "drift", "diffusion", "terminal")
    missing = [name for name in required if not hasattr(problem, name)]
    if getattr(problem, "penalty", None) is not None and not hasattr(problem, "penalty_weight"):
        missing.append("penalty_weight (needed with penalty)")
    if missing:
        raise TypeError(
            f"{type(problem).__name__} is not a slipcar.planner.Problem: it lacks {missing}"
        )
    start = _finite("start", problem.start, (None,))
    start_covariance = _start_covariance(problem, len(start))
    times = _finite("times", problem.times, (None,))
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise ValueError(f"times must be at least 2 increasing nodes, not {times!r}")
    R = _finite("control_weight", problem.control_weight, (None, None))
    if R.shape[0] != R.shape[1] or not np.allclose(R, R.T) or np.linalg.eigvalsh(R)[0] <= 0:
        raise ValueError(f"control_weight must be symmetric positive definite, not {R!r}")
    lower, upper = control_limits(getattr(problem, "control_bounds", None), len(R))
    radius = control_ball(getattr(problem, "control_radius", None), lower, upper)
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
        start_covariance=start_covariance,
        times=times,
        dt=np.diff(times),
        R=R,
        lower=lower,
        upper=upper,
        radius=radius,
        weight=weight,
        drift=problem.drift,
        drift_jacobian=drift_jacobian,
        diffusion=problem.diffusion,
        diffusion_jacobian=diffusion_jacobian,
        penalty=penalty,
        penalty_jacobian=penalty_jacobian,
        terminal=problem.terminal,
        terminal_jacobian=terminal_jacobian,
        **_running_costs(problem, t2, x2, m),
    )


def _start_covariance(problem: Problem, n: int) -> Array:
    """Σ_0, checked, (n, n); zero where the problem has none."""
    given = getattr(problem, "start_covariance", None)
    if given is None:
        return np.zeros((n, n))
    S = _finite("start_covariance", given, (n, n))
    largest = float(np.abs(S).max(initial=0.0))
    bent = np.argwhere(np.abs(S - S.T) > 1e-9 * largest)
    if len(bent):
        i, j = (int(index) for index in bent[0])
        raise ValueError(
            f"start_covariance must be symmetric, but [{i}, {j}] is {S[i, j]:.6g} and "
            f"[{j}, {i}] is {S[j, i]:.6g}"
        )
    S = 0.5 * (S + S.T)
    least = float(np.linalg.eigvalsh(S)[0])
    if least < -1e-9 * largest:
        raise ValueError(
            f"start_covariance must be positive semidefinite, but has the eigenvalue {least:.3g}"
        )
    return S


def _running_costs(problem: Problem, t2: Array, x2: Array, m: int) -> dict[str, Any]:
    """State and control cost with their derivatives, checked at two points (2,), (2, n)."""
    n = x2.shape[1]
    H, linear = getattr(problem, "state_cost", None), getattr(problem, "control_cost", None)
    found: dict[str, Any] = {}
    if H is not None:
        _finite("state_cost(t, x) at the start", H(t2, x2), (2,))
        derivatives = getattr(problem, "state_cost_derivatives", None)
        if derivatives is None:

            def derivatives(t: Array, x: Array) -> tuple[Array, Array]:
                return gradient_and_hessian(lambda y: H(t, y), x)

        gradient, hessian = derivatives(t2, x2)
        _finite("state_cost_derivatives(t, x)[0]", gradient, (2, n))
        _finite("state_cost_derivatives(t, x)[1]", hessian, (2, n, n))
        found |= {"state_cost": H, "state_cost_derivatives": derivatives}
    if linear is not None:
        _finite("control_cost(t, x) at the start", linear(t2, x2), (2, m))
        jacobian = getattr(problem, "control_cost_jacobian", None) or _state_jacobian(linear)
        _finite("control_cost_jacobian(t, x)", jacobian(t2, x2), (2, m, n))
        found |= {"control_cost": linear, "control_cost_jacobian": jacobian}
    return found


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

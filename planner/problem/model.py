"""A problem, checked at the boundary: its numbers as arrays, its functions with their derivatives.

A problem is remembered by its identity while it lives and by the numbers it names: those are looked
at in every call, its functions never. What they compute is what they compute now.
"""

from __future__ import annotations

import dataclasses
import functools
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.problem import numbers
from slipcar.planner.problem.answers import answers
from slipcar.planner.problem.control_set import control_ball, control_limits, project_controls
from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.jacobians import Jacobians
from slipcar.planner.problem.numbers import finite
from slipcar.planner.problem.protocol import Problem

Array = np.ndarray
_REQUIRED = ("start", "times", "control_weight", "drift", "diffusion", "terminal")
#: Members that are numbers.
_NUMBERS = (
    "start", "times", "control_weight", "control_bounds", "control_radius", "penalty_weight",
    "start_covariance",
)  # fmt: skip
_OPTIONAL = ("penalty", "constraint", "state_cost", "control_cost")


#: Gauss–Newton steps to an end that the terminal condition allows.
_END_STEPS = 10
#: A path explodes that gets so many times as far in its second half as in its first.
_EXPLODES = 1e3


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """A problem, checked and completed: what the planner computes with.

    Its functions are the problem's, its derivatives the problem's or exact ones
    (:mod:`.jacobians`), all batched over leading axes.

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
    integrator: str = "euler"
    own_guess: Callable[[], tuple[Array, Array]] | None = None

    @functools.cached_property
    def state_dim(self) -> int:
        """Dimension of the state, n."""
        return len(self.start)

    @functools.cached_property
    def control_dim(self) -> int:
        """Dimension of the control, m."""
        return len(self.R)

    @functools.cached_property
    def bounded(self) -> bool:
        """Whether any control bound is finite."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    @functools.cached_property
    def coupling(self) -> float:
        """The least eigenvalue of R with its diagonal scaled to ones: 1 if it is diagonal.

        A residual measured control by control bounds the one in the norm of R by its inverse.
        """
        scale = 1.0 / np.sqrt(self.R.diagonal())
        scaled = scale[:, None] * self.R * scale
        return 1.0 if np.count_nonzero(self.R) == len(self.R) else np.linalg.eigvalsh(scaled)[0]

    @functools.cached_property
    def jacobians(self) -> Jacobians:
        """Derivatives of the functions as they are now."""
        return Jacobians(self.problem, self.state_dim, self.control_dim)

    @property
    def metric(self) -> Array | None:
        """What the variance of each state weighs in tr Σ, (n,); None is one."""
        return None

    @property
    def knows_jacobians(self) -> bool:
        """Whether derivatives of its functions were asked for."""
        return "jacobians" in vars(self)

    def started(self, start: Array, own_guess: Callable[[], tuple[Array, Array]] | None) -> Model:
        """The same problem from another state: what is known of the rest stays known."""
        copy = object.__new__(Model)
        vars(copy).update(vars(self), start=start, own_guess=own_guess)
        return copy

    def admissible(self, u: Array) -> Array:
        """The nearest controls within bounds and ball, (..., m)."""
        return project_controls(u, self.lower, self.upper, self.radius)

    def guess(self) -> tuple[Array, Array]:
        """The problem's own, else the uncontrolled path, else (it explodes) a line to the end."""
        own = self.own_guess or getattr(self.problem, "initial_guess", None)
        return checked_trajectory(self, *(own() if own is not None else self._uncontrolled()))

    def _uncontrolled(self) -> tuple[Array, Array]:
        N, n = len(self.times), self.state_dim
        u = self.admissible(np.zeros((N - 1, self.control_dim)))
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
        return (x if _tame(x) else self._line()), u

    def _line(self) -> Array:
        """A straight way from the start to the nearest end that the terminal condition allows."""
        end = self.start
        with np.errstate(all="ignore"):
            for _ in range(_END_STEPS):
                at = end[None]
                g, G = self.terminal(at)[0], self.terminal_jacobian(at)[0]
                if not np.any(g) or not (np.isfinite(g).all() and np.isfinite(G).all()):
                    break
                end = end - np.linalg.lstsq(G, g, rcond=None)[0]
        if not np.isfinite(end).all():
            end = self.start
        s = (self.times - self.times[0]) / (self.times[-1] - self.times[0])
        return self.start + s[:, None] * (end - self.start)

    # ----------------------------------------------------------- functions of times and states

    def drift(self, t: Array, x: Array, u: Array) -> Array:
        """b, (..., n)."""
        return self.problem.drift(t, x, u)

    def drift_jacobian(self, t: Array, x: Array, u: Array) -> tuple[Array, Array]:
        """∂b/∂x (..., n, n) and ∂b/∂u (..., n, m)."""
        return self.jacobians.drift(t, x, u)

    def diffusion(self, t: Array, x: Array) -> Array:
        """σ, (..., n, d)."""
        return np.asarray(self.problem.diffusion(t, x))

    def diffusion_jacobian(self, t: Array, x: Array) -> Array:
        """∂σ/∂x, (..., n, d, n)."""
        return self.jacobians.state("diffusion", t, x)

    def penalty(self, t: Array, x: Array) -> Array:
        """c, (..., p)."""
        if not self.has("penalty"):
            return np.zeros((*x.shape[:-1], 0))
        return np.asarray(self.problem.penalty(t, x))  # type: ignore[attr-defined]

    def penalty_jacobian(self, t: Array, x: Array) -> Array:
        """∂c/∂x, (..., p, n)."""
        if not self.has("penalty"):
            return np.zeros((*x.shape[:-1], 0, x.shape[-1]))
        return self.jacobians.state("penalty", t, x)

    def terminal(self, x: Array) -> Array:
        """g, (..., q)."""
        return np.asarray(self.problem.terminal(x))

    def terminal_jacobian(self, x: Array) -> Array:
        """∂g/∂x, (..., q, n)."""
        return self.jacobians.state("terminal", np.zeros(x.shape[:-1]), x)

    def has(self, name: str) -> bool:
        """Whether the problem has this optional function."""
        return getattr(self.problem, name, None) is not None

    @property
    def state_cost(self) -> Callable[[Array, Array], Array] | None:
        """(t, x) -> H (...,), or None."""
        return getattr(self.problem, "state_cost", None)

    def state_cost_derivatives(self, t: Array, x: Array) -> tuple[Array, Array]:
        """∂H/∂x (..., n) and ∂²H/∂x² (..., n, n)."""
        return self.jacobians.state_cost(t, x)

    @property
    def control_cost(self) -> Callable[[Array, Array], Array] | None:
        """(t, x) -> ℓ (..., m), or None."""
        return getattr(self.problem, "control_cost", None)

    def constraint_count(self) -> int:
        """Constraints of the problem; 0 without any.

        Raises:
            ValueError: if they have the wrong shape at the start, or are not finite there.
        """
        x2, u2 = np.stack([self.start, self.start]), np.zeros((2, self.control_dim))
        given = answers(self.problem, self.times[:2], x2, u2, names=("constraint",), at_start=True)
        return given["constraint"].shape[1] if given else 0

    def control_cost_jacobian(self, t: Array, x: Array) -> Array:
        """∂ℓ/∂x, (..., m, n)."""
        return self.jacobians.state("control_cost", t, x)


def _tame(x: Array) -> bool:
    """Whether a path (N, n) is finite and does not explode."""
    if not np.isfinite(x).all():
        return False
    far = np.abs(x - x[0])
    early, late = far[: len(x) // 2 + 1].max(axis=0), far.max(axis=0)
    return not bool(np.any((early > 0.0) & (late > _EXPLODES * early)))


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
    x = finite("guess: states", x, (N, model.state_dim)).copy()
    u = finite("guess: controls", u, (N - 1, model.control_dim))
    x[0] = model.start
    return x, model.admissible(u)


_known: dict[int, tuple[weakref.ref[Any], Any, Model]] = {}


def model_of(problem: Problem) -> Model:
    """Check a problem at the boundary and complete it.

    Raises:
        TypeError: if a required member is missing, naming it.
        ValueError: if a shape, value or function result is wrong, naming it.
    """
    named = _signature(problem)
    known = _known.get(id(problem))
    if known is not None and known[0]() is problem and known[1] == named:
        return _renewed(known[2], problem)
    model = _checked(problem)
    try:
        reference = weakref.ref(problem, functools.partial(_forget, id(problem)))
    except TypeError:  # an object that cannot be referred to weakly is checked anew each time
        return model
    # The model refers to its problem: kept without it, lest the problem live for ever.
    _known[id(problem)] = (reference, named, _renewed(model, None))
    return model


def _forget(key: int, _: Any) -> None:
    _known.pop(key, None)


def _signature(problem: Any) -> tuple[Any, ...]:
    """The numbers that a problem names, and which optional functions it has."""
    values: list[Any] = []
    for name in _NUMBERS:
        value = getattr(problem, name, None)
        if value is not None:
            array = np.asarray(value)
            value = (array.shape, array.dtype, array.tobytes())
        values.append(value)
    return (*values, *(getattr(problem, name, None) is None for name in _OPTIONAL))


def _renewed(model: Model, problem: Any) -> Model:
    """A copy for a problem that knows no derivatives yet: functions may have changed since."""
    copy = object.__new__(Model)
    vars(copy).update(vars(model), problem=problem)
    vars(copy).pop("jacobians", None)
    return copy


def _checked(problem: Any) -> Model:
    missing = [name for name in _REQUIRED if not hasattr(problem, name)]
    if getattr(problem, "penalty", None) is not None and not hasattr(problem, "penalty_weight"):
        missing.append("penalty_weight (needed with penalty)")
    if missing:
        raise TypeError(
            f"{type(problem).__name__} is not a slipcar.planner.Problem: it lacks {missing}"
        )
    start = finite("start", problem.start, (None,))
    times = numbers.node_times(problem.times)
    R = numbers.control_weight(problem.control_weight)
    lower, upper = control_limits(getattr(problem, "control_bounds", None), len(R))
    model = Model(
        problem=problem,
        start=start,
        start_covariance=numbers.start_covariance(
            getattr(problem, "start_covariance", None), len(start)
        ),
        times=times,
        dt=times[1:] - times[:-1],
        R=R,
        lower=lower,
        upper=upper,
        radius=control_ball(getattr(problem, "control_radius", None), lower, upper),
        weight=_checked_penalties(problem, times[:2], start, len(R)),
    )
    for name in ("state_dim", "control_dim", "bounded", "coupling"):
        getattr(model, name)  # once, for all copies of it
    return model


def _checked_penalties(problem: Any, t: Array, start: Array, m: int) -> Array:
    """The penalties' weights, (p,), after a look at every function at the start."""
    names = ("drift", "diffusion", "terminal", "penalty", "state_cost", "control_cost")
    x2, u2 = np.array([start, start]), np.zeros((2, m))
    given = answers(problem, t, x2, u2, names=names, at_start=True)
    if "penalty" not in given:
        return np.zeros(0)
    weight = finite("penalty_weight", problem.penalty_weight, (given["penalty"].shape[1],))
    if (weight < 0).any():
        raise ValueError(f"penalty_weight must be >= 0, not {weight!r}")
    return weight

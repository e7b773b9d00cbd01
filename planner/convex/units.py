"""The problem in units of its own size: the convex scheme sees the same numbers in all units.

Trust regions, merits and the tolerances of solvers compare numbers of different kinds. With

    x = s z,   u = c v,   t = T θ,   cost = κ J,   g = γ h

where s is how far the states move, c the controls that this takes, T the horizon, κ the effort of
those controls (or a part of what the states' costs change by) and γ what the end moves when the
states do, the problem in z, v, θ, J and h is the same whatever units it was written in.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from slipcar.planner.convex.subproblem import convexify
from slipcar.planner.problem.feasibility import TINY, end_sizes, least_push, states_moved
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: A state that moves by less than a part of its value is at rest: its size is a part of the value.
_AT_REST, _OF_VALUE = 1e-5, 1e-2
#: The effort is the unit of cost unless it is less than this part of what states cost.
_LEAST_EFFORT = 1e-6


@dataclasses.dataclass(frozen=True)
class Units:
    """One unit of each kind, in those of the problem."""

    state: Array  #: s, (n,)
    control: Array  #: c, (m,)
    time: float  #: T
    cost: float  #: κ
    end: Array  #: γ, (q,)


@dataclasses.dataclass(frozen=True, eq=False)
class ScaledModel(Model):
    """A model in other units; it has the original's functions and derivatives."""

    original: Model = None  # type: ignore[assignment]
    units: Units = None  # type: ignore[assignment]

    @property
    def metric(self) -> Array:
        """What the variance of each state weighs in tr Σ: s²."""
        return self.units.state**2

    def _at(self, t: Array, x: Array) -> tuple[Array, Array]:
        return t * self.units.time, x * self.units.state

    def drift(self, t: Array, x: Array, u: Array) -> Array:
        """T b / s."""
        value = self.original.drift(*self._at(t, x), u * self.units.control)
        return self.units.time / self.units.state * np.asarray(value)

    def drift_jacobian(self, t: Array, x: Array, u: Array) -> tuple[Array, Array]:
        """∂/∂z and ∂/∂v of the drift."""
        A, B = self.original.drift_jacobian(*self._at(t, x), u * self.units.control)
        rate = (self.units.time / self.units.state)[:, None]
        return rate * A * self.units.state, rate * B * self.units.control

    def diffusion(self, t: Array, x: Array) -> Array:
        """√T σ / s."""
        root = np.sqrt(self.units.time) / self.units.state
        return root[:, None] * self.original.diffusion(*self._at(t, x))

    def diffusion_jacobian(self, t: Array, x: Array) -> Array:
        """∂/∂z of the diffusion."""
        root = np.sqrt(self.units.time) / self.units.state
        slope = self.original.diffusion_jacobian(*self._at(t, x))
        return root[:, None, None] * slope * self.units.state

    def penalty(self, t: Array, x: Array) -> Array:
        """The original's."""
        return self.original.penalty(*self._at(t, x))

    def penalty_jacobian(self, t: Array, x: Array) -> Array:
        """∂/∂z of the penalty."""
        return self.original.penalty_jacobian(*self._at(t, x)) * self.units.state

    def terminal(self, x: Array) -> Array:
        """The end g / γ."""
        return self.original.terminal(x * self.units.state) / self.units.end

    def terminal_jacobian(self, x: Array) -> Array:
        """∂/∂z of the terminal condition."""
        slope = self.original.terminal_jacobian(x * self.units.state)
        return slope * self.units.state / self.units.end[:, None]

    @property
    def state_cost(self) -> Callable[[Array, Array], Array] | None:
        """T H / κ, or None."""
        cost = self.original.state_cost
        if cost is None:
            return None
        return lambda t, x: self.units.time / self.units.cost * cost(*self._at(t, x))

    def state_cost_derivatives(self, t: Array, x: Array) -> tuple[Array, Array]:
        """∂/∂z and ∂²/∂z² of the state cost."""
        gradient, hessian = self.original.state_cost_derivatives(*self._at(t, x))
        rate, s = self.units.time / self.units.cost, self.units.state
        return rate * gradient * s, rate * s[:, None] * hessian * s

    @property
    def control_cost(self) -> Callable[[Array, Array], Array] | None:
        """T c ℓ / κ, or None."""
        cost = self.original.control_cost
        if cost is None:
            return None
        rate = self.units.time / self.units.cost * self.units.control
        return lambda t, x: rate * cost(*self._at(t, x))

    def control_cost_jacobian(self, t: Array, x: Array) -> Array:
        """∂/∂z of the control cost."""
        rate = self.units.time / self.units.cost * self.units.control
        slope = self.original.control_cost_jacobian(*self._at(t, x))
        return rate[:, None] * slope * self.units.state


def identity_units(model: Model, x: Array) -> Units:
    """The problem's own units."""
    ends = np.shape(model.terminal(x[-1]))
    return Units(np.ones(model.state_dim), np.ones(model.control_dim), 1.0, 1.0, np.ones(ends))


def scaled(model: Model, units: Units) -> ScaledModel:
    """The model in other units."""
    s, c, T = units.state, units.control, units.time
    return ScaledModel(
        problem=model.problem,
        start=model.start / s,
        start_covariance=model.start_covariance / np.outer(s, s),
        times=model.times / T,
        dt=model.dt / T,
        R=T / units.cost * np.outer(c, c) * model.R,
        lower=model.lower / c,
        upper=model.upper / c,
        radius=model.radius / c[0],
        weight=T / units.cost * model.weight,
        integrator=model.integrator,
        original=model,
        units=units,
    )


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def natural_units(model: Model, x: Array, u: Array, *, box: bool) -> Units:
    """Units from what it takes to reach the end, to first order, from a guess x (N, n), u (K, m).

    Where there is a ball of controls all controls have one unit, and all terminal conditions where
    there is a terminal `box`.
    """
    lin, T = linearize(model, x, u), float(model.times[-1] - model.times[0])
    push = model.admissible(u + least_push(model, lin)) - u
    push = np.where(np.isfinite(push), push, 0.0)
    rates = 1.0 / np.sqrt(model.R.diagonal())
    if model.radius < np.inf:
        rates = np.full(len(rates), rates.max())
    size = max(float(np.abs(each / rates).max()) for each in (u, push))
    if size <= TINY**0.5:
        limits = np.minimum(np.minimum(model.upper, -model.lower), model.radius) / rates
        size = min((each for each in limits if 0.0 < each < np.inf), default=1.0)
    control = size * rates
    moved = np.maximum(states_moved(lin), _moves(lin.A, lin.B, push))
    value = np.abs(x).max(axis=0)
    state = np.where(moved > _AT_REST * value, moved, _OF_VALUE * value)
    state = np.where(np.isfinite(state) & (state > TINY**0.5), state, 1.0)
    end = end_sizes(lin.G, state)
    end = np.where(np.isfinite(end) & (end > TINY**0.5), end, 1.0)
    if box:
        end = np.full(len(end), end.max(initial=0.0) or 1.0)
    sub = convexify(model, lin, variance=None)
    hinges = np.matmul((sub.h * np.maximum(sub.b, 0.0))[:, None], sub.a)[:, 0]
    charged = float(np.abs(sub.q + hinges).sum(axis=0) @ state)
    cost = max(T * size**2, _LEAST_EFFORT * charged if np.isfinite(charged) else 0.0)
    return Units(state, control, T, cost, end)


def _moves(A: Array, B: Array, push: Array) -> Array:
    """How far each state goes under changes of the controls (K, m), to first order: (n,)."""
    d, most = np.zeros(A.shape[1]), np.zeros(A.shape[1])
    for k in range(len(A)):
        d = A[k] @ d + B[k] @ push[k]
        most = np.maximum(most, np.abs(d))
    return most

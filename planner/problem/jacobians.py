"""Derivatives of a problem's functions: those it gives, else exact ones from a trace.

A function that leaves NumPy (a network, a spline of SciPy's) cannot be traced; where the problem
gives no derivative of it either, it is differentiated by central differences, which are compared
with independent ones the first time they are used. What could be traced but is written so that it
cannot be (a branch on a value) is refused, with the line and what to write instead.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.trace.errors import OpaqueError, TraceError
from slipcar.planner.trace.graph import Graph, jacobian
from slipcar.planner.trace.numpy_code import numpy_function
from slipcar.planner.trace.tracing import trace_call

Array = np.ndarray
#: Values and slopes at times (...,), states (..., n), controls (..., m): each with leading axes.
Slopes = Callable[[Array, Array, Array], tuple[Array, ...]]

#: Steps of central differences, relative: first derivatives, and slopes of those.
_STEP, _WIDE = 6e-6, 2e-4
#: How near a numerical derivative must come to an independent one, relative to its size.
_AGREEMENT = 1e-5
_POINTS = 8


class Jacobians:
    """Derivatives of one problem's functions, each made when it is first asked for.

    Args:
        problem: whose functions they are.
        n: states.
        m: controls.
        given: whether derivatives that the problem gives are taken.

    Attributes:
        differenced: names of the functions that are differentiated numerically, and why.
    """

    def __init__(self, problem: Any, n: int, m: int, *, given: bool = True) -> None:
        self.problem, self.n, self.m, self._takes_given = problem, n, m, given
        self._distrust = ""
        self.differenced: dict[str, str] = {}
        self._made: dict[str, Slopes] = {}

    def drift(self, t: Array, x: Array, u: Array) -> tuple[Array, Array]:
        """∂b/∂x (..., n, n) and ∂b/∂u (..., n, m)."""
        if (given := self._given("drift_jacobian")) is not None:
            return given(t, x, u)
        by_x, by_u = self._slopes("drift")(t, x, u)
        return by_x, by_u

    def state(self, name: str, t: Array, x: Array) -> Array:
        """Of the function of that name by the states: (..., *shape of its value, n)."""
        given = self._given(f"{name}_jacobian")
        if given is not None:
            return np.asarray(given(x) if name == "terminal" else given(t, x))
        return self._slopes(name)(t, x, np.zeros((*x.shape[:-1], 0)))[0]

    def state_cost(self, t: Array, x: Array) -> tuple[Array, Array]:
        """Gradient (..., n) and Hessian (..., n, n) of the state cost."""
        if (given := self._given("state_cost_derivatives")) is not None:
            return given(t, x)
        gradient, hessian = self._slopes("state_cost")(t, x, np.zeros((*x.shape[:-1], 0)))
        return gradient, hessian

    def check_given(self, name: str) -> None:
        """Nothing if the derivative of a function that cannot be traced is given.

        Raises:
            ValueError: if it is not, and the function does not leave NumPy but is written so that
                it cannot be traced: what, where, and what to write instead.
        """
        if not self.is_given(name):
            self._slopes(name)

    def is_given(self, name: str) -> bool:
        """Whether the problem gives the derivative of a function."""
        suffix = "derivatives" if name == "state_cost" else "jacobian"
        return self._given(f"{name}_{suffix}") is not None

    def distrust(self, reason: str) -> None:
        """Take no derivatives from traces: they do not say what the functions say."""
        self._distrust = reason
        self._made.clear()

    def _given(self, name: str) -> Callable[..., Any] | None:
        return getattr(self.problem, name, None) if self._takes_given else None

    def _slopes(self, name: str) -> Slopes:
        if name not in self._made:
            self._made[name] = self._traced_or_differences(name)
        return self._made[name]

    def _traced_or_differences(self, name: str) -> Slopes:
        try:
            if self._distrust:
                raise OpaqueError(self._distrust)
            return self._traced(name)
        except OpaqueError as error:
            self.differenced[name] = str(error)
        except TraceError as error:
            raise ValueError(str(error)) from error
        return self._checked(name)

    def _traced(self, name: str) -> Slopes:
        graph, n, m = Graph(), self.n, 0 if name != "drift" else self.m
        t, x, u = graph.inputs("t", (1,)), graph.inputs("x", (1, n)), graph.inputs("u", (1, m))
        arguments = {"drift": (t, x, u), "terminal": (x,)}.get(name, (t, x))
        values = np.asarray(trace_call(name, getattr(self.problem, name), *arguments))
        if name == "state_cost":
            by_x = jacobian(values[:1], x[0])[0]
            parts = {"gradient": by_x, "hessian": jacobian(by_x, x[0])}
        else:
            parts = {"x": jacobian(values[0], x[0])}
            if m:
                parts["u"] = jacobian(values[0], u[0])
        inputs = {"t": 1, "x": n, "u": m, "number": max(1, len(graph.numbers))}
        outputs = {key: [graph.lift(e) for e in part.ravel()] for key, part in parts.items()}
        function = numpy_function(inputs, outputs, frozenset({"number"}))
        numbers = np.array(graph.numbers or [0.0])[None]

        def slopes(t: Array, x: Array, u: Array) -> tuple[Array, ...]:
            lead = x.shape[:-1]
            count = int(np.prod(lead))
            times = np.broadcast_to(t, lead).reshape(count, 1)
            rows = function(t=times, x=x.reshape(count, n), u=u.reshape(count, m), number=numbers)
            return tuple(rows[key].reshape(*lead, *part.shape) for key, part in parts.items())

        return slopes

    def _values(self, name: str) -> Callable[[Array, Array, Array], Array]:
        function = getattr(self.problem, name)
        if name == "drift":
            return lambda t, x, u: np.asarray(function(t, x, u))
        if name == "terminal":
            return lambda t, x, u: np.asarray(function(x))
        return lambda t, x, u: np.asarray(function(t, x))

    def _checked(self, name: str) -> Slopes:
        """Central differences, compared with independent ones on their first points."""
        value = self._values(name)

        def by_state(t: Array, x: Array, u: Array, step: float) -> Array:
            return differences(lambda y: value(t, y, u), x, step)

        def slopes(t: Array, x: Array, u: Array, step: float = _STEP) -> tuple[Array, ...]:
            if name == "state_cost":
                gradient = by_state(t, x, u, step)
                bend = differences(lambda y: by_state(t, y, u, _WIDE), x, _WIDE)
                return gradient, 0.5 * (bend + bend.swapaxes(-1, -2))
            if name != "drift":
                return (by_state(t, x, u, step),)
            return by_state(t, x, u, step), differences(lambda v: value(t, x, v), u, step)

        verified = False

        def first_checked(t: Array, x: Array, u: Array) -> tuple[Array, ...]:
            nonlocal verified
            parts = slopes(t, x, u)
            if not verified:
                verified = True
                _compare(name, self.differenced[name], parts, slopes, t, x, u)
            return parts

        return first_checked


def differences(f: Callable[[Array], Array], x: Array, step: float) -> Array:
    """Central differences of f (..., n) -> (..., *out) at x: (..., *out, n)."""
    h = step * (1.0 + np.abs(x))
    columns = []
    for i in range(x.shape[-1]):
        ahead, behind = x.copy(), x.copy()
        ahead[..., i] += h[..., i]
        behind[..., i] -= h[..., i]
        rise = np.asarray(f(ahead)) - np.asarray(f(behind))
        width = ahead[..., i] - behind[..., i]
        shape = (*x.shape[:-1], *[1] * (rise.ndim - x.ndim + 1))
        columns.append(rise / np.reshape(width, shape))
    return np.stack(columns, axis=-1)


def richardson(f: Callable[[float], Array]) -> tuple[Array, Array]:
    """Differences extrapolated to a step of zero, and how far the two that it takes are apart."""
    wide, narrow = f(1e-4), f(0.5e-4)
    return (4.0 * narrow - wide) / 3.0, np.abs(narrow - wide)


def _compare(
    name: str, reason: str, parts: tuple[Array, ...], slopes: Any, t: Array, x: Array, u: Array
) -> None:
    """Raise where numerical derivatives are not what independent differences give."""
    flat_x = x.reshape(-1, x.shape[-1])
    chosen = np.linspace(0, len(flat_x) - 1, min(_POINTS, len(flat_x))).astype(int)
    flat_u = u.reshape(len(flat_x), u.shape[-1])
    at = np.broadcast_to(t, x.shape[:-1]).reshape(-1)[chosen], flat_x[chosen], flat_u[chosen]
    both = functools.partial(slopes, *at)
    for i, part in enumerate(parts[:1] if name == "state_cost" else parts):
        given = part.reshape(-1, *part.shape[x.ndim - 1 :])[chosen]
        best, spread = richardson(lambda step, i=i: both(step)[i])  # type: ignore[misc]
        size = np.maximum(np.abs(given), np.abs(best))
        wrong = np.abs(given - best) > _AGREEMENT * (size + size.max()) + 10.0 * spread + 1e-9
        if wrong.any():
            index = tuple(int(j) for j in np.argwhere(wrong)[0])
            raise ValueError(
                f"the derivative of {name} cannot be taken by differences: entry "
                f"{list(index[1:])} is {given[index]:.6g} or {best[index]:.6g}, by the step; is "
                f"{name} smooth there? Give {name}_jacobian ({reason})"
            )

"""A problem at one node, as the equations see it: values, Jacobians and Hessians.

Traced, they are expressions of the node's x, u, t and numbers; otherwise (a network, a spline, a
solver) they are rows of arrays that NumPy fills before each kernel runs (:mod:`.filling`).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from slipcar.planner.trace.graph import Expression, Graph, jacobian
from slipcar.planner.trace.numpy_code import numpy_function
from slipcar.planner.trace.recursion import Field, Layout

Array = np.ndarray


class Dimensions(NamedTuple):
    """Sizes of a problem.

    Attributes:
        n: states.
        m: controls.
        d: Brownian motions.
        p: rows: penalties, and constraints where they are priced.
        q: terminal conditions.
        numbers: constants of the traced functions; at least 1.
    """

    n: int
    m: int
    d: int
    p: int
    q: int
    numbers: int = 1


class Quantities(Protocol):
    """What :class:`.equations.Equations` asks of a problem."""

    @property
    def dims(self) -> Dimensions:
        """Its sizes."""
        ...

    def at(self, rows: Any) -> Any:
        """Its quantities at the rows' node: the attributes of :class:`Traced`."""
        ...


#: Derivatives of a traced problem: of what, by which symbols.
SLOPES = {
    "A": ("next", "x"), "B": ("next", "u"), "d_sigma": ("sigma", "x"), "d_ell": ("ell", "x"),
    "C": ("c", "x"), "G": ("g", "x"), "H_x": ("H", "x"), "H_xx": ("H_x", "x"),
    "row_hessians": ("C", "x"), "end_hessians": ("G", "x"),
}  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Traced:
    """Quantities as expressions, and their derivatives by the names of :data:`SLOPES`.

    Attributes:
        graph: owner of the expressions.
        x: symbols of the state, (n,).
        u: symbols of the control, (m,).
        dt: symbol of the interval's length.
        next: x⁺, the end of the interval, (n,).
        sigma: σ, (n, d).
        c: rows, (p,).
        g: terminal residual, (q,).
        H: state cost.
        ell: ℓ, (m,).
        state_cost: whether there is one.
        numbers: values of the constants.
        programs: kernels made from it, by form.
    """

    graph: Graph
    x: Array
    u: Array
    dt: Expression
    next: Array
    sigma: Array
    c: Array
    g: Array
    H: Expression
    ell: Array
    state_cost: bool
    numbers: Array
    programs: dict[Any, Any] = dataclasses.field(default_factory=dict, repr=False)

    @functools.cached_property
    def dims(self) -> Dimensions:
        """Sizes."""
        return Dimensions(
            len(self.next), len(self.u), self.sigma.shape[1], len(self.c), len(self.g),
            max(1, len(self.numbers)),
        )  # fmt: skip

    @functools.cached_property
    def entries(self) -> list[Expression]:
        """x⁺, σ, ℓ, c, H and g in one row, as the problem's functions are called."""
        parts = (self.next, self.sigma, self.ell, self.c, np.array([self.H]), self.g)
        return [self.graph.lift(e) for part in parts for e in np.ravel(part)]

    def values(self, t: Array, dt: float, x: Array, u: Array, number: Array) -> Array:
        """`entries` at times (k,), states (k, n) and controls (k, m), in NumPy: (k, width)."""
        dts = np.full((len(x), 1), dt)
        return self._value_function(t=t[:, None], dt=dts, x=x, u=u, number=number[None])["values"]

    @functools.cached_property
    def _value_function(self) -> Callable[..., dict[str, Array]]:
        dims = self.dims
        inputs = {"t": 1, "dt": 1, "x": dims.n, "u": dims.m, "number": dims.numbers}
        return numpy_function(inputs, {"values": self.entries}, frozenset({"number"}))

    def rows(self, t: Array, x: Array, number: Array) -> tuple[Array, Array, Array]:
        """C (K, p), ∂c/∂x (K, p, n) and ∂²c/∂x² (K, p, n, n) at times (K,), states (K, n)."""
        n, p = self.dims.n, self.dims.p
        value = self._row_function(t=t[:, None], x=x, number=number[None])
        return value["c"], value["C"].reshape(-1, p, n), value["bend"].reshape(-1, p, n, n)

    @functools.cached_property
    def _row_function(self) -> Callable[..., dict[str, Array]]:
        parts = {"c": self.c, "C": self.C, "bend": self.row_hessians}
        outputs = {k: [self.graph.lift(e) for e in np.ravel(v)] for k, v in parts.items()}
        inputs = {"t": 1, "x": self.dims.n, "number": self.dims.numbers}
        return numpy_function(inputs, outputs, frozenset({"number"}))

    @property
    def filled(self) -> Filled:
        """The same quantities as rows of arrays, for kernels that NumPy runs."""
        return Filled(self.dims, self.state_cost)

    def at(self, rows: Any) -> Traced:
        """Itself: its symbols are the node's."""
        return self

    def __getattr__(self, name: str) -> Array:
        """A derivative, made when it is first asked for: see :data:`SLOPES`."""
        if name not in SLOPES:
            raise AttributeError(name)
        value, symbols = SLOPES[name]
        slopes = jacobian(np.atleast_1d(np.asarray(getattr(self, value))), getattr(self, symbols))
        vars(self)[name] = slopes[0] if value == "H" else slopes
        return vars(self)[name]

    def rows_hessian(self, weight: Array) -> Any:
        """Σ weight_o ∂²c_o/∂x², (n, n)."""
        return _weighted(weight, self.row_hessians)

    def end_hessian(self, multiplier: Array) -> Any:
        """Σ ν_j ∂²g_j/∂x², (n, n)."""
        return _weighted(multiplier, self.end_hessians)

    def lagrangian_hessian(self, adjoint: Array) -> Array:
        """Of λᵀx⁺ + dt ℓᵀu in (x, u), (n + m, n + m)."""
        z = np.concatenate([self.x, self.u])
        value = adjoint.dot(self.next) + self.dt * self.ell.dot(self.u)
        slope = jacobian(np.array([value], dtype=object), z)[0]
        return jacobian(slope, z)


def _weighted(weights: Array, matrices: Array) -> Any:
    return sum((w * M for w, M in zip(weights, matrices, strict=True)), start=0.0)


class FilledAt:
    """Quantities that are rows of arrays, those of a node; see :class:`Traced`."""

    def __init__(self, problem: Filled, rows: Any) -> None:
        self._rows, self.state_cost = rows, problem.state_cost

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self._rows[name]

    def rows_hessian(self, weight: Array) -> Any:
        """Σ weight_o ∂²c_o/∂x², (n, n)."""
        return _weighted(weight, self._rows["row_hessians"])

    def end_hessian(self, multiplier: Array) -> Any:
        """Σ ν_j ∂²g_j/∂x², (n, n)."""
        return _weighted(multiplier, self._rows["end_hessians"])

    def lagrangian_hessian(self, adjoint: Array) -> Array:
        """Of λᵀx⁺ + dt ℓᵀu in (x, u), (n + m, n + m)."""
        return _weighted(adjoint, self._rows["next_hessians"]) + self._rows["cost_hessian"]


@dataclasses.dataclass(frozen=True)
class Filled:
    """Quantities that NumPy fills in.

    Attributes:
        dims: sizes.
        state_cost: whether there is one.
    """

    dims: Dimensions
    state_cost: bool

    def at(self, rows: Any) -> FilledAt:
        """Those of the rows' node."""
        return FilledAt(self, rows)

    @property
    def own(self) -> Layout:
        """Arrays of a point beyond those that the equations write."""
        n, m, d = self.dims.n, self.dims.m, self.dims.d
        return {
            "next": Field((n,)), "sigma": Field((n, d)), "d_sigma": Field((n, d, n)),
            "ell": Field((m,)), "d_ell": Field((m, n)), "H": Field(()), "H_x": Field((n,)),
        }  # fmt: skip

    @property
    def second(self) -> Layout:
        """Arrays of second derivatives at the iterate."""
        n, m, p, q = self.dims.n, self.dims.m, self.dims.p, self.dims.q
        return {
            "next_hessians": Field((n, n + m, n + m)), "cost_hessian": Field((n + m, n + m)),
            "row_hessians": Field((p, n, n)), "end_hessians": Field((q, n, n), True),
        }  # fmt: skip

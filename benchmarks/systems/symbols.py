"""A problem's functions as CasADi's: our trace of them, operation by operation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from slipcar.planner.newton.posing import pose
from slipcar.planner.newton.quantities import Traced
from slipcar.planner.problem.model import Model
from slipcar.planner.trace.graph import reachable

#: By the names of slipcar.planner.trace.derivatives.OPERATIONS, where CasADi's differ.
_OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "neg": lambda a: -a,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "power": lambda a, b: a**b,
    "hypot": lambda a, b: ca.sqrt(a * a + b * b),
    "where": lambda c, a, b: ca.if_else(c > 0, a, b),
    "maximum": ca.fmax,
    "minimum": ca.fmin,
    "greater": lambda a, b: a > b,
    "greater_equal": lambda a, b: a >= b,
    "equal": lambda a, b: a == b,
    "abs": ca.fabs,
    "cbrt": lambda a: ca.sign(a) * ca.fabs(a) ** (1.0 / 3.0),
    "exp2": lambda a: 2.0**a,
    "log2": lambda a: ca.log(a) / np.log(2.0),
    "erfc": lambda a: 1.0 - ca.erf(a),
}


@dataclasses.dataclass(frozen=True)
class Symbolic:
    """Functions of one node, as `casadi.Function`.

    Attributes:
        next: t, dt, x, u -> x + dt b.
        running: t, x, u -> ℓᵀu, of an interval's beginning.
        ahead: t, x -> H + Σ w max(0, c)², of its end.
        terminal: x -> g.
        key: bytes that change whenever the functions do.
    """

    next: ca.Function
    running: ca.Function
    ahead: ca.Function
    terminal: ca.Function
    key: bytes


def symbolic(model: Model) -> Symbolic:
    """Translate the trace of a model's problem.

    Raises:
        ValueError: if it cannot be traced.
    """
    posed = pose(model)
    traced = posed.problem
    if not isinstance(traced, Traced):
        raise ValueError(f"{type(model.problem).__name__} cannot be traced: {posed.reason}")
    t, dt = ca.SX.sym("t"), ca.SX.sym("dt")
    x, u = ca.SX.sym("x", traced.dims.n), ca.SX.sym("u", traced.dims.m)
    inputs = {"t": t, "dt": dt, "x": x, "u": u, "number": ca.DM(posed.numbers)}
    values: dict[int, Any] = {}
    for e in reachable(traced.entries):
        if e.op == "constant":
            values[e.index] = ca.SX(e.value)
        elif e.op == "input":
            name, entry = e.value
            values[e.index] = ca.SX(inputs[name][entry])
        else:
            function = _OPERATIONS.get(e.op) or getattr(ca, e.op)
            values[e.index] = function(*(values[a.index] for a in e.args))

    def column(expressions: Any) -> Any:
        lifted = [traced.graph.lift(e) for e in np.ravel(expressions)]
        return ca.vertcat(*(values[e.index] for e in lifted))

    hinge = ca.fmax(column(traced.c), 0.0) ** 2 if traced.dims.p else ca.SX(0, 1)
    ahead = column(traced.H) + ca.dot(ca.DM(model.weight), hinge)
    return Symbolic(
        next=ca.Function("next", [t, dt, x, u], [column(traced.next)]),
        running=ca.Function("running", [t, x, u], [ca.dot(column(traced.ell), u)]),
        ahead=ca.Function("ahead", [t, x], [ahead]),
        terminal=ca.Function("terminal", [x], [column(traced.g)]),
        key=posed.structure + posed.numbers.tobytes(),
    )

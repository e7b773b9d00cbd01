"""Exact derivatives of expressions, by the chain rule forward through the graph.

Slopes are kept with the graph: what has been differentiated once costs nothing again, also for
second derivatives and for other outputs. Steps (comparisons, sign, floor) have derivative zero; at
kinks one of the one-sided derivatives or subgradients is taken: |·|' = 0 at 0, max(a, b)' = b'
where a = b, and 0 for the length of a vector at 0.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from slipcar.planner.trace import arithmetic as op

Array = np.ndarray
Expression = Any  # graph.Expression, which imports this module
Tangent = dict[int, Expression]  # column -> slope, zeros left out


@dataclasses.dataclass(frozen=True)
class Operation:
    """An operation that expressions are made of.

    Attributes:
        arity: its number of operands.
        partials: derivatives with respect to each operand, given the expression; none for steps
            and for choices, which have rules of their own.
    """

    arity: int
    partials: tuple[Callable[[Expression], Expression], ...] = ()


def _unary(slope: Callable[[Expression, Expression], Expression]) -> Operation:
    """A function of one operand by its derivative, given operand x and value f."""
    return Operation(1, (lambda e: slope(e.args[0], e),))


def _const(x: Expression, value: float) -> Expression:
    return x.graph.constant(value)


def _reciprocal(x: Expression) -> Expression:
    return op.div(_const(x, 1.0), x)


def _times(x: Expression, value: float) -> Expression:
    return op.mul(_const(x, value), x)


def _root_slope(x: Expression, f: Expression) -> Expression:
    return op.div(_const(x, 0.5), op.nonzero(f) if op.vanishes_flat(x) else f)


def _power_by_base(e: Expression) -> Expression:
    base, exponent = e.args
    if op.vanishes_flat(base):  # from rest: 0 instead of 0 · ∞
        return op.div(op.mul(exponent, e), op.nonzero(base))
    return op.mul(exponent, op.power(base, op.sub(exponent, _const(e, 1.0))))


def _squared_radius(e: Expression) -> Expression:
    y, x = e.args
    return op.nonzero(op.add(op.mul(x, x), op.mul(y, y)))


def _one_minus_square(x: Expression) -> Expression:
    return op.sub(_const(x, 1.0), op.mul(x, x))


def _square_plus(x: Expression, number: float) -> Expression:
    return op.add(op.mul(x, x), _const(x, number))


def _bell(x: Expression) -> Expression:
    return _times(op.call("exp", op.neg(op.mul(x, x))), -2.0 / math.sqrt(math.pi))


_STEP = Operation(2)
#: Every operation but "input" and "constant". Names are NumPy's except for erfc, and for the
#: operators add, sub, neg, mul, div. where(c, a, b) is a where c > 0, else b.
OPERATIONS: dict[str, Operation] = {
    "add": Operation(2, (lambda e: _const(e, 1.0), lambda e: _const(e, 1.0))),
    "sub": Operation(2, (lambda e: _const(e, 1.0), lambda e: _const(e, -1.0))),
    "neg": Operation(1, (lambda e: _const(e, -1.0),)),
    "mul": Operation(2, (lambda e: e.args[1], lambda e: e.args[0])),
    "div": Operation(
        2,
        (
            lambda e: _reciprocal(e.args[1]),
            lambda e: op.neg(op.mul(e, _reciprocal(e.args[1]))),
        ),
    ),
    "power": Operation(2, (_power_by_base, lambda e: op.mul(e, op.call("log", e.args[0])))),
    "hypot": Operation(
        2,
        (
            lambda e: op.div(e.args[0], op.nonzero(e)),
            lambda e: op.div(e.args[1], op.nonzero(e)),
        ),
    ),
    "arctan2": Operation(
        2,
        (
            lambda e: op.div(e.args[1], _squared_radius(e)),
            lambda e: op.neg(op.div(e.args[0], _squared_radius(e))),
        ),
    ),
    "where": Operation(3),
    "maximum": Operation(2),
    "minimum": Operation(2),
    "greater": _STEP,
    "greater_equal": _STEP,
    "equal": _STEP,
    "sign": Operation(1),
    "floor": Operation(1),
    "abs": _unary(lambda x, f: op.call("sign", x)),
    "sqrt": _unary(_root_slope),
    "cbrt": _unary(lambda x, f: op.div(_const(x, 1.0 / 3.0), op.mul(f, f))),
    "sin": _unary(lambda x, f: op.call("cos", x)),
    "cos": _unary(lambda x, f: op.neg(op.call("sin", x))),
    "tan": _unary(lambda x, f: _square_plus(f, 1.0)),
    "arcsin": _unary(lambda x, f: _reciprocal(op.sqrt(_one_minus_square(x)))),
    "arccos": _unary(lambda x, f: op.neg(_reciprocal(op.sqrt(_one_minus_square(x))))),
    "arctan": _unary(lambda x, f: _reciprocal(_square_plus(x, 1.0))),
    "sinh": _unary(lambda x, f: op.call("cosh", x)),
    "cosh": _unary(lambda x, f: op.call("sinh", x)),
    "tanh": _unary(lambda x, f: _one_minus_square(f)),
    "arcsinh": _unary(lambda x, f: _reciprocal(op.sqrt(_square_plus(x, 1.0)))),
    "arccosh": _unary(lambda x, f: _reciprocal(op.sqrt(_square_plus(x, -1.0)))),
    "arctanh": _unary(lambda x, f: _reciprocal(_one_minus_square(x))),
    "exp": _unary(lambda x, f: f),
    "exp2": _unary(lambda x, f: _times(f, math.log(2.0))),
    "expm1": _unary(lambda x, f: op.add(f, _const(x, 1.0))),
    "log": _unary(lambda x, f: _reciprocal(x)),
    "log2": _unary(lambda x, f: _times(_reciprocal(x), 1.0 / math.log(2.0))),
    "log10": _unary(lambda x, f: _times(_reciprocal(x), 1.0 / math.log(10.0))),
    "log1p": _unary(lambda x, f: _reciprocal(op.add(x, _const(x, 1.0)))),
    "erfc": _unary(lambda x, f: _bell(x)),
}
#: Functions of one operand that an expression has as methods, as NumPy asks for them.
FUNCTIONS = tuple(name for name, kind in OPERATIONS.items() if kind.arity == 1 and name != "neg")


def derivative(outputs: Iterable[Expression], wrt: Expression) -> list[Expression]:
    """∂output/∂wrt for each output."""
    outputs = list(outputs)
    known = _tangents(outputs, [wrt])
    zero = wrt.graph.constant(0.0)
    return [known[e.index].get(0, zero) for e in outputs]


def jacobian(outputs: Array, inputs: Array) -> Array:
    """∂outputs/∂inputs, (*outputs.shape, *inputs.shape), entries expressions."""
    outputs, inputs = np.asarray(outputs), np.asarray(inputs)
    flat, symbols = outputs.ravel().tolist(), inputs.ravel().tolist()
    result = np.empty((len(flat), len(symbols)), dtype=object)
    if result.size:
        known = _tangents(flat, symbols)
        result[:] = symbols[0].graph.constant(0.0)
        for i, e in enumerate(flat):
            for column, slope in known[e.index].items():
                result[i, column] = slope
    return result.reshape(*outputs.shape, *inputs.shape)


def hessian(value: Expression, inputs: Array) -> Array:
    """Second derivatives of a scalar with respect to inputs (n,): (n, n), symmetric."""
    full = jacobian(jacobian(np.array([value], dtype=object), inputs)[0], inputs)
    above = np.triu_indices(len(full), 1)
    full.T[above] = full[above]  # the same numbers: computed once
    return full


def reachable(outputs: Iterable[Expression]) -> list[Expression]:
    """Everything the outputs are computed from, operands before what uses them."""
    return _unknown(outputs, ())


def _unknown(outputs: Iterable[Expression], known: Any) -> list[Expression]:
    """What the outputs are computed from, except for known parts and what is beyond them."""
    collected: dict[int, Expression] = {}
    stack = list(outputs)
    while stack:
        e = stack.pop()
        if e.index not in collected and e.index not in known:
            collected[e.index] = e
            stack.extend(e.args)
    return [collected[i] for i in sorted(collected)]


def _tangents(outputs: list[Expression], symbols: list[Expression]) -> dict[int, Tangent]:
    """Slopes with respect to the symbols, of the outputs and all that they are computed from."""
    graph = symbols[0].graph
    key = tuple(s.index for s in symbols)
    known = graph.tangents.get(key)
    if known is None:
        one = graph.constant(1.0)
        known = graph.tangents[key] = {index: {i: one} for i, index in enumerate(key)}
    for e in _unknown(outputs, known):
        known[e.index] = _tangent(e, [known[a.index] for a in e.args])
    return known


def _tangent(e: Expression, inner: list[Tangent]) -> Tangent:
    """Slopes of one operation, given those of its operands."""
    if not any(inner):
        return {}
    if e.op == "where":
        return _chosen(e.args[0], inner[1], inner[2])
    if e.op == "maximum":
        return _chosen(op.greater(*e.args), *inner)
    if e.op == "minimum":
        return _chosen(op.greater(e.args[1], e.args[0]), *inner)
    slopes: Tangent = {}
    for partial, tangent in zip(OPERATIONS[e.op].partials, inner, strict=False):
        if tangent:
            factor = partial(e)
            for column, slope in tangent.items():
                term = op.mul(factor, slope)
                before = slopes.get(column)
                slopes[column] = term if before is None else op.add(before, term)
    return {column: slope for column, slope in slopes.items() if not slope.is_zero}


def _chosen(condition: Expression, a: Tangent, b: Tangent) -> Tangent:
    zero = condition.graph.constant(0.0)
    slopes = {
        column: op.where(condition, a.get(column, zero), b.get(column, zero)) for column in a | b
    }
    return {column: slope for column, slope in slopes.items() if not slope.is_zero}

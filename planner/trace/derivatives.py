"""The operations that expressions are made of, and exact derivatives by the chain rule.

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
    """An operation on expressions: its number of operands, its derivatives and its code."""

    arity: int
    #: By each operand, given its value and the operands; none for steps and choices.
    partials: tuple[Callable[..., Any], ...] = ()
    #: NumPy code, and LLVM's instruction or function, where they are not functions of that name.
    numpy: str = ""
    llvm: str = ""


def _function(slope: Callable[..., Any], numpy: str = "", llvm: str = "") -> Operation:
    return Operation(1, (slope,), numpy, llvm)


def _root_slope(f: Expression, x: Expression) -> Expression:
    return 0.5 / (op.nonzero(f) if op.vanishes_flat(x) else f)


def _power_by_base(f: Expression, base: Expression, exponent: Expression) -> Expression:
    if op.vanishes_flat(base):  # from rest: 0 instead of 0 · ∞
        return exponent * f / op.nonzero(base)
    return exponent * op.power(base, exponent - 1.0)


def _squared(y: Expression, x: Expression) -> Expression:
    return op.nonzero(x * x + y * y)


#: Names are NumPy's, but for erfc and the operators; where(c, a, b) is a where c > 0, else b.
OPERATIONS: dict[str, Operation] = {
    "add": Operation(2, (lambda f, a, b: 1.0, lambda f, a, b: 1.0), "{} + {}", "fadd contract"),
    "sub": Operation(2, (lambda f, a, b: 1.0, lambda f, a, b: -1.0), "{} - {}", "fsub contract"),
    "neg": _function(lambda f, a: -1.0, "-{}", "fneg"),
    "mul": Operation(2, (lambda f, a, b: b, lambda f, a, b: a), "{} * {}", "fmul contract"),
    "div": Operation(
        2, (lambda f, a, b: 1.0 / b, lambda f, a, b: -(f * (1.0 / b))), "{} / {}", "fdiv contract"
    ),
    "power": Operation(2, (_power_by_base, lambda f, a, b: f * a.log()), llvm="pow"),
    "hypot": Operation(2, (lambda f, a, b: a / op.nonzero(f), lambda f, a, b: b / op.nonzero(f))),
    "arctan2": Operation(
        2, (lambda f, y, x: x / _squared(y, x), lambda f, y, x: -(y / _squared(y, x))), llvm="atan2"
    ),
    "where": Operation(3, (), "np.where(np.greater({}, 0.0), {}, {})", "select"),
    "maximum": Operation(2, llvm="llvm.maximum.f64"),
    "minimum": Operation(2, llvm="llvm.minimum.f64"),
    "greater": Operation(2, (), "np.greater({}, {}) * 1.0", "fcmp ogt"),
    "greater_equal": Operation(2, (), "np.greater_equal({}, {}) * 1.0", "fcmp oge"),
    "equal": Operation(2, (), "np.equal({}, {}) * 1.0", "fcmp oeq"),
    "sign": Operation(1, llvm="sign"),
    "floor": Operation(1, llvm="llvm.floor.f64"),
    "abs": _function(lambda f, x: x.sign(), llvm="llvm.fabs.f64"),
    "sqrt": _function(_root_slope, llvm="llvm.sqrt.f64"),
    "cbrt": _function(lambda f, x: 1.0 / 3.0 / (f * f)),
    "sin": _function(lambda f, x: x.cos(), llvm="llvm.sin.f64"),
    "cos": _function(lambda f, x: -x.sin(), llvm="llvm.cos.f64"),
    "tan": _function(lambda f, x: f * f + 1.0),
    "arcsin": _function(lambda f, x: 1.0 / (1.0 - x * x).sqrt(), llvm="asin"),
    "arccos": _function(lambda f, x: -(1.0 / (1.0 - x * x).sqrt()), llvm="acos"),
    "arctan": _function(lambda f, x: 1.0 / (x * x + 1.0), llvm="atan"),
    "sinh": _function(lambda f, x: x.cosh()),
    "cosh": _function(lambda f, x: x.sinh()),
    "tanh": _function(lambda f, x: 1.0 - f * f),
    "arcsinh": _function(lambda f, x: 1.0 / (x * x + 1.0).sqrt(), llvm="asinh"),
    "arccosh": _function(lambda f, x: 1.0 / (x * x - 1.0).sqrt(), llvm="acosh"),
    "arctanh": _function(lambda f, x: 1.0 / (1.0 - x * x), llvm="atanh"),
    "exp": _function(lambda f, x: f, llvm="llvm.exp.f64"),
    "exp2": _function(lambda f, x: f * math.log(2.0), llvm="llvm.exp2.f64"),
    "expm1": _function(lambda f, x: f + 1.0),
    "log": _function(lambda f, x: 1.0 / x, llvm="llvm.log.f64"),
    "log2": _function(lambda f, x: 1.0 / math.log(2.0) * (1.0 / x), llvm="llvm.log2.f64"),
    "log10": _function(lambda f, x: 1.0 / math.log(10.0) * (1.0 / x), llvm="llvm.log10.f64"),
    "log1p": _function(lambda f, x: 1.0 / (x + 1.0)),
    "erfc": _function(lambda f, x: -2.0 / math.sqrt(math.pi) * (-(x * x)).exp(), "erfc({})"),
}
#: Functions of one operand that an expression has as methods, as NumPy asks for them.
FUNCTIONS = tuple(name for name, kind in OPERATIONS.items() if kind.arity == 1 and name != "neg")


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


def reachable(outputs: Iterable[Expression], known: Any = ()) -> list[Expression]:
    """What the outputs are computed from, operands before what uses them.

    Indices that are known are left out, and what is beyond them.
    """
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
    for e in reachable(outputs, known):
        known[e.index] = _tangent(e, [known[a.index] for a in e.args])
    return known


def _tangent(e: Expression, inner: list[Tangent]) -> Tangent:
    """Slopes of one operation, given those of its operands."""
    if not any(inner):
        return {}
    slopes: Tangent = {}
    if e.op in ("where", "maximum", "minimum"):
        a, b = inner[-2:]
        left, right = e.args[:2]
        chosen = left if e.op == "where" else left > right if e.op == "maximum" else right > left
        zero = e.graph.constant(0.0)
        for column in a | b:
            slopes[column] = op.where(chosen, a.get(column, zero), b.get(column, zero))
    for partial, tangent in zip(OPERATIONS[e.op].partials, inner, strict=False):
        if tangent:
            factor = e.graph.lift(partial(e, *e.args))
            for column, slope in tangent.items():
                term = op.mul(factor, slope)
                before = slopes.get(column)
                slopes[column] = term if before is None else op.add(before, term)
    return {column: slope for column, slope in slopes.items() if not slope.is_zero}

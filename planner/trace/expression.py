"""Scalars that remember how they were computed: expressions, and their exact derivatives.

A NumPy array of dtype object whose entries are :class:`Expression` goes through array code as
numbers would: NumPy hands its arithmetic and its functions (`np.cos` calls `.cos()`) to the
entries. What comes out says how to compute it. Equal expressions are one object (hash-consing),
so common sub-expressions are found while tracing, and derivatives of any order stay small.

Whatever would make the traced code differ from the original raises `TraceError`: above all a
branch on a value (`if x > 0`, `np.maximum`), which a trace cannot record. Values agree to rounding
wherever the original is finite; the sign of a zero may get lost, and 0 · x is 0 even for x = ∞.
What asks for types instead of values (`x.dtype`, `isinstance`, `except TypeError`), or answers
differently each time, is not seen here: see `functions._agree` in :mod:`slipcar.planner.newton`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

Number = int | float


class TraceError(TypeError):
    """The code does something with its arguments that cannot be recorded."""


class Graph:
    """Owns the expressions of one trace: equal ones are the same object."""

    def __init__(self) -> None:
        self._known: dict[tuple[Any, ...], Expression] = {}
        self.size = 0

    def make(self, op: str, args: tuple[Expression, ...], value: Any = None) -> Expression:
        """The expression op(args): a known one if there is one."""
        key = (op, value, *(a.index for a in args))
        found = self._known.get(key)
        if found is None:
            found = self._known[key] = Expression(self, op, args, value, self.size)
            self.size += 1
        return found

    def constant(self, value: Number) -> Expression:
        """A number."""
        # 0.0 and -0.0 are equal as keys, so there is one zero: + 0.0 makes it the positive one.
        return self.make("constant", (), float(value) + 0.0)

    def inputs(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """An array of symbols: entries of the input `name`, numbered in C order."""
        flat = [self.make("input", (), (name, i)) for i in range(math.prod(shape))]
        array = np.empty(len(flat), dtype=object)
        array[:] = flat
        return array.reshape(shape)

    def lift(self, value: Any) -> Expression:
        """A number or an expression of this graph, as an expression.

        Raises:
            TraceError: for anything else.
        """
        if isinstance(value, Expression):
            if value.graph is not self:
                raise TraceError("an expression of another trace was kept and used")
            return value
        if isinstance(value, np.ndarray) and value.ndim == 0:
            return self.lift(value.item())
        if isinstance(value, (int, float, np.integer, np.floating, np.bool_)):
            return self.constant(float(value))
        raise TraceError(f"{type(value).__name__} is neither a real number nor an expression")


class Expression:
    """A scalar: how it is computed from inputs and constants.

    Attributes:
        graph: the trace it belongs to.
        op: "input", "constant", an operation or a function.
        args: its operands.
        value: (name, entry) of an input, the number of a constant.
        index: position in the order of creation: operands come before what uses them.
    """

    __slots__ = ("args", "graph", "index", "op", "value")

    def __init__(
        self, graph: Graph, op: str, args: tuple[Expression, ...], value: Any, index: int
    ) -> None:
        self.graph, self.op, self.args, self.value, self.index = graph, op, args, value, index

    @property
    def is_zero(self) -> bool:
        """Whether it is the number 0."""
        return self.op == "constant" and self.value == 0.0

    def _is(self, number: float) -> bool:
        return self.op == "constant" and self.value == number

    # -------------------------------------------------------------------- arithmetic

    def __add__(self, other: Any) -> Any:
        return _binary(self, other, _add)

    def __radd__(self, other: Any) -> Any:
        return _binary(self, other, lambda a, b: _add(b, a))

    def __sub__(self, other: Any) -> Any:
        return _binary(self, other, _sub)

    def __rsub__(self, other: Any) -> Any:
        return _binary(self, other, lambda a, b: _sub(b, a))

    def __mul__(self, other: Any) -> Any:
        return _binary(self, other, _mul)

    def __rmul__(self, other: Any) -> Any:
        return _binary(self, other, lambda a, b: _mul(b, a))

    def __truediv__(self, other: Any) -> Any:
        return _binary(self, other, _div)

    def __rtruediv__(self, other: Any) -> Any:
        return _binary(self, other, lambda a, b: _div(b, a))

    def __pow__(self, other: Any) -> Any:
        return _binary(self, other, _pow)

    def __rpow__(self, other: Any) -> Any:
        return _binary(self, other, lambda a, b: _pow(b, a))

    def __neg__(self) -> Expression:
        return _neg(self)

    def __pos__(self) -> Expression:
        return self

    # -------------------------------------------------------------------- what cannot be

    def _refuse(self, what: str) -> Any:
        raise TraceError(f"{what} depends on a value and cannot be traced")

    def __bool__(self) -> bool:
        return self._refuse("a branch")

    def __eq__(self, other: object) -> Any:
        return self._refuse("a comparison")

    def __ne__(self, other: object) -> Any:
        return self._refuse("a comparison")

    def __lt__(self, other: Any) -> Any:
        return self._refuse("a comparison")

    __le__ = __gt__ = __ge__ = __lt__

    def __abs__(self) -> Any:
        return self._refuse("abs, which is not differentiable,")

    def __float__(self) -> float:
        return self._refuse("a conversion to float")

    __int__ = __index__ = __complex__ = __float__

    def __hash__(self) -> int:
        return self.index

    def __copy__(self) -> Expression:
        return self  # a value: a second object would not be found by derivatives

    def __deepcopy__(self, memo: Any) -> Expression:
        return self

    # ---------------------------------------------------------- functions, by NumPy's names

    def __getattr__(self, name: str) -> Callable[[], Expression]:
        if name in FUNCTIONS:
            return lambda: _call(name, self)
        raise AttributeError(name)

    def square(self) -> Expression:
        """x²: NumPy's ufunc of that name."""
        return _mul(self, self)

    def reciprocal(self) -> Expression:
        """1/x."""
        return _div(self.graph.constant(1.0), self)

    def conjugate(self) -> Expression:
        """Itself: traced numbers are real."""
        return self

    def arctan2(self, other: Any) -> Any:
        """The angle of (other, self)."""
        return _binary(self, other, lambda a, b: _call2("arctan2", a, b))

    def hypot(self, other: Any) -> Any:
        """√(self² + other²)."""
        return _binary(self, other, lambda a, b: _call2("hypot", a, b))


def _binary(a: Expression, b: Any, rule: Callable[[Expression, Expression], Expression]) -> Any:
    if isinstance(b, np.ndarray) and b.ndim > 0:
        return NotImplemented
    try:
        lifted = a.graph.lift(b)
    except TraceError:
        return NotImplemented
    return rule(a, lifted)


def _both_constant(a: Expression, b: Expression) -> bool:
    return a.op == "constant" and b.op == "constant"


def _add(a: Expression, b: Expression) -> Expression:
    if _both_constant(a, b):
        return a.graph.constant(a.value + b.value)
    if a.is_zero:
        return b
    if b.is_zero:
        return a
    if b.op == "neg":
        return _sub(a, b.args[0])
    if a.index > b.index:  # a sum is found again whichever way round it is written
        a, b = b, a
    return a.graph.make("add", (a, b))


def _sub(a: Expression, b: Expression) -> Expression:
    if _both_constant(a, b):
        return a.graph.constant(a.value - b.value)
    if b.is_zero:
        return a
    if a.is_zero:
        return _neg(b)
    if a is b:
        return a.graph.constant(0.0)
    if b.op == "neg":
        return _add(a, b.args[0])
    return a.graph.make("sub", (a, b))


def _neg(a: Expression) -> Expression:
    if a.op == "constant":
        return a.graph.constant(-a.value)
    if a.op == "neg":
        return a.args[0]
    return a.graph.make("neg", (a,))


def _mul(a: Expression, b: Expression) -> Expression:
    if _both_constant(a, b):
        return a.graph.constant(a.value * b.value)
    for x, y in ((a, b), (b, a)):
        if x.is_zero:
            return x
        if x._is(1.0):
            return y
        if x._is(-1.0):
            return _neg(y)
        if x.op == "neg":
            return _neg(_mul(x.args[0], y))
    if a.index > b.index:
        a, b = b, a
    return a.graph.make("mul", (a, b))


def _div(a: Expression, b: Expression) -> Expression:
    if b.is_zero:
        raise TraceError("a division by the number zero")
    if _both_constant(a, b):
        return a.graph.constant(a.value / b.value)
    if a.is_zero or b._is(1.0):
        return a
    return a.graph.make("div", (a, b))


def _pow(a: Expression, b: Expression) -> Expression:
    if a.op == "constant" or b.op != "constant":
        return _call2("power", a, b)
    exponent = b.value
    if exponent == 0.5:
        return _call("sqrt", a)
    if exponent.is_integer() and abs(exponent) <= 16:
        result, base, left = a.graph.constant(1.0), a, int(abs(exponent))
        while left:
            if left & 1:
                result = _mul(result, base)
            base, left = _mul(base, base), left >> 1
        return result if exponent >= 0 else _div(a.graph.constant(1.0), result)
    return _call2("power", a, b)


def _call(name: str, a: Expression) -> Expression:
    if a.op == "constant":
        with np.errstate(all="ignore"):
            return a.graph.constant(float(getattr(np, name)(a.value)))
    return a.graph.make(name, (a,))


def _call2(name: str, a: Expression, b: Expression) -> Expression:
    """A function of two arguments, by NumPy's name."""
    if _both_constant(a, b):
        with np.errstate(all="ignore"):
            return a.graph.constant(float(getattr(np, name)(a.value, b.value)))
    return a.graph.make(name, (a, b))


#: Derivative of a function of one argument, given the argument x and the value f. The names are
#: NumPy's; the C library has each of them (asin for arcsin and so on).
FUNCTIONS: dict[str, Callable[[Expression, Expression], Expression]] = {
    "sin": lambda x, f: _call("cos", x),
    "cos": lambda x, f: -_call("sin", x),
    "tan": lambda x, f: 1.0 + f * f,
    "arcsin": lambda x, f: 1.0 / _call("sqrt", 1.0 - x * x),
    "arccos": lambda x, f: -1.0 / _call("sqrt", 1.0 - x * x),
    "arctan": lambda x, f: 1.0 / (1.0 + x * x),
    "sinh": lambda x, f: _call("cosh", x),
    "cosh": lambda x, f: _call("sinh", x),
    "tanh": lambda x, f: 1.0 - f * f,
    "exp": lambda x, f: f,
    "expm1": lambda x, f: f + 1.0,
    "log": lambda x, f: 1.0 / x,
    "log1p": lambda x, f: 1.0 / (1.0 + x),
    "sqrt": lambda x, f: 0.5 / f,
}


def derivative(outputs: Iterable[Expression], wrt: Expression) -> list[Expression]:
    """∂output/∂wrt for each output, by the chain rule forward through the graph."""
    outputs = list(outputs)
    graph = wrt.graph
    zero, one = graph.constant(0.0), graph.constant(1.0)
    known: dict[int, Expression] = {}
    for e in reachable(outputs):
        if e is wrt:
            known[e.index] = one
            continue
        slopes = [known[a.index] for a in e.args]
        known[e.index] = zero if all(s.is_zero for s in slopes) else _chain(e, slopes)
    return [known[o.index] for o in outputs]


def _chain(e: Expression, slopes: list[Expression]) -> Expression:
    """Derivative of one operation, given those of its operands."""
    args = e.args
    match e.op:
        case "add":
            return _add(*slopes)
        case "sub":
            return _sub(*slopes)
        case "neg":
            return _neg(slopes[0])
        case "mul":
            return _add(_mul(slopes[0], args[1]), _mul(args[0], slopes[1]))
        case "div":
            return _div(_sub(slopes[0], _mul(e, slopes[1])), args[1])
        case "power":
            base, exponent = args
            by_base = _mul(_mul(exponent, _pow(base, exponent - 1.0)), slopes[0])
            if slopes[1].is_zero:
                return by_base
            return _add(by_base, _mul(_mul(e, _call("log", base)), slopes[1]))
        case "hypot":
            return _div(_add(_mul(args[0], slopes[0]), _mul(args[1], slopes[1])), e)
        case "arctan2":
            y, x = args
            return _div(_sub(_mul(x, slopes[0]), _mul(y, slopes[1])), _add(_mul(x, x), _mul(y, y)))
        case _:
            return _mul(FUNCTIONS[e.op](args[0], e), slopes[0])


def jacobian(outputs: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """∂outputs/∂inputs, (*outputs.shape, *inputs.shape), entries expressions."""
    flat = list(outputs.ravel())
    result = np.empty((len(flat), inputs.size), dtype=object)
    for j, symbol in enumerate(inputs.ravel()):
        result[:, j] = derivative(flat, symbol)
    return result.reshape(*outputs.shape, *inputs.shape)


def reachable(outputs: Iterable[Expression]) -> list[Expression]:
    """Everything the outputs are computed from, operands first."""
    found: dict[int, Expression] = {}
    stack = list(outputs)
    while stack:
        e = stack.pop()
        if e.index not in found:
            found[e.index] = e
            stack.extend(e.args)
    return [found[i] for i in sorted(found)]

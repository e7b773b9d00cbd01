"""Scalars that remember how they were computed: expressions, and the graph that owns them.

Equal expressions of a graph are one object (hash-consing), so common parts are recognised while
code is traced, and derivatives of any order stay small. Three kinds of leaves:

    inputs       symbols by name and entry: graph.inputs("x", (5,))
    constants    numbers that belong to the structure: of our own equations, 0, 1, −1, exponents
    numbers      what the traced code wrote or read as a number: entries of the input "number",
                 their values in `graph.numbers`. The same code with other numbers makes the same
                 graph, so what was compiled for one serves the other.

An expression goes through array code as a number would: NumPy hands arithmetic and functions to
the entries of an array of dtype object (`np.cos` calls `.cos()`); :mod:`.arrays` does the rest.
What a trace cannot record, above all a branch on a value, raises `TraceError`.
"""

from __future__ import annotations

import hashlib
import math
from array import array
from collections.abc import Callable, Iterable
from itertools import chain
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from slipcar.planner.trace import arithmetic as op
from slipcar.planner.trace.derivatives import (
    FUNCTIONS,
    OPERATIONS,
    derivative,
    hessian,
    jacobian,
    reachable,
)
from slipcar.planner.trace.errors import OpaqueError, TraceError

__all__ = [
    "FUNCTIONS",
    "OPERATIONS",
    "Expression",
    "Graph",
    "OpaqueError",
    "TraceError",
    "derivative",
    "hessian",
    "jacobian",
    "reachable",
]

_INDEX = attrgetter("index")
_CODES = {name: code for code, name in enumerate(OPERATIONS)}
_NUMBERS = (int, float, np.integer, np.floating, np.bool_)


class Graph:
    """Owns the expressions of one trace: equal ones are the same object.

    Args:
        parametric: whether numbers of traced code are entries of the input "number"; otherwise
            they are constants, easier to read.

    Attributes:
        size: number of expressions.
        numbers: values of the input "number".
        tracing: whether numbers that are lifted come from traced code; see `lift`.
        tangents: slopes known so far, by the indices of the symbols; see :mod:`.derivatives`.
    """

    def __init__(self, parametric: bool = True) -> None:
        self.parametric, self.tracing = parametric, False
        self.numbers: list[float] = []
        self.tangents: dict[tuple[int, ...], dict[int, dict[int, Expression]]] = {}
        self.size = 0
        self._known: dict[tuple[int, ...], Expression] = {}  # (code, operands' indices)
        self._leaves: dict[Any, Expression] = {}
        self._numbers: list[int] = []  # indices of the numbers

    def make(self, name: str, args: tuple[Expression, ...], value: Any = None) -> Expression:
        """The expression name(args), or the leaf with this value: the known one if there is one.

        Nothing is folded: see :mod:`.arithmetic` for that.
        """
        if not args:
            return self._leaf(name, value)
        key = (_CODES[name], *map(_INDEX, args))
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = Expression(self, name, args, None, self.size)
            self.size += 1
        return known

    def _leaf(self, name: str, value: Any) -> Expression:
        known = self._leaves.get(value)
        if known is None:
            known = self._leaves[value] = Expression(self, name, (), value, self.size)
            self.size += 1
        return known

    def constant(self, value: float) -> Expression:
        """A number that belongs to the structure."""
        # 0.0 and -0.0 are equal as keys, so there is one zero: + 0.0 makes it the positive one.
        return self._leaf("constant", float(value) + 0.0)

    def number(self, value: float, *, special: bool = True) -> Expression:
        """A number that the structure does not depend on.

        Args:
            value: the number.
            special: whether 0, 1 and −1 belong to the structure, where they make it simpler.
        """
        value = float(value)
        if not self.parametric or (special and value in (0.0, 1.0, -1.0)):
            return self.constant(value)
        entry = ("number", len(self.numbers))
        self.numbers.append(value)
        self._numbers.append(self.size)
        self.size += 1
        return Expression(self, "input", (), entry, self.size - 1)

    def inputs(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """An array of symbols: entries of the input `name`, numbered in C order.

        Raises:
            ValueError: for the name "number", which is that of the numbers.
        """
        if name == "number":
            raise ValueError("the input 'number' holds the numbers of traced code")
        flat = [self._leaf("input", (name, i)) for i in range(math.prod(shape))]
        symbols = np.empty(len(flat), dtype=object)
        symbols[:] = flat
        return symbols.reshape(shape)

    def lift(self, value: Any) -> Expression:
        """A number or an expression of this graph, as an expression.

        Numbers become entries of the input "number" while code is traced (see :mod:`.tracing`),
        constants otherwise.

        Raises:
            TraceError: for anything else.
        """
        if type(value) is Expression:
            if value.graph is not self:
                raise TraceError("an expression of another trace was kept and used", "a cache")
            return value
        if isinstance(value, _NUMBERS):
            return self.number(float(value)) if self.tracing else self.constant(float(value))
        if isinstance(value, np.ndarray) and value.ndim == 0:
            return self.lift(value.item())
        if value is None:
            raise TraceError("an entry of an array was left unset (np.empty), or is None", "None")
        kind = type(value).__name__
        raise TraceError(f"{kind} is neither a real number nor an expression", f"a {kind}")

    def choose(self, condition: Expression, a: Expression, b: Expression) -> Expression:
        """The value a where the condition is > 0, else b: also where it is not a number."""
        return op.where(condition, a, b)

    def structure(self, *outputs: Iterable[Expression]) -> bytes:
        """A key of all expressions made so far, in order, but for the values of numbers.

        Args:
            outputs: rows of expressions that count too: which they are, and in which order.
        """
        rows = [tuple(map(_INDEX, row)) for row in outputs]
        text = repr(([(value, leaf.index) for value, leaf in self._leaves.items()], rows))
        key = hashlib.blake2b(text.encode(), digest_size=16)
        key.update(array("q", self._numbers))
        key.update(b"|")
        key.update(array("q", chain.from_iterable(self._known)))
        return key.digest()


def _operator(
    rule: Callable[[Expression, Expression], Expression], *, swapped: bool = False
) -> Callable[[Expression, Any], Any]:
    """A binary operator of Python; NotImplemented for what is no number."""

    def apply(self: Expression, other: Any) -> Any:
        if type(other) is not Expression:
            if not isinstance(other, _NUMBERS):
                return NotImplemented
            other = self.graph.lift(other)
        elif other.graph is not self.graph:
            other = self.graph.lift(other)
        return rule(other, self) if swapped else rule(self, other)

    return apply


def _power(base: Expression, exponent: Any) -> Any:
    """Base ** exponent: exponents that are whole or half belong to the structure."""
    if isinstance(exponent, _NUMBERS):
        value = float(exponent)
        if abs(value) <= 16 and (2.0 * value).is_integer():
            return op.power(base, base.graph.constant(value))
    elif not isinstance(exponent, Expression):
        return NotImplemented
    return op.power(base, base.graph.lift(exponent))


def _refusal(what: str, instead: str, kind: type[TraceError] = TraceError) -> Callable[..., Any]:
    def refuse(self: Expression, *args: Any) -> NoReturn:
        raise kind(f"{what} depends on a value and cannot be traced: {instead}", what)

    return refuse


_BRANCH = "write np.where(condition, a, b); np.maximum, np.minimum, np.clip for max, min, limits"
_PLAIN = "np.sin(x) for math.sin(x); np.zeros_like(x) or dtype=x.dtype for arrays to be filled"


class Expression:
    """A scalar: how it is computed from inputs and constants.

    Attributes:
        graph: the trace it belongs to.
        op: "input", "constant", or a key of :data:`.derivatives.OPERATIONS`.
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
        """Whether it is the constant 0."""
        return self.op == "constant" and self.value == 0.0

    def __repr__(self) -> str:
        leaf = self.op in ("input", "constant")
        return f"<{self.value if leaf else self.op} #{self.index}>"

    # As a scalar among arrays.
    shape = ()
    ndim = 0
    size = 1
    dtype = np.dtype(object)

    __add__, __radd__ = _operator(op.add), _operator(op.add, swapped=True)
    __sub__, __rsub__ = _operator(op.sub), _operator(op.sub, swapped=True)
    __mul__, __rmul__ = _operator(op.mul), _operator(op.mul, swapped=True)
    __truediv__, __rtruediv__ = _operator(op.div), _operator(op.div, swapped=True)
    __pow__, __rpow__ = _power, _operator(op.power, swapped=True)
    __gt__, __lt__ = _operator(op.greater), _operator(op.greater, swapped=True)
    __ge__, __le__ = _operator(op.greater_equal), _operator(op.greater_equal, swapped=True)
    __eq__ = _operator(op.equal)
    __ne__ = _operator(lambda a, b: op.negation(op.equal(a, b)))
    arctan2 = _operator(lambda a, b: op.call("arctan2", a, b))
    hypot = _operator(lambda a, b: op.call("hypot", a, b))

    def __hash__(self) -> int:
        return self.index

    def __neg__(self) -> Expression:
        return op.neg(self)

    def __pos__(self) -> Expression:
        return self

    def __abs__(self) -> Expression:
        return op.absolute(self)

    def __floor__(self) -> Expression:
        return op.call("floor", self)

    def __ceil__(self) -> Expression:
        return op.neg(op.call("floor", op.neg(self)))

    __bool__ = _refusal("a branch (if, and, or, while)", _BRANCH)
    __float__ = _refusal("float()", _PLAIN, OpaqueError)
    __int__ = _refusal("int()", "np.floor(x) for rounding; a table is np.interp", OpaqueError)
    __complex__ = _refusal("complex()", _PLAIN, OpaqueError)
    __index__ = _refusal("an index", "np.interp or np.where for tables", OpaqueError)
    __round__ = _refusal("round()", "np.floor(x + 0.5)")

    if TYPE_CHECKING:  # FUNCTIONS are methods, see below

        def __getattr__(self, name: str) -> Callable[[], Expression]: ...

    def __copy__(self) -> Expression:
        return self  # a value: a second object would not be recognised by derivatives

    def __deepcopy__(self, memo: Any) -> Expression:
        return self

    # NumPy's ufuncs ask the entries of an array of dtype object for methods of their names.

    def square(self) -> Expression:
        """x²."""
        return op.mul(self, self)

    def reciprocal(self) -> Expression:
        """1/x."""
        return op.div(self.graph.constant(1.0), self)

    def conjugate(self) -> Expression:
        """Itself: traced numbers are real."""
        return self

    def item(self) -> Expression:
        """Itself, as of an array of one entry."""
        return self


def _method(name: str) -> Callable[[Expression], Expression]:
    rule = {"sqrt": op.sqrt, "abs": op.absolute}.get(name)
    if rule is not None:
        return lambda self: rule(self)
    return lambda self: op.call(name, self)


for _name in FUNCTIONS:
    setattr(Expression, _name, _method(_name))

"""Scalars that remember how they were computed: expressions, and the graph that owns them.

Equal expressions of a graph are one object (hash-consing), so common parts are recognised while
code is traced, and derivatives of any order stay small. Three kinds of leaves:

    inputs       symbols by name and entry: graph.inputs("x", (5,))
    constants    numbers that belong to the structure: of our own equations, 0, 1, −1, exponents
    numbers      all others of the traced code: entries of the input "number", with their values in
                 `graph.numbers`. Code compiled for some serves the same functions with others.

An expression goes through array code as a number would: NumPy hands arithmetic and functions to
the entries of an array of dtype object (`np.cos` calls `.cos()`). What a trace cannot record,
above all a branch on a value, raises `TraceError`.
"""

from __future__ import annotations

import functools
import hashlib
import math
import operator
from array import array
from collections.abc import Callable, Iterable
from itertools import chain
from typing import Any, NoReturn

import numpy as np

from slipcar.planner.trace import arithmetic as op
from slipcar.planner.trace.derivatives import FUNCTIONS, OPERATIONS, jacobian, reachable
from slipcar.planner.trace.errors import OpaqueError, TraceError

__all__ = ["Expression", "Graph", "OpaqueError", "TraceError", "jacobian", "reachable"]

_INDEX = operator.attrgetter("index")
_CODES = {name: code for code, name in enumerate(OPERATIONS)}
_NUMBERS = (int, float, np.integer, np.floating, np.bool_)
#: Values of the operations that NumPy has no function of that name for.
_VALUES: dict[str, Any] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "neg": operator.neg, "abs": abs, "erfc": math.erfc,
}  # fmt: skip


class Graph:
    """Owns the expressions of one trace: equal ones are the same object."""

    def __init__(self) -> None:
        self.size = 0  # number of expressions
        self.tracing = False  # whether numbers that are lifted come from traced code
        self.numbers: list[float] = []  # values of the input "number"
        # Slopes known so far, by the indices of the symbols; see .derivatives.
        self.tangents: dict[tuple[int, ...], dict[int, dict[int, Expression]]] = {}
        self._known: dict[tuple[int, ...], Expression] = {}  # (code, operands' indices)
        self._leaves: dict[Any, Expression] = {}
        self._numbers: list[int] = []  # indices of the numbers

    def make(self, name: str, args: tuple[Expression, ...], value: Any = None) -> Expression:
        """The expression name(args), or the leaf with this value: the known one if there is one.

        Operations on constants alone are computed; all other folding is :mod:`.arithmetic`'s.
        """
        if not args:
            return self._leaf(name, value)
        key = (_CODES[name], *map(_INDEX, args))
        known = self._known.get(key)
        if known is None:
            for a in args:
                if a.op != "constant":
                    break
            else:
                with np.errstate(all="ignore"):
                    function = _VALUES.get(name) or getattr(np, name)
                    return self.constant(function(*(a.value for a in args)))
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
        """A number that the structure does not depend on; but on 0, 1 and −1, if special."""
        value = float(value)
        if special and value in (0.0, 1.0, -1.0):
            return self.constant(value)
        entry = ("number", len(self.numbers))
        self.numbers.append(value)
        self._numbers.append(self.size)
        self.size += 1
        return Expression(self, "input", (), entry, self.size - 1)

    def inputs(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """An array of symbols: entries of the input `name`, numbered in C order."""
        symbols = np.empty(math.prod(shape), dtype=object)
        symbols[:] = [self._leaf("input", (name, i)) for i in range(len(symbols))]
        return symbols.reshape(shape)

    def lift(self, value: Any) -> Expression:
        """A number or an expression of this graph, as an expression; a TraceError for all else.

        Numbers become entries of the input "number" while code is traced, constants otherwise.
        """
        if type(value) is Expression:
            if value.graph is not self:
                raise TraceError("an expression of another trace was kept and used", "a cache")
            return value
        if isinstance(value, _NUMBERS):
            return (self.number if self.tracing else self.constant)(float(value))
        if isinstance(value, np.ndarray) and value.ndim == 0:
            return self.lift(value.item())
        if value is None:
            raise TraceError("an entry of an array was left unset (np.empty), or is None", "None")
        kind = type(value).__name__
        raise TraceError(f"{kind} is neither a real number nor an expression", f"a {kind}")

    def structure(self, *outputs: Iterable[Expression]) -> bytes:
        """A key of all expressions made so far and of rows of outputs, but not of the numbers."""
        rows = [tuple(map(_INDEX, row)) for row in outputs]
        text = repr(([(value, leaf.index) for value, leaf in self._leaves.items()], rows))
        key = hashlib.blake2b(text.encode(), digest_size=16)
        key.update(array("q", self._numbers).tobytes() + b"|")
        key.update(array("q", chain.from_iterable(self._known)))
        return key.digest()


def _operator(rule: Callable[..., Expression]) -> tuple[Any, Any]:
    """A binary operator of Python and its reflection; NotImplemented for what is no number."""

    def apply(self: Expression, other: Any) -> Any:
        if type(other) is Expression and other.graph is self.graph:
            return rule(self, other)
        if type(other) is Expression or isinstance(other, _NUMBERS):
            return rule(self, self.graph.lift(other))
        return NotImplemented

    def reflected(self: Expression, other: Any) -> Any:
        if type(other) is Expression or isinstance(other, _NUMBERS):
            return rule(self.graph.lift(other), self)
        return NotImplemented

    return apply, reflected


def _power(base: Expression, exponent: Any) -> Any:
    """Base ** exponent: exponents that are whole or half belong to the structure."""
    if isinstance(exponent, _NUMBERS):
        value = float(exponent)
        if abs(value) <= 16 and (2.0 * value).is_integer():
            return op.power(base, base.graph.constant(value))
    elif not isinstance(exponent, Expression):
        return NotImplemented
    return op.power(base, base.graph.lift(exponent))


def _of_conditions(rule: Callable[..., Expression]) -> Callable[..., Expression]:
    """A rule for &, | and ~: on conditions alone."""

    def apply(*args: Expression) -> Expression:
        if not all(map(op.is_condition, args)):
            raise TraceError("&, |, ^ and ~ are for conditions such as x > 0", "a bit operation")
        return rule(*args)

    return apply


def _refusal(what: str, instead: str, kind: type[TraceError] = TraceError) -> Callable[..., Any]:
    def refuse(self: Expression, *args: Any) -> NoReturn:
        raise kind(f"{what} depends on a value and cannot be traced: {instead}", what)

    return refuse


_BRANCH = "write np.where(condition, a, b); np.maximum, np.minimum, np.clip for max, min, limits"
_PLAIN = "np.sin(x) for math.sin(x); np.zeros_like(x) or dtype=x.dtype for arrays to be filled"


class Expression:
    """A scalar: how it is computed from inputs and constants of its graph.

    `op` is "input", "constant" or a key of :data:`.derivatives.OPERATIONS`, `args` its operands;
    `value` is (name, entry) of an input, the number of a constant; `index` its position in the
    order of creation: operands come before what uses them.
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
        return f"<{self.op if self.args else self.value} #{self.index}>"

    shape, ndim, size, dtype = (), 0, 1, np.dtype(object)  # as of a scalar among arrays
    __add__, __radd__ = _operator(op.add)
    __sub__, __rsub__ = _operator(op.sub)
    __mul__, __rmul__ = _operator(op.mul)
    __truediv__, __rtruediv__ = _operator(op.div)
    __floordiv__, __rfloordiv__ = _operator(lambda a, b: (a / b).floor())
    __mod__, __rmod__ = _operator(lambda a, b: a - b * (a / b).floor())
    __pow__, __rpow__ = _power, _operator(op.power)[1]
    __gt__, __lt__ = _operator(op.greater)
    __ge__, __le__ = _operator(functools.partial(op.call, "greater_equal"))
    __eq__ = _operator(op.equal)[0]
    __ne__ = _operator(lambda a, b: op.negation(op.equal(a, b)))[0]
    __and__, __rand__ = _operator(_of_conditions(op.mul))
    __or__, __ror__ = _operator(_of_conditions(op.maximum))
    __xor__, __rxor__ = _operator(_of_conditions(lambda a, b: a != b))
    __neg__, __abs__, __invert__ = op.neg, op.absolute, _of_conditions(op.negation)
    arctan2 = _operator(functools.partial(op.call, "arctan2"))[0]
    hypot = _operator(functools.partial(op.call, "hypot"))[0]

    def __hash__(self) -> int:
        return self.index

    def __floor__(self) -> Expression:
        return op.call("floor", self)

    def __ceil__(self) -> Expression:
        return op.neg(op.call("floor", op.neg(self)))

    def __trunc__(self) -> Expression:
        return op.where(self > 0.0, self.__floor__(), self.__ceil__())

    def item(self, *args: Any) -> Expression:
        """Itself: a value, to be copied by nobody, as derivatives would not know the copy."""
        return self

    __pos__ = __copy__ = __deepcopy__ = conjugate = item

    __bool__ = _refusal("a branch (if, and, or, while)", _BRANCH)
    __float__ = _refusal("float()", _PLAIN, OpaqueError)
    __int__ = _refusal("int()", "np.floor(x) for rounding; a table is np.interp", OpaqueError)
    __complex__ = _refusal("complex()", _PLAIN, OpaqueError)
    __index__ = _refusal("an index", "np.interp or np.where for tables", OpaqueError)
    __round__ = _refusal("round()", "np.floor(x + 0.5)")


# NumPy's functions ask the entries of an array of dtype object for methods of their names.
for _name in FUNCTIONS:
    _rule: Any = {"sqrt": op.sqrt, "abs": op.absolute}.get(_name)
    setattr(Expression, _name, _rule or (lambda self, name=_name: self.graph.make(name, (self,))))

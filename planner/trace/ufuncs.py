"""NumPy's ufuncs on arrays of expressions: for each a loop over objects."""

from __future__ import annotations

import functools
import math
import operator
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from slipcar.planner.trace import arithmetic as op
from slipcar.planner.trace.derivatives import FUNCTIONS
from slipcar.planner.trace.graph import Expression

#: NumPy's own loops over objects do these, by Python's operators.
_NATIVE = """
    add subtract multiply divide negative positive matmul vecdot matvec vecmat absolute square
    reciprocal conjugate floor_divide remainder
"""
#: By NumPy's and SciPy's names: what a ufunc does to expressions.
_RULES: dict[str, Callable[..., Any]] = {
    **{name: getattr(Expression, name) for name in (*FUNCTIONS, "arctan2", "hypot")},
    "ceil": Expression.__ceil__,
    "trunc": Expression.__trunc__,
    "fabs": op.absolute,
    **dict.fromkeys(("deg2rad", "radians"), lambda a: a * (math.pi / 180.0)),
    **dict.fromkeys(("rad2deg", "degrees"), lambda a: a * (180.0 / math.pi)),
    "fmod": lambda a, b: a - b * (a / b).__trunc__(),
    **dict.fromkeys(("maximum", "fmax"), op.maximum),
    **dict.fromkeys(("minimum", "fmin"), op.minimum),
    "clip": lambda a, low, high: op.minimum(op.maximum(a, low), high),
    "copysign": lambda a, b: op.where(b >= 0.0, abs(a), -abs(a)),
    "heaviside": lambda a, middle: op.where(a == 0.0, middle, a > 0.0),
    "logaddexp": lambda a, b: op.where(a > b, a + (b - a).exp().log1p(), b + (a - b).exp().log1p()),
    "erf": lambda a: 1.0 - a.erfc(),
    "expit": lambda a: op.where(a > 0.0, 1.0 / (1.0 + (-a).exp()), a.exp() / (1.0 + a.exp())),
    "xlogy": lambda a, b: a * b.log(),
}
#: Those whose results are conditions.
_CONDITIONS: dict[str, Callable[..., Any]] = {
    "greater": operator.gt,
    "greater_equal": operator.ge,
    "less": operator.lt,
    "less_equal": operator.le,
    "equal": operator.eq,
    "not_equal": operator.ne,
    "logical_and": lambda a, b: op.truth(a) & op.truth(b),
    "logical_or": lambda a, b: op.truth(a) | op.truth(b),
    "logical_xor": lambda a, b: op.truth(a) ^ op.truth(b),
    "logical_not": lambda a: ~op.truth(a),
    "bitwise_and": operator.and_,
    "bitwise_or": operator.or_,
    "bitwise_xor": operator.xor,
    "invert": operator.invert,
}
_umath: Any = (getattr(np, "_core", None) or np.core).umath  # the former from NumPy 2 on


def loop(rule: Callable[..., Any], plain: Callable[..., Any], arity: int) -> Any:
    """A rule on expressions as a ufunc of objects, `plain` where all operands are numbers."""

    def apply(*args: Any) -> Any:
        for a in args:
            if type(a) is Expression:
                return rule(a) if arity == 1 else rule(*map(a.graph.lift, args))
        return plain(*map(float, args))

    # The identity None says that the order of a reduction does not matter.
    return np.frompyfunc(apply, arity, 1, identity=None)


#: np.where of three arguments, which is no ufunc.
WHERE = loop(lambda c, a, b: op.where(op.truth(c), a, b), lambda c, a, b: a if c else b, 3)


class Ufunc(NamedTuple):
    """How a ufunc goes through arrays of expressions."""

    loop: Any  # a ufunc of objects
    condition: bool = False  # whether its results are conditions
    lifts: bool = True  # whether plain operands are made expressions before; exponents are not


@functools.lru_cache(maxsize=512)
def recorded(ufunc: Any) -> Ufunc | None:
    """How a ufunc is recorded; None if it cannot be."""
    name = ufunc.__name__
    places = (np, _umath, sys.modules.get("scipy.special"))
    if not any(ufunc is getattr(place, name, None) for place in places):
        # np.frompyfunc of Python code meets the entries.
        return Ufunc(ufunc, lifts=False) if set("".join(ufunc.types)) <= set("O->") else None
    if name in _NATIVE.split():
        return Ufunc(ufunc)
    if name in ("power", "float_power"):
        return Ufunc(np.frompyfunc(operator.pow, 2, 1), lifts=False)
    rule = _RULES.get(name) or _CONDITIONS.get(name)
    return rule and Ufunc(loop(rule, ufunc, ufunc.nin), name in _CONDITIONS)

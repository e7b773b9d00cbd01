"""NumPy's ufuncs on expressions: what each does to scalars, composed of a graph's operations.

A rule takes expressions; in a loop over arrays of dtype object it also meets plain numbers, which
are lifted where they meet an expression and go to NumPy's own function where they do not.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.trace import arithmetic as op
from slipcar.planner.trace.graph import Expression, TraceError


@dataclasses.dataclass(frozen=True)
class Ufunc:
    """How a ufunc goes through arrays of expressions.

    Attributes:
        loop: a ufunc of objects.
        condition: whether it answers a question: its results are conditions.
        lifts: whether plain operands are made expressions before; exponents are not.
    """

    loop: Any
    condition: bool = False
    lifts: bool = True


def mixed(rule: Callable[..., Any], plain: Callable[..., Any], arity: int, outs: int = 1) -> Any:
    """A rule on expressions as a ufunc of objects, `plain` where all operands are numbers."""

    def single(a: Any) -> Any:
        return rule(a) if type(a) is Expression else plain(_float(a))

    def several(*args: Any) -> Any:
        for a in args:
            if type(a) is Expression:
                return rule(*map(a.graph.lift, args))
        return plain(*map(_float, args))

    return np.frompyfunc(single if arity == 1 else several, arity, outs)


def _float(a: Any) -> Any:
    return float(a) if type(a) is int else a


def _lift(like: Expression, value: float) -> Expression:
    return like.graph.constant(value)


def _function(name: str) -> Callable[[Expression], Expression]:
    return lambda a: op.call(name, a)


def floor(a: Expression) -> Expression:
    """The largest whole number ≤ a."""
    return op.call("floor", a)


def ceil(a: Expression) -> Expression:
    """The smallest whole number ≥ a."""
    return op.neg(floor(op.neg(a)))


def trunc(a: Expression) -> Expression:
    """The whole part, rounded towards 0."""
    return op.where(op.greater(a, _lift(a, 0.0)), floor(a), ceil(a))


def floor_divide(a: Expression, b: Expression) -> Expression:
    """⌊a/b⌋."""
    return floor(op.div(a, b))


def remainder(a: Expression, b: Expression) -> Expression:
    """The remainder a − b ⌊a/b⌋, of the sign of b."""
    return op.sub(a, op.mul(b, floor_divide(a, b)))


def fmod(a: Expression, b: Expression) -> Expression:
    """The remainder a − b trunc(a/b), of the sign of a."""
    return op.sub(a, op.mul(b, trunc(op.div(a, b))))


def heaviside(a: Expression, middle: Expression) -> Expression:
    """0 below 0, 1 above, `middle` there."""
    zero = _lift(a, 0.0)
    return op.where(op.equal(a, zero), middle, op.greater(a, zero))


def copysign(a: Expression, b: Expression) -> Expression:
    """|a| with the sign of b; −0 counts as positive."""
    size = op.absolute(a)
    return op.where(op.greater_equal(b, _lift(b, 0.0)), size, op.neg(size))


def clip(a: Expression, low: Expression, high: Expression) -> Expression:
    """The value a limited to [low, high]."""
    return op.minimum(op.maximum(a, low), high)


def logaddexp(a: Expression, b: Expression) -> Expression:
    """log(eᵃ + eᵇ)."""
    d = op.sub(a, b)
    above = op.add(a, op.call("log1p", op.call("exp", op.neg(d))))
    below = op.add(b, op.call("log1p", op.call("exp", d)))
    return op.where(op.greater(d, _lift(a, 0.0)), above, below)


def expit(a: Expression) -> Expression:
    """1/(1 + e⁻ᵃ)."""
    one = _lift(a, 1.0)
    above = op.div(one, op.add(one, op.call("exp", op.neg(a))))
    exponential = op.call("exp", a)
    below = op.div(exponential, op.add(one, exponential))
    return op.where(op.greater(a, _lift(a, 0.0)), above, below)


def erf(a: Expression) -> Expression:
    """The error function; near 0 by its series: 1 − erfc(a) would lose digits there."""
    square, series = op.mul(a, a), _lift(a, 0.0)
    for k in reversed(range(13)):
        term = _lift(a, 2.0 / math.sqrt(math.pi) * (-1) ** k / (math.factorial(k) * (2 * k + 1)))
        series = op.add(term, op.mul(square, series))
    far = op.sub(_lift(a, 1.0), op.call("erfc", a))
    return op.where(op.greater(_lift(a, 0.5), op.absolute(a)), op.mul(a, series), far)


def sinc(a: Expression) -> Expression:
    """sin(πa)/(πa); near 0 by its series, so that derivatives are right there, too."""
    y = op.mul(_lift(a, math.pi), a)
    square, series = op.mul(y, y), _lift(a, 0.0)
    for k in reversed(range(10)):
        series = op.add(_lift(a, (-1) ** k / math.factorial(2 * k + 1)), op.mul(square, series))
    far = op.div(op.call("sin", y), y)
    return op.where(op.greater(_lift(a, 1.0), op.absolute(y)), series, far)


def not_equal(a: Expression, b: Expression) -> Expression:
    """Whether a ≠ b."""
    return op.negation(op.equal(a, b))


def logical_and(a: Expression, b: Expression) -> Expression:
    """Whether both hold."""
    return op.mul(op.truth(a), op.truth(b))


def logical_or(a: Expression, b: Expression) -> Expression:
    """Whether one of them holds."""
    return op.maximum(op.truth(a), op.truth(b))


def logical_xor(a: Expression, b: Expression) -> Expression:
    """Whether one of them holds, but not both."""
    return not_equal(op.truth(a), op.truth(b))


def logical_not(a: Expression) -> Expression:
    """Whether it does not hold."""
    return op.negation(op.truth(a))


def _bitwise(rule: Callable[..., Expression]) -> Callable[..., Expression]:
    """A rule for &, |, ^ and ~: on conditions alone."""

    def apply(*args: Expression) -> Expression:
        if not all(map(op.is_condition, args)):
            raise TraceError("&, |, ^ and ~ are for conditions such as x > 0", "a bit operation")
        return rule(*args)

    return apply


def _power(a: Any, b: Any) -> Any:
    return a**b


def _where(c: Expression, a: Expression, b: Expression) -> Expression:
    return op.where(op.truth(c), a, b)


#: np.where of three arguments, which is no ufunc.
WHERE = Ufunc(mixed(_where, lambda c, a, b: a if c else b, 3))
#: Numbers as conditions: whether they differ from 0.
TRUTH = mixed(op.truth, bool, 1)
#: np.sinc, which is none either.
SINC = Ufunc(mixed(sinc, np.sinc, 1))

_SAME_NAME = """
    arccos arccosh arcsin arcsinh arctan arctanh cbrt cos cosh exp exp2 expm1 floor log log10 log1p
    log2 sign sin sinh tan tanh
"""
_RULES: list[tuple[Any, Callable[..., Any]]] = [
    *((getattr(np, name), _function(name)) for name in _SAME_NAME.split()),
    (np.sqrt, op.sqrt),
    (np.absolute, op.absolute),
    (np.fabs, op.absolute),
    (np.square, lambda a: op.mul(a, a)),
    (np.reciprocal, lambda a: op.div(_lift(a, 1.0), a)),
    (np.conjugate, lambda a: a),
    (np.deg2rad, lambda a: op.mul(_lift(a, math.pi / 180.0), a)),
    (np.radians, lambda a: op.mul(_lift(a, math.pi / 180.0), a)),
    (np.rad2deg, lambda a: op.mul(_lift(a, 180.0 / math.pi), a)),
    (np.degrees, lambda a: op.mul(_lift(a, 180.0 / math.pi), a)),
    (np.ceil, ceil),
    (np.trunc, trunc),
    (np.arctan2, lambda a, b: op.call("arctan2", a, b)),
    (np.hypot, lambda a, b: op.call("hypot", a, b)),
    (np.maximum, op.maximum),
    (np.minimum, op.minimum),
    (np.fmax, op.maximum),
    (np.fmin, op.minimum),
    (np.copysign, copysign),
    (np.heaviside, heaviside),
    (np.logaddexp, logaddexp),
    (np.floor_divide, floor_divide),
    (np.remainder, remainder),
    (np.fmod, fmod),
]
_CONDITIONS: list[tuple[Any, Callable[..., Any]]] = [
    (np.greater, op.greater),
    (np.greater_equal, op.greater_equal),
    (np.less, lambda a, b: op.greater(b, a)),
    (np.less_equal, lambda a, b: op.greater_equal(b, a)),
    (np.equal, op.equal),
    (np.not_equal, not_equal),
    (np.logical_and, logical_and),
    (np.logical_or, logical_or),
    (np.logical_xor, logical_xor),
    (np.logical_not, logical_not),
    (np.bitwise_and, _bitwise(logical_and)),
    (np.bitwise_or, _bitwise(logical_or)),
    (np.bitwise_xor, _bitwise(logical_xor)),
    (np.invert, _bitwise(logical_not)),
]
#: Ufuncs that are recorded. NumPy's own loops over objects do the arithmetic.
UFUNCS: dict[Any, Ufunc] = {
    **{
        ufunc: Ufunc(ufunc)
        for ufunc in (np.add, np.subtract, np.multiply, np.divide, np.negative, np.positive)
    },
    np.matmul: Ufunc(np.matmul),
    **{ufunc: Ufunc(mixed(rule, ufunc, ufunc.nin)) for ufunc, rule in _RULES},
    **{ufunc: Ufunc(mixed(rule, ufunc, ufunc.nin), True) for ufunc, rule in _CONDITIONS},
    np.power: Ufunc(np.frompyfunc(_power, 2, 1), lifts=False),
    np.float_power: Ufunc(np.frompyfunc(_power, 2, 1), lifts=False),
    np.divmod: Ufunc(
        mixed(lambda a, b: (floor_divide(a, b), remainder(a, b)), np.divmod, 2, outs=2)
    ),
}
for _name in ("vecdot", "matvec", "vecmat"):  # from NumPy 2 on
    if hasattr(np, _name):
        UFUNCS[getattr(np, _name)] = Ufunc(getattr(np, _name))
_core: Any = getattr(np, "_core", None) or getattr(np, "core", None)  # the former from NumPy 2 on
UFUNCS[_core.umath.clip] = Ufunc(mixed(clip, np.clip, 3))
#: SciPy's, by name: scipy.special is looked at only where the traced code has imported it.
_SPECIAL: dict[str, Callable[..., Any]] = {
    "erf": erf,
    "erfc": _function("erfc"),
    "expit": expit,
    "xlogy": lambda a, b: op.mul(a, op.call("log", b)),
}


def recorded(ufunc: Any) -> Ufunc | None:
    """How a ufunc is recorded; None if it cannot be."""
    if ufunc in UFUNCS:
        return UFUNCS[ufunc]
    special: Any = sys.modules.get("scipy.special")
    name = ufunc.__name__
    if name in _SPECIAL and special is not None and ufunc is getattr(special, name):
        UFUNCS[ufunc] = Ufunc(mixed(_SPECIAL[name], ufunc, ufunc.nin))
        return UFUNCS[ufunc]
    if ufunc.types == ["O" * ufunc.nin + "->" + "O" * ufunc.nout]:
        return Ufunc(ufunc, lifts=False)  # np.frompyfunc of Python code: it meets the entries
    return None

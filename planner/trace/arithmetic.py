"""Operations on expressions, folded as they are made: 0 + a is a, a − a is 0, √(a·a) is |a|.

Every function takes expressions of one graph and returns one. Nothing here changes a value beyond
rounding wherever the code that was traced is finite; the sign of a zero may get lost, and 0 · a is
0 even for a = ∞. A condition is an expression that is 1 where it holds and 0 elsewhere.
"""

from __future__ import annotations

from typing import Any

from slipcar.planner.trace.errors import TraceError

Expression = Any  # graph.Expression, which is built on this module


def call(name: str, *args: Expression) -> Expression:
    """An operation by its name, as it is."""
    return args[0].graph.make(name, args)


def _is(a: Expression, number: float) -> bool:
    return a.op == "constant" and a.value == number


def _is_number(a: Expression) -> bool:
    return a.op == "constant" or (a.op == "input" and a.value[0] == "number")


def add(a: Expression, b: Expression) -> Expression:
    """The sum a + b."""
    if a.op == "constant" and a.value == 0.0:
        return b
    if b.op == "constant" and b.value == 0.0:
        return a
    if b.op == "neg":
        return sub(a, b.args[0])
    if a.op == "neg":
        return sub(b, a.args[0])
    # A sum is recognised whichever way round it is written.
    return a.graph.make("add", (a, b) if a.index < b.index else (b, a))


def sub(a: Expression, b: Expression) -> Expression:
    """The difference a − b."""
    if b.op == "constant" and b.value == 0.0:
        return a
    if a.op == "constant" and a.value == 0.0:
        return neg(b)
    if a is b:
        return a.graph.constant(0.0)
    return add(a, b.args[0]) if b.op == "neg" else a.graph.make("sub", (a, b))


def neg(a: Expression) -> Expression:
    """The opposite −a."""
    return a.args[0] if a.op == "neg" else a.graph.make("neg", (a,))


def mul(a: Expression, b: Expression) -> Expression:
    """The product a b."""
    if a.op == "constant":
        a, b = b, a
    if b.op == "constant" and b.value in (0.0, 1.0, -1.0):
        return b if b.value == 0.0 else a if b.value == 1.0 else neg(a)
    if a.op == "neg":
        return neg(mul(a.args[0], b))
    if b.op == "neg":
        return neg(mul(a, b.args[0]))
    return a.graph.make("mul", (a, b) if a.index < b.index else (b, a))


def div(a: Expression, b: Expression) -> Expression:
    """The quotient a / b; a TraceError if b is the number zero."""
    if b.op == "constant" and b.value in (0.0, 1.0, -1.0):
        if b.value == 0.0:
            raise TraceError("a division by the number zero", "a division by zero")
        return a if b.value == 1.0 else neg(a)
    if a.op == "constant" and a.value == 0.0:
        return a
    if a.op == "neg":
        return neg(div(a.args[0], b))
    return neg(div(a, b.args[0])) if b.op == "neg" else a.graph.make("div", (a, b))


def power(a: Expression, b: Expression) -> Expression:
    """The power a ** b; products where b is a whole constant, √ where it is one half."""
    if a.op == "constant" or b.op != "constant":
        return call("power", a, b)
    exponent, constant = b.value, a.graph.constant
    if exponent == 0.5:
        return sqrt(a)
    if exponent.is_integer() and abs(exponent) <= 16:
        result, base, left = constant(1.0), a, int(abs(exponent))
        while left:
            if left & 1:
                result = mul(result, base)
            base, left = mul(base, base), left >> 1
        return result if exponent >= 0 else div(constant(1.0), result)
    if 0.0 < exponent <= 16 and (2.0 * exponent).is_integer() and vanishes_flat(a):
        # a is not negative, and its derivatives at 0 are those of a product.
        return mul(power(a, constant(exponent - 0.5)), sqrt(a))
    return call("power", a, b)


def sqrt(a: Expression) -> Expression:
    """The root √a; of a square it is the absolute value."""
    if a.op == "mul" and a.args[0] is a.args[1]:
        return absolute(a.args[0])
    return call("sqrt", a)


def absolute(a: Expression) -> Expression:
    """The absolute value |a|."""
    if a.op == "neg":
        return absolute(a.args[0])
    if a.op in ("abs", "sqrt", "exp", "hypot") or (a.op == "mul" and a.args[0] is a.args[1]):
        return a
    return call("abs", a)


def maximum(a: Expression, b: Expression, name: str = "maximum") -> Expression:
    """The larger of two; where they are equal its slope is that of the number or the second."""
    return a if a is b else call(name, b, a) if _is_number(a) else call(name, a, b)


def minimum(a: Expression, b: Expression) -> Expression:
    """The smaller of two; as `maximum`."""
    return maximum(a, b, "minimum")


def greater(a: Expression, b: Expression) -> Expression:
    """Whether a > b."""
    return a.graph.constant(0.0) if a is b else call("greater", a, b)


def equal(a: Expression, b: Expression) -> Expression:
    """Whether a = b."""
    return call("equal", a, b) if a.index < b.index else call("equal", b, a)


def is_condition(a: Expression) -> bool:
    """Whether an expression is made as a condition: of comparisons, and, or, not."""
    if a.op in ("greater", "greater_equal", "equal"):
        return True
    if a.op in ("mul", "maximum", "minimum"):
        return is_condition(a.args[0]) and is_condition(a.args[1])
    if a.op == "sub":
        return _is(a.args[0], 1.0) and is_condition(a.args[1])
    return _is(a, 0.0) or _is(a, 1.0)


def truth(a: Expression) -> Expression:
    """Whether a ≠ 0, as Python takes numbers for conditions."""
    return a if is_condition(a) else negation(equal(a, a.graph.constant(0.0)))


def negation(a: Expression) -> Expression:
    """Whether a condition does not hold."""
    if a.op == "sub" and _is(a.args[0], 1.0):
        return a.args[1]
    return sub(a.graph.constant(1.0), a)


def where(c: Expression, a: Expression, b: Expression) -> Expression:
    """The value a where c > 0, else b: also where c is not a number."""
    if a is b:
        return a
    if c.op == "constant":
        return a if c.value > 0.0 else b
    if c.op == "sub" and is_condition(c):
        return where(c.args[1], b, a)
    if _is(a, 1.0) and _is(b, 0.0) and is_condition(c):
        return c
    return c.graph.make("where", (c, a, b))


def vanishes_flat(a: Expression) -> bool:
    """Whether a is nowhere negative, and its derivative (as we define it) is 0 where a is 0.

    So it is for sums of squares, absolute values and max(0, ·). The derivative of a root of such
    is taken as 0 at its kink, one of its subgradients, where the formula would give 0/0.
    """
    if a.op == "add":
        return vanishes_flat(a.args[0]) and vanishes_flat(a.args[1])
    if a.op in ("div", "sqrt"):
        return vanishes_flat(a.args[0])
    if a.op == "maximum":
        return _is(a.args[1], 0.0)
    if a.op == "where":
        return a.args[1].is_zero or a.args[2].is_zero
    return a.op in ("abs", "hypot") or (a.op == "mul" and _is_square(a))


def _is_square(product: Expression) -> bool:
    """Whether every factor occurs an even number of times, is such itself, or is a number."""
    odd: dict[int, Expression] = {}
    squares, stack = False, [product]
    while stack:
        a = stack.pop()
        if a.op == "mul":
            stack.extend(a.args)
        elif a.index in odd:
            squares = True
            del odd[a.index]
        elif not _is_number(a):
            odd[a.index] = a
    return (squares or bool(odd)) and all(map(vanishes_flat, odd.values()))


def nonzero(a: Expression) -> Expression:
    """The value a, but 1 where a = 0: what a numerator that vanishes there is divided by."""
    one, zero = a.graph.constant(1.0), a.graph.constant(0.0)
    return where(equal(a, zero), one, a)

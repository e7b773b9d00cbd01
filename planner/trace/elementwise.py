"""Functions of arrays of numbers, or of expressions: equations written once run on both.

NumPy's own arithmetic, `dot`, `np.sqrt` and `np.exp` take arrays of expressions (dtype object) as
they are. What needs a comparison is here: on numbers it is NumPy's, on expressions it is recorded.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.planner.trace import arithmetic as op
from slipcar.planner.trace.arrays import graph_of


def choose(condition: Any, then: Any, otherwise: Any) -> Any:
    """`then` where the condition is > 0, else `otherwise`: also where it is not a number."""
    graph = graph_of((condition, then, otherwise))
    if graph is None:
        return np.where(condition > 0.0, then, otherwise)
    rule = np.frompyfunc(lambda *operands: op.where(*map(graph.lift, operands)), 3, 1)
    return rule(condition, then, otherwise)


def larger(a: Any, b: Any) -> Any:
    """The larger of two; b where a is not a number."""
    return choose(a - b, a, b)


def positive_part(a: Any) -> Any:
    """max(0, a); what is not a number stays so."""
    return choose(-a, 0.0 * a, a)


def within(a: Any, lower: Any, upper: Any) -> Any:
    """The nearest to a in [lower, upper]; what is not a number stays so."""
    return choose(a - upper, upper, choose(lower - a, lower, a))


def magnitude(a: Any) -> Any:
    """|a|."""
    return abs(a)


def erfc(a: Any) -> Any:
    """The complementary error function, 2/√π ∫_a^∞ exp(−t²) dt."""
    graph = graph_of((a,))
    if graph is None:
        from scipy.special import erfc as function  # an import that takes long

        return function(np.asarray(a, dtype=float))
    return np.frompyfunc(lambda e: op.call("erfc", graph.lift(e)), 1, 1)(a)

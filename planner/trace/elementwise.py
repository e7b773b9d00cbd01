"""Functions of arrays of numbers, or of expressions: equations written once run on both.

NumPy's own arithmetic, `dot`, `np.sqrt` and `np.exp` take arrays of expressions (dtype object) as
they are. What needs a comparison is here: on numbers it is NumPy's, on expressions it is recorded.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.planner.trace.graph import Expression, Graph

Array = np.ndarray


def _graph_of(values: tuple[Any, ...]) -> Graph | None:
    """The graph of the first expression among scalars and arrays; None if all are numbers."""
    for value in values:
        if isinstance(value, Expression):
            return value.graph
        if isinstance(value, np.ndarray) and value.dtype == object and value.size:
            entry = value.flat[0]
            if isinstance(entry, Expression):
                return entry.graph
    return None


def choose(condition: Any, then: Any, otherwise: Any) -> Any:
    """`then` where the condition is > 0, else `otherwise`: also where it is not a number."""
    graph = _graph_of((condition, then, otherwise))
    if graph is None:
        return np.where(condition > 0.0, then, otherwise)

    def one(c: Any, a: Any, b: Any) -> Expression:
        return graph.choose(graph.lift(c), graph.lift(a), graph.lift(b))

    return np.frompyfunc(one, 3, 1)(condition, then, otherwise)


def larger(a: Any, b: Any) -> Any:
    """The larger of two; b where a is not a number."""
    return choose(a - b, a, b)


def positive_part(a: Any) -> Any:
    """max(0, a); what is not a number stays so."""
    return choose(-a, 0.0 * a, a)


def magnitude(a: Any) -> Any:
    """|a|."""
    return abs(a) if isinstance(a, Expression) else np.abs(a)


def erfc(a: Any) -> Any:
    """The complementary error function, 2/√π ∫_a^∞ exp(−t²) dt."""
    graph = _graph_of((a,))
    if graph is None:
        from scipy.special import erfc as function

        return function(np.asarray(a, dtype=float))
    return np.frompyfunc(lambda e: graph.lift(e).erfc(), 1, 1)(a)

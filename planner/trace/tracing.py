"""One call of a user's function, traced: an array of expressions comes out, or why it cannot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy import asarray, empty  # originals: see .patches

from slipcar.planner.trace.arrays import TracedArray, graph_of
from slipcar.planner.trace.errors import (
    OpaqueError,
    TraceError,
    definition,
    in_foreign_package,
    user_line,
)
from slipcar.planner.trace.graph import Expression, Graph
from slipcar.planner.trace.patches import patched


def trace_call(name: str, function: Callable[..., Any], *arguments: Any) -> TracedArray:
    """Call a function on arrays of symbols and record what it does.

    It is called as it is, first, and once more where that fails, with Python's `math` and NumPy's
    empty arrays prepared for expressions (:mod:`.patches`). Arguments are handed over read-only.

    Args:
        name: of the function, for messages.
        function: user code written for NumPy arrays.
        arguments: arrays of expressions of one graph, and anything else it takes.

    Returns:
        What it returns, every entry an expression.

    Raises:
        OpaqueError: if it needs plain numbers: it leaves NumPy.
        TraceError: if it does anything else that cannot be recorded: a branch on a value, a
            function of NumPy that is not known, an assignment into an argument; or if it fails.
    """
    graph = graph_of(arguments)
    if graph is None:
        raise TraceError(f"{name}: no argument is traced")
    given = [_read_only(a) if isinstance(a, np.ndarray) else a for a in arguments]
    before, graph.tracing = graph.tracing, True
    try:
        with np.errstate(all="ignore"):
            try:
                return _result(graph, function(*given))
            except Exception:
                pass  # tried once more, prepared
            try:
                with patched():
                    return _result(graph, function(*given))
            except Exception as error:
                raise _explained(name, function, error) from error
    finally:
        graph.tracing = before


def _read_only(array: np.ndarray) -> np.ndarray:
    if array.dtype != object:
        return array
    view = array.view(TracedArray)
    view.flags.writeable = False
    return view


def _result(graph: Graph, value: Any) -> TracedArray:
    """What a function returned, all entries expressions."""
    if value is None:
        raise TraceError("returned None", "return")
    array = asarray(value).view(np.ndarray)
    lift = graph.lift
    entries = [e if type(e) is Expression and e.graph is graph else lift(e) for e in array.flat]
    result = empty(len(entries), dtype=object)
    result[:] = entries
    return result.reshape(array.shape).view(TracedArray)


def _explained(name: str, called: Callable[..., Any], error: Exception) -> TraceError:
    """An error of the traced code as one that says where and what to do."""
    where = user_line(error.__traceback__) or definition(called)
    at = f" ({where})" if where else ""
    kind: type[TraceError] = TraceError
    if isinstance(error, TraceError):
        kind, what, function = type(error), str(error), error.function
    elif isinstance(error, ValueError) and "read-only" in str(error):
        what, function = "wrote into an argument or a view", "writing into an argument"
    elif isinstance(error, IndexError) and "indices" in str(error):
        function = "an index"
        what = f"{function} depends on a value and cannot be traced: np.interp or np.where"
    else:
        if in_foreign_package(error.__traceback__) or _names_objects(str(error)):
            kind = OpaqueError
        what, function = f"{type(error).__name__} while traced: {error}", ""
    if function == "writing into an argument":
        text = f"{name} {what}{at}: copy it first"
    else:
        text = f"{name}: {what}{at}, or give {name}_jacobian"
    return kind(text, function, where)


def _names_objects(message: str) -> bool:
    """Whether an error is about arrays of objects: code that takes plain numbers alone."""
    return any(word in message for word in ("object_", "dtype('O')", "dtype object", "(object)"))

"""One call of a user's function, traced: an array of expressions comes out, or why it cannot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.trace import array_functions as array_functions  # registers them
from slipcar.planner.trace import errors
from slipcar.planner.trace.arrays import TracedArray, graph_of, lifted
from slipcar.planner.trace.errors import OpaqueError, TraceError
from slipcar.planner.trace.graph import Graph
from slipcar.planner.trace.patches import patched

#: Words of errors about arrays of objects: of code that takes plain numbers alone.
_OF_OBJECTS = ("object_", "dtype('O')", "dtype object", "(object)")


def trace_call(name: str, function: Callable[..., Any], *arguments: Any) -> TracedArray:
    """What a function written for NumPy arrays makes of arrays of expressions of one graph.

    It is called as it is, first, and once more where that fails, with Python's `math` and NumPy's
    constructors prepared for expressions (:mod:`.patches`). Arguments are handed over read-only.
    The name is for messages. Every entry of what comes out is an expression.

    Raises:
        OpaqueError: if it needs plain numbers: it leaves NumPy.
        TraceError: if it does anything else that cannot be recorded: a branch on a value, a
            function of NumPy that is not known, an assignment into an argument; or if it fails.
    """
    graph = graph_of(arguments)
    if graph is None:
        raise TraceError(f"{name}: no argument is traced")
    given = list(map(_read_only, arguments))
    before, graph.tracing = graph.tracing, True
    try:
        with np.errstate(all="ignore"):
            try:
                return _called(graph, function, given)
            except Exception:
                pass  # tried once more, prepared
            try:
                with patched():
                    return _called(graph, function, given)
            except Exception as error:
                raise _explained(name, function, error) from error
    finally:
        graph.tracing = before


def _called(graph: Graph, function: Callable[..., Any], given: list[Any]) -> TracedArray:
    """What a function returns, unless it caught a refusal on the way."""
    errors.raised.last = None
    try:
        value = _result(graph, function(*given))
        if errors.raised.last is not None:
            raise errors.raised.last
        return value
    finally:
        errors.raised.last = None


def _read_only(value: Any) -> Any:
    if not isinstance(value, np.ndarray) or value.dtype != object:
        return value
    view = value.view(TracedArray)
    view.flags.writeable = False
    return view


def _result(graph: Graph, value: Any) -> TracedArray:
    """What a function returned, all entries expressions."""
    if value is None:
        raise TraceError("returned None", "return")
    return lifted(graph, value).view(TracedArray)


def _explained(name: str, called: Callable[..., Any], error: Exception) -> TraceError:
    """An error of the traced code as one that says where and what to do."""
    where = errors.user_line(error.__traceback__) or errors.definition(called)
    at = f" ({where})" if where else ""
    kind: type[TraceError] = TraceError
    what, function = f"{type(error).__name__} while traced: {error}", ""
    if isinstance(error, TraceError):
        kind, what, function = type(error), str(error), error.function
    elif isinstance(error, ValueError) and "read-only" in str(error):
        what, function = "wrote into an argument or a view", "writing into an argument"
    elif isinstance(error, IndexError) and "indices" in str(error):
        function = "an index"
        what = f"{function} depends on a value and cannot be traced: np.interp or np.where"
    elif errors.in_foreign_package(error.__traceback__) or any(w in what for w in _OF_OBJECTS):
        kind = OpaqueError
    if function == "writing into an argument":
        return kind(f"{name} {what}{at}: copy it first", function, where)
    return kind(f"{name}: {what}{at}, or give {name}_jacobian", function, where)

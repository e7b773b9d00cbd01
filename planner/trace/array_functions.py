"""NumPy's functions on traced arrays: those with a way of their own, and those that need none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy import asarray, empty, ones, zeros  # originals: see .patches

from slipcar.planner.trace.arrays import (
    FUNCTIONS,
    GENERIC,
    TracedArray,
    graph_of,
    lifted,
    plain,
    refuse,
    wrapped,
)
from slipcar.planner.trace.graph import Expression, TraceError
from slipcar.planner.trace.ufuncs import SINC, WHERE, Ufunc

Array = np.ndarray
_FLOATS = (None, float, object, np.float64, np.dtype(float), np.dtype(object))
#: Most entries of a table of np.interp: every segment becomes code.
_LONGEST_TABLE = 256

#: By name: whichever of them this NumPy has. Their own code needs nothing but arithmetic.
_GENERIC = """
    stack concatenate concat hstack vstack dstack column_stack block append broadcast_to
    broadcast_arrays reshape ravel moveaxis rollaxis swapaxes transpose permute_dims
    matrix_transpose expand_dims squeeze tile repeat resize roll flip fliplr flipud rot90 split
    array_split hsplit vsplit dsplit unstack atleast_1d atleast_2d atleast_3d take
    take_along_axis delete insert pad diag diagonal diagflat tril triu copy ndim shape size
    meshgrid real imag isreal isrealobj iscomplexobj may_share_memory shares_memory copyto
    fill_diagonal compress extract array_repr array_str array2string apply_along_axis
    sum prod max min amax amin any all cumsum cumprod cumulative_sum cumulative_prod clip mean var
    std average ptp diff trapezoid trapz polyval outer cross kron trace
    linalg.outer linalg.cross linalg.trace linalg.diagonal linalg.matrix_transpose
"""
#: Sums of products: NumPy's loops over objects, numbers lifted once.
_CONTRACTIONS = "dot inner vdot einsum tensordot linalg.multi_dot linalg.tensordot"


def _named(name: str) -> Any:
    place: Any = np
    for part in name.split("."):
        place = getattr(place, part, None)
    return place


def implements(*names: str) -> Callable[[Any], Any]:
    """Register the way traced arrays take through functions of NumPy."""

    def register(way: Any) -> Any:
        for name in names:
            function = _named(name)
            if function is not None:
                FUNCTIONS[function] = way
        return way

    return register


GENERIC.update(function for function in map(_named, _GENERIC.split()) if function is not None)


def _contraction(function: Any) -> Callable[..., Any]:
    def contract(*args: Any, **kwargs: Any) -> Any:
        out = kwargs.pop("out", None)
        graph = graph_of(args)

        def operand(value: Any) -> Any:
            if isinstance(value, str):  # einsum's subscripts
                return value
            if function is np.linalg.multi_dot and isinstance(value, (list, tuple)):
                return [operand(matrix) for matrix in value]
            return asarray(plain(value), dtype=float) if graph is None else lifted(graph, value)

        if function in (np.tensordot, getattr(np.linalg, "tensordot", None)):
            args, kwargs["axes"] = args[:2], args[2] if len(args) > 2 else kwargs.get("axes", 2)
        result = wrapped(function._implementation(*map(operand, args), **kwargs))
        if out is not None:
            out[...] = result
            return out
        return result

    return contract


for _name in _CONTRACTIONS.split():
    if _named(_name) is not None:
        FUNCTIONS[_named(_name)] = _contraction(_named(_name))


# -------------------------------------------------------------------------------- making


def filled(shape: Any, value: Any) -> TracedArray:
    """A traced array of one value."""
    array = empty(shape, dtype=object)
    array[...] = value
    return array.view(TracedArray)


def _like(function: Any, value: Any) -> Callable[..., Any]:
    def make(a: Any, dtype: Any = None, order: Any = "K", subok: bool = True, shape: Any = None,
             **kwargs: Any) -> Any:  # fmt: skip
        shape = np.shape(plain(a)) if shape is None else shape
        return filled(shape, value) if dtype in _FLOATS else function(shape, dtype=dtype)

    return make


FUNCTIONS[np.zeros_like] = _like(zeros, 0.0)
FUNCTIONS[np.ones_like] = _like(ones, 1.0)
FUNCTIONS[np.empty_like] = _like(empty, None)


@implements("full_like")
def full_like(a: Any, fill_value: Any, dtype: Any = None, **kwargs: Any) -> TracedArray:
    """np.full_like: the value may be traced."""
    return filled(np.shape(plain(a)), plain(fill_value))


@implements("result_type")
def result_type(*args: Any) -> np.dtype:
    """Arrays of it take traced values."""
    return np.dtype(object)


# --------------------------------------------------------------------------- conditions


@implements("where")
def where(condition: Any, *values: Any) -> Any:
    """np.where of three arguments; of one it asks for positions."""
    if len(values) != 2:
        refuse("np.where without values")
    return _apply(WHERE, condition, *values)


def _apply(kind: Ufunc, *args: Any) -> Any:
    """A rule that is no ufunc of NumPy's, elementwise."""
    graph = graph_of(args)
    if graph is None:
        return wrapped(kind.loop(*map(plain, args)), TracedArray)
    return wrapped(kind.loop(*(lifted(graph, value) for value in args)), TracedArray)


@implements("sinc")
def sinc(x: Any) -> Any:
    """np.sinc: sin(πx)/(πx)."""
    return _apply(SINC, x)


@implements("fix")
def fix(x: Any, out: Any = None) -> Any:
    """np.fix: rounded towards 0."""
    return np.trunc(x, out=out)


@implements("select")
def select(condlist: Sequence[Any], choicelist: Sequence[Any], default: Any = 0) -> Any:
    """np.select: the value of the earliest condition that holds."""
    result = default
    for condition, value in zip(reversed(condlist), reversed(choicelist), strict=True):
        result = _apply(WHERE, condition, value, result)
    return result


@implements("piecewise")
def piecewise(x: Any, condlist: Any, funclist: Sequence[Any], *args: Any, **kwargs: Any) -> Any:
    """np.piecewise: the value of the last condition that holds."""
    conditions = list(condlist) if isinstance(condlist, (list, tuple)) else [condlist]
    values = [f(x, *args, **kwargs) if callable(f) else f for f in funclist]
    result: Any = values[-1] if len(values) == len(conditions) + 1 else 0.0
    for condition, value in zip(conditions, values, strict=False):
        result = _apply(WHERE, condition, value, result)
    return result + np.zeros_like(x)


@implements("nan_to_num")
def nan_to_num(x: Any, *args: Any, **kwargs: Any) -> Any:
    """np.nan_to_num: traced values are taken for finite ones."""
    return +x


# ------------------------------------------------------------------------------- tables


@implements("interp")
def interp(
    x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None, period: Any = None
) -> Any:
    """np.interp: piecewise linear, constant outside. At a knot the right slope is taken."""
    if period is not None:
        refuse("np.interp with period=")
    graph = graph_of((x, xp, fp, left, right))
    if graph is None:
        numbers = [asarray(plain(v), dtype=float) for v in (x, xp, fp)]
        return np.interp(numbers[0], numbers[1], numbers[2], left, right)
    knots = [_number(v) for v in asarray(plain(xp)).tolist()]
    values = [_number(v) for v in asarray(plain(fp)).tolist()]
    if len(knots) > _LONGEST_TABLE:
        say = f"np.interp with {len(knots)} entries cannot be traced: at most {_LONGEST_TABLE}"
        raise TraceError(say, "np.interp")

    def number(value: Any) -> Expression:  # whatever is in a table, it makes the same code
        if type(value) is Expression or not graph.tracing:
            return graph.lift(value)
        return graph.number(value, special=False)

    at = wrapped(lifted(graph, x), TracedArray)
    edges, heights = [number(knot) for knot in knots], [number(value) for value in values]
    result: Any = np.full_like(at, heights[0])
    for i in range(len(knots) - 1):
        width = knots[i + 1] - knots[i]
        if type(width) is not Expression and width <= 0.0:
            continue  # a jump: nothing lies inside
        slope = number((values[i + 1] - values[i]) / width)
        segment = slope * (at - edges[i]) + heights[i]
        result = _apply(WHERE, at >= edges[i], segment, result) if i else segment
    below, above = heights[0] if left is None else left, heights[-1] if right is None else right
    result = _apply(WHERE, at < edges[0], below, result)
    beyond = at >= edges[-1] if right is None else at > edges[-1]
    return _apply(WHERE, beyond, above, result)


def _number(value: Any) -> Any:
    return value if type(value) is Expression else float(value)

"""Arrays of expressions that user code written for NumPy takes for arrays of numbers.

A :class:`TracedArray` is an array of dtype object whose entries are expressions, or plain numbers.
NumPy's ufuncs are recorded entry by entry (:mod:`.ufuncs`). Its functions run NumPy's own code,
which works on arrays of objects as long as it needs arithmetic alone; a few have code of ours
(:mod:`.array_functions`). What then asks for a value is refused by name. Comparisons give a
:class:`TracedCondition`, to be used in np.where, as a factor, with &, |, ~ and in y[y < 0] = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
from numpy import asarray, empty, full  # originals: see .patches

from slipcar.planner.trace.graph import Expression, Graph, TraceError
from slipcar.planner.trace.ufuncs import WHERE, recorded

Array = np.ndarray
#: Ours, by NumPy's function; of np.sinc NumPy's code would have inexact derivatives near 0.
FUNCTIONS: dict[Any, Callable[..., Any]] = {np.sinc: lambda x: refuse("np.sinc")}
#: Sums of products: numbers are lifted once, not for every product.
_CONTRACTIONS = {np.dot, np.inner, np.vdot, np.einsum, np.tensordot}
#: Questions that traced values answer as finite numbers; and what + and * are on conditions.
_CERTAIN = {np.isfinite: True, np.isnan: False, np.isinf: False}
_ON_CONDITIONS = {np.add: np.logical_or, np.multiply: np.logical_and}
_FLOATS = (float, np.float64, "float", "float64")
_METHODS = ("__call__", "reduce", "accumulate", "outer")
_HINTS = {
    "rint": "np.floor(x + 0.5)",
    "round": "np.floor(x + 0.5)",
    "sort": "np.minimum and np.maximum for the least and the largest",
    "argmax": "np.max and np.where",
    "argmin": "np.min and np.where",
    "unwrap": "differences by np.arctan2(np.sin(d), np.cos(d))",
    "searchsorted": "np.interp",
}


def refuse(function: str, reason: object = "") -> NoReturn:
    """Raise the error for a function that cannot be recorded."""
    hint = _HINTS.get(function.rpartition(".")[2])
    instead = f"write {hint}" if hint else reason or "write it with functions that can be traced"
    raise TraceError(f"{function} cannot be traced: {instead}", function)


def graph_of(values: Any) -> Graph | None:
    """The graph of the first expression in a sequence of arrays, scalars and such sequences."""
    for value in values:
        if type(value) is Expression:
            return value.graph
        if isinstance(value, np.ndarray):
            if value.dtype.char == "O":
                for entry in value.flat:
                    if type(entry) is Expression:
                        return entry.graph
        elif isinstance(value, (list, tuple)):
            graph = graph_of(value)
            if graph is not None:
                return graph
    return None


def scalar(value: Any) -> Array:
    """An array without axes of one object."""
    array = empty((), dtype=object)
    array[()] = value
    return array


def lifted(graph: Graph, value: Any) -> Array:
    """Numbers and expressions as a plain array of expressions, each lifted once."""
    if type(value) is Expression or isinstance(value, (int, float)):
        return scalar(graph.lift(value))
    array = asarray(value)
    result = empty(array.size, dtype=object)
    result[:] = list(map(graph.lift, array.ravel().tolist()))
    return result.reshape(array.shape)


def is_float(dtype: Any) -> bool:
    """Whether a type is that of floats, to be replaced by object."""
    return isinstance(dtype, (type, str, np.dtype)) and dtype in _FLOATS


def wrapped(result: Any, kind: type[Array] | None = None) -> Any:
    """Arrays of objects as traced arrays; scalars as they are; also inside tuples and lists."""
    if isinstance(result, np.ndarray):
        if result.dtype.char == "O" and (kind is not None or type(result) is np.ndarray):
            return result.view(kind or TracedArray)
    elif isinstance(result, (tuple, list)):
        return type(result)([wrapped(entry, kind) for entry in result])
    return result


def plain(value: Any) -> Any:
    """A traced array as NumPy's own class; anything else as it is."""
    return value.view(np.ndarray) if isinstance(value, TracedArray) else value


class TracedArray(np.ndarray):
    """An array of expressions and numbers; see the module's docstring."""

    __array_priority__ = 1000.0

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        graph = graph_of(inputs)
        if graph is None:
            return _on_numbers(getattr(ufunc, method), inputs, kwargs)
        if _is_condition(inputs[0]) and ufunc in _ON_CONDITIONS and method == "__call__":
            ufunc = _ON_CONDITIONS[ufunc] if all(map(_is_condition, inputs)) else ufunc
        way = recorded(ufunc)
        if way is None and ufunc in _CERTAIN:
            return full(np.shape(plain(inputs[0])), _CERTAIN[ufunc])[()]
        if way is None or method not in _METHODS or kwargs.get("where", True) is not True:
            name = f"{'np.' if hasattr(np, ufunc.__name__) else ''}{ufunc.__name__}"
            refuse(name if method == "__call__" else f"{name}.{method}")
        if way.condition and method == "reduce" and not _is_condition(inputs[0]):
            inputs = (inputs[0] != 0.0,)
        operands = [_operand(graph, value, way.lifts) for value in inputs]
        kept = kwargs and {n: v for n, v in kwargs.items() if n in ("axis", "keepdims", "initial")}
        result = getattr(way.loop, method)(*operands, **kept)
        result = wrapped(result, TracedCondition if way.condition else TracedArray)
        return _put(kwargs["out"], result) if "out" in kwargs else result

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        graph = graph_of((*args, *kwargs.values()))
        args = tuple(object if is_float(a) else a for a in args)
        kwargs = {name: object if is_float(a) else a for name, a in kwargs.items()}
        if graph is not None and func in FUNCTIONS:
            return FUNCTIONS[func](*args, **kwargs)
        if graph is not None and func in _CONTRACTIONS:
            given = [lifted(graph, a) if isinstance(a, np.ndarray) else a for a in args]
        else:
            given = [scalar(a).view(TracedArray) if type(a) is Expression else a for a in args]
        try:
            return wrapped(func._implementation(*given, **kwargs))
        except (TypeError, AttributeError, IndexError, NotImplementedError) as error:
            if graph is None:
                return _on_numbers(func, args, kwargs)
            within = getattr(error, "function", "").startswith("np.")  # refused by name, too
            name = f"{func.__module__.replace('numpy', 'np')}.{func.__name__}"
            refuse(name, "" if within else error)

    def __setitem__(self, key: Any, value: Any) -> None:
        if not self.flags.writeable:
            owners = {e.value[0] for e in self.flat if getattr(e, "op", "") == "input"}
            what = f"its argument {owners.pop()}" if len(owners) == 1 else "an argument or a view"
            raise TraceError(f"wrote into {what}", "writing into an argument")
        if _is_condition(key):
            if key.shape != self.shape[: key.ndim]:
                raise IndexError(f"a condition of shape {key.shape} for shape {self.shape}")
            if np.size(plain(value)) != 1:  # how many values are needed is not known
                refuse("a boolean mask", "to assign values where it holds write np.where")
            mask = plain(key).reshape(*key.shape, *[1] * (self.ndim - key.ndim))
            value, key = WHERE(mask, plain(value), plain(self)), ...
        self.view(np.ndarray)[key] = value

    def astype(self, dtype: Any, *args: Any, **kwargs: Any) -> Any:
        """A copy; as float64 the expressions stay, other types are refused where there are any."""
        dtype, traced = np.dtype(dtype), graph_of((self,)) is not None
        if dtype.char in "dO" or (traced and _is_condition(self)):
            return self.view(TracedCondition if dtype.char == "?" else TracedArray).copy()
        if traced:
            refuse(f"astype({dtype})")
        return self.view(np.ndarray).astype(dtype, *args, **kwargs)


class TracedCondition(TracedArray):
    """What comparisons give: entries that are 1 where the condition holds, else 0."""


for _name in ("__array_ufunc__", "__array_function__"):  # NumPy asks scalars as it asks arrays
    setattr(Expression, _name, vars(TracedArray)[_name])
for _name in ("round", "sort", "argsort", "partition", "argmax", "argmin", "nonzero"):
    setattr(TracedArray, _name, lambda *args, name=_name, **kwargs: refuse(f"np.{name}"))


def _operand(graph: Graph, value: Any, lifts: bool) -> Any:
    """An operand for a loop over objects."""
    if isinstance(value, TracedArray):
        return value.view(np.ndarray)
    if lifts or type(value) is Expression:
        return lifted(graph, value)
    return asarray(value).astype(object)


def _is_condition(value: Any) -> bool:
    return isinstance(value, TracedCondition)


def _put(out: tuple[Any] | None, result: Any) -> Any:
    """A result, put where out= says."""
    if out is None or out[0] is None:
        return result
    out[0][...] = result
    return out[0]


def _numbers(value: Any) -> Any:
    """Traced arrays without expressions as arrays of float64."""
    if isinstance(value, TracedArray):
        return value.view(np.ndarray).astype(bool if _is_condition(value) else float)
    if isinstance(value, (list, tuple)):
        return type(value)([_numbers(entry) for entry in value])
    return value


def _on_numbers(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """A function on traced arrays that hold plain numbers: NumPy's own, values assignable."""
    out = kwargs.pop("out", None)
    result = function(*_numbers(args), **{name: _numbers(v) for name, v in kwargs.items()})
    if isinstance(result, np.ndarray) and result.dtype == np.float64:
        result = result.astype(object).view(TracedArray)
    return _put(out if isinstance(out, tuple) else (out,), result)

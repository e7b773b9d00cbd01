"""Arrays of expressions that user code written for NumPy takes for arrays of numbers.

A :class:`TracedArray` is an array of dtype object whose entries are expressions, or plain numbers.
NumPy hands ufuncs and functions that meet one to this module (`__array_ufunc__`,
`__array_function__`), which records them or refuses them by name. Comparisons give a
:class:`TracedCondition`, to be used in np.where, as a factor, with &, |, ~ and in y[y < 0] = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
from numpy import asarray, empty, full  # originals: see .patches

from slipcar.planner.trace.graph import Expression, Graph, TraceError
from slipcar.planner.trace.ufuncs import TRUTH, UFUNCS, WHERE, Ufunc, recorded

Array = np.ndarray
#: NumPy's functions with a way of their own; see :mod:`.array_functions`.
FUNCTIONS: dict[Any, Callable[..., Any]] = {}
#: NumPy's functions whose own code runs on traced arrays.
GENERIC: set[Any] = set()
#: Questions that traced values are taken to answer like any finite number.
CERTAIN = {np.isfinite: True, np.isnan: False, np.isinf: False}
_OTHER = "write it with functions that can be traced"
_HINTS = {
    "rint": "np.floor(x + 0.5)",
    "round": "np.floor(x + 0.5)",
    "sort": "np.minimum and np.maximum for the least and the largest",
    "argmax": "np.max and np.where",
    "argmin": "np.min and np.where",
    "unwrap": "differences by np.arctan2(np.sin(d), np.cos(d))",
    "searchsorted": "np.interp",
}


def refuse(function: str) -> NoReturn:
    """Raise the error for a function that cannot be recorded."""
    hint = _HINTS.get(function.rpartition(".")[2])
    instead = f"write {hint}" if hint else _OTHER
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
    if array.dtype.char not in "Odf?bBhHiIlLqQe":
        raise TraceError(f"arrays of {array.dtype} cannot be traced", f"an array of {array.dtype}")
    lift = graph.lift
    result = empty(array.size, dtype=object)
    result[:] = [lift(entry) for entry in array.ravel().tolist()]
    return result.reshape(array.shape)


def wrapped(result: Any, kind: type[Array] | None = None) -> Any:
    """Arrays of objects as traced arrays; scalars as they are; also inside tuples and lists."""
    if isinstance(result, np.ndarray):
        if result.dtype.char == "O" and (kind is not None or type(result) is np.ndarray):
            return result.view(kind or TracedArray)
        return result
    if isinstance(result, (tuple, list)):
        return type(result)([wrapped(entry, kind) for entry in result])
    return result


def plain(value: Any) -> Any:
    """A traced array as NumPy's own class; anything else as it is."""
    return value.view(np.ndarray) if isinstance(value, TracedArray) else value


# ------------------------------------------------------------------------------- ufuncs


def apply_ufunc(ufunc: Any, method: str, inputs: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """A ufunc, or a method of it, on arrays of which one is traced."""
    kind = UFUNCS.get(ufunc) or recorded(ufunc)
    graph = graph_of(inputs)
    if graph is None:
        return _on_numbers(getattr(ufunc, method), inputs, kwargs)
    if kind is None:
        if ufunc in CERTAIN and method == "__call__":
            return full(np.shape(plain(inputs[0])), CERTAIN[ufunc])[()]
        refuse(f"np.{ufunc.__name__}")
    condition = kind.condition
    if method == "__call__" and ufunc in (np.add, np.multiply):  # or and and, as of booleans
        condition = all(isinstance(value, TracedCondition) for value in inputs)
        if condition:
            kind = UFUNCS[np.logical_or if ufunc is np.add else np.logical_and]
    out = None
    if kwargs:
        if kwargs.pop("where", True) is not True:
            refuse(f"np.{ufunc.__name__} with where=")
        out = kwargs.pop("out", None)
        for name in ("dtype", "casting", "order", "subok", "signature"):
            kwargs.pop(name, None)
    if method == "__call__":
        operands = [_operand(graph, value, kind.lifts) for value in inputs]
        result = kind.loop(*operands, **kwargs)
    else:
        result = _method(graph, kind, method, inputs, kwargs)
    result = wrapped(result, TracedCondition if condition else TracedArray)
    return result if out is None else _assigned(out, result)


def _operand(graph: Graph, value: Any, lifts: bool) -> Any:
    """An operand for a loop over objects."""
    if isinstance(value, TracedArray):
        return value.view(np.ndarray)
    if type(value) is Expression:
        return scalar(value)
    if not lifts and isinstance(value, (int, float, np.ndarray, np.number)):
        return asarray(value).astype(object)
    return lifted(graph, value)


def _method(
    graph: Graph, kind: Ufunc, method: str, inputs: tuple[Any, ...], kwargs: dict[str, Any]
) -> Any:
    """A ufunc's reduce, accumulate, outer or at."""
    loop = kind.loop
    if method == "reduce":
        array = lifted(graph, inputs[0])
        return _reduced(loop, TRUTH(array) if kind.condition else array, **kwargs)
    if method == "accumulate":
        return loop.accumulate(lifted(graph, inputs[0]), dtype=object, **kwargs)
    if method == "outer":
        return loop.outer(*(lifted(graph, value) for value in inputs), **kwargs)
    if method == "at":
        target = inputs[0]
        _check_writeable(target)
        return loop.at(plain(target), inputs[1], *(lifted(graph, v) for v in inputs[2:]))
    refuse(f"{loop.__name__}.{method}")


def _reduced(
    loop: Any, array: Array, axis: Any = 0, keepdims: bool = False, initial: Any = None
) -> Any:
    """Reduce over some axes or all (None), as one axis: loops over objects take no more."""
    axes = range(array.ndim) if axis is None else np.atleast_1d(axis).tolist()
    axes = tuple(sorted(a % max(array.ndim, 1) for a in axes))
    moved = np.moveaxis(array, axes, range(len(axes)))
    rest = moved.shape[len(axes) :]
    moved = moved.reshape(-1, *rest)
    if initial is not None and initial is not np._NoValue:
        moved = np.concatenate([np.broadcast_to(scalar(initial), (1, *rest)), moved])
    result = loop.reduce(moved, axis=0)
    if keepdims:
        shape = tuple(1 if i in axes else length for i, length in enumerate(array.shape))
        result = np.reshape(scalar(result) if not rest else result, shape)
    return result


def _assigned(out: tuple[Any, ...], result: Any) -> Any:
    """Results put where out= says."""
    results = result if isinstance(result, tuple) else (result,)
    for target, value in zip(out, results, strict=False):
        if target is not None:
            target[...] = value
    targets = tuple(v if t is None else t for t, v in zip(out, results, strict=False))
    return targets if isinstance(result, tuple) else targets[0]


def _numbers(value: Any) -> Any:
    """Traced arrays without expressions as arrays of float64."""
    if isinstance(value, TracedArray):
        dtype = bool if isinstance(value, TracedCondition) else float
        return value.view(np.ndarray).astype(dtype)
    if isinstance(value, (list, tuple)):
        return type(value)([_numbers(entry) for entry in value])
    return value


def _on_numbers(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """A function on traced arrays that hold plain numbers: NumPy's own, values assignable."""
    out = kwargs.pop("out", None)
    result = function(*_numbers(args), **{name: _numbers(v) for name, v in kwargs.items()})
    if isinstance(result, np.ndarray) and result.dtype == np.float64:
        result = result.astype(object).view(TracedArray)
    if out is None:
        return result
    return _assigned(out if isinstance(out, tuple) else (out,), result)


# ---------------------------------------------------------------------------- functions


def apply_function(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """A function of NumPy on arguments of which one is traced."""
    known = FUNCTIONS.get(function)
    if known is not None:
        return known(*args, **kwargs)
    if function in GENERIC:
        args = tuple(scalar(a).view(TracedArray) if type(a) is Expression else a for a in args)
        return wrapped(function._implementation(*args, **kwargs))
    if graph_of((*args, *kwargs.values())) is None:
        return _on_numbers(function, args, kwargs)
    module = function.__module__.replace("numpy", "np")
    refuse(f"{module}.{function.__name__}")


def _check_writeable(array: Any) -> None:
    if not array.flags.writeable:
        names = {e.value[0] if e.op == "input" else "" for e in array.flat if type(e) is Expression}
        name = names.pop() if len(names) == 1 else ""
        if not name:
            raise ValueError("assignment destination is read-only")
        raise TraceError(f"wrote into its argument {name}", "writing into an argument")


def _refused_method(name: str) -> Callable[..., NoReturn]:
    def method(self: Any, *args: Any, **kwargs: Any) -> NoReturn:
        refuse(f"np.{name}")

    return method


class TracedArray(np.ndarray):
    """An array of expressions and numbers; see the module's docstring."""

    __array_priority__ = 1000.0

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        return apply_ufunc(ufunc, method, inputs, kwargs)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return apply_function(func, args, kwargs)

    def __setitem__(self, key: Any, value: Any) -> None:
        if not self.flags.writeable:
            _check_writeable(self)
        if isinstance(key, TracedCondition):
            if key.shape != self.shape[: key.ndim]:
                raise IndexError(f"a condition of shape {key.shape} for shape {self.shape}")
            mask = plain(key).reshape(*key.shape, *[1] * (self.ndim - key.ndim))
            value = WHERE.loop(mask, _item(value), plain(self))
            key = ...
        self.view(np.ndarray)[key] = value

    def astype(self, dtype: Any, *args: Any, **kwargs: Any) -> Any:
        """A copy; as float64 the expressions stay, other types are refused where there are any."""
        dtype = np.dtype(dtype)
        if dtype.char in "dO":
            return self.view(TracedArray).copy()
        if graph_of((self,)) is not None and not isinstance(self, TracedCondition):
            refuse(f"astype({dtype})")
        if graph_of((self,)) is not None:
            return self.copy() if dtype.char == "?" else self.view(TracedArray).copy()
        return self.view(np.ndarray).astype(dtype, *args, **kwargs)

    def mean(self, axis: Any = None, dtype: Any = None, out: Any = None, **kwargs: Any) -> Any:
        """The mean over axes."""
        total = self.sum(axis=axis, **kwargs)
        return total / (self.size // total.size)

    def var(  # type: ignore[override]
        self, axis: Any = None, dtype: Any = None, out: Any = None, ddof: int = 0, **kwargs: Any
    ) -> Any:
        """The variance over axes."""
        error = self - self.mean(axis=axis, keepdims=True)
        total = (error * error).sum(axis=axis, **kwargs)
        return total / (self.size // total.size - ddof)

    def std(self, *args: Any, **kwargs: Any) -> Any:
        """The standard deviation over axes."""
        return np.sqrt(self.var(*args, **kwargs))

    def dot(self, b: Any, out: Any = None) -> Any:
        """The product with another array."""
        return np.dot(self, b)

    round = _refused_method("round")
    sort = _refused_method("sort")
    argsort = _refused_method("argsort")
    partition = _refused_method("partition")
    argmax = _refused_method("argmax")
    argmin = _refused_method("argmin")
    nonzero = _refused_method("nonzero")
    searchsorted = _refused_method("searchsorted")


class TracedCondition(TracedArray):
    """What comparisons give: entries that are 1 where the condition holds, else 0."""


def _item(value: Any) -> Any:
    """What is assigned where a condition holds: one number for all places.

    Raises:
        TraceError: for arrays: how many values they need is not known.
    """
    if isinstance(value, np.ndarray) and value.size != 1:
        raise TraceError(
            "values cannot be assigned where a traced condition holds: write np.where",
            "a boolean mask",
        )
    return value.item() if isinstance(value, np.ndarray) else value


def _scalar_ufunc(self: Expression, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
    return apply_ufunc(ufunc, method, inputs, kwargs)


def _scalar_function(self: Expression, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
    return apply_function(func, args, kwargs)


# NumPy hands scalars to the same functions as arrays.
Expression.__array_ufunc__ = _scalar_ufunc  # type: ignore[attr-defined]
Expression.__array_function__ = _scalar_function  # type: ignore[attr-defined]

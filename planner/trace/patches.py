"""While a function is traced: Python's `math` and NumPy's empty arrays take expressions.

`math.sin(x)` asks x for a float, and `np.zeros(3)` is an array of floats: both stop a trace. Where
one was stopped it is repeated with these functions replaced, in the modules themselves, so that
helpers of the traced code see them too. The replacements do what the originals do, for everything
but expressions, and in every thread but that which traces; so it does no harm if other threads
call them, or if some module imports one meanwhile and keeps it. They are put back at the end.
"""

from __future__ import annotations

import contextlib
import functools
import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy import asarray  # originals: see .patches

from slipcar.planner.trace.array_functions import filled
from slipcar.planner.trace.arrays import TracedArray, graph_of
from slipcar.planner.trace.graph import Expression
from slipcar.planner.trace.ufuncs import erf

_array = np.array
_LOCK = threading.RLock()
_TRACING = threading.local()
_FLOATS = (None, float, np.float64, object, "float", "float64", "d", np.dtype(float), np.dtype("O"))


def _is_traced(value: Any) -> bool:
    return type(value) is Expression or isinstance(value, TracedArray)


def _now() -> bool:
    """Whether this thread traces."""
    return getattr(_TRACING, "depth", 0) > 0


_SAME_NAME = """
    sin cos tan sinh cosh tanh exp expm1 log1p log2 log10 sqrt fabs fmod copysign radians degrees
    floor ceil trunc exp2 cbrt isfinite isnan isinf
"""
#: Functions of `math` by NumPy's name for the same.
_MATH = {
    **{name: getattr(np, name) for name in _SAME_NAME.split()},
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "atan2": np.arctan2,
    "pow": np.power,
    "log": lambda x, base=math.e: np.log(x) if base == math.e else np.log(x) / math.log(base),
    "erf": lambda x: erf(x.item()),
    "erfc": lambda x: x.item().erfc(),
    "hypot": lambda *x: np.sqrt(sum(v * v for v in x)) if len(x) != 2 else np.hypot(*x),
}


def _of_math(original: Any, traced: Callable[..., Any]) -> Any:
    @functools.wraps(original)
    def function(*args: Any) -> Any:
        if any(map(_is_traced, args)):
            result = traced(*args)
            return result.item() if isinstance(result, np.ndarray) else result
        return original(*args)

    return function


def _making(original: Any, value: float | None) -> Any:
    """np.zeros, np.ones, np.empty: of floats, as an array that takes expressions."""

    @functools.wraps(original)
    def make(shape: Any, dtype: Any = None, *args: Any, **kwargs: Any) -> Any:
        if _now() and _is_floats(dtype):
            return filled(shape, value)
        return original(shape, float if dtype is None else dtype, *args, **kwargs)

    return make


def _is_floats(dtype: Any) -> bool:
    return any(dtype is kind or dtype == kind for kind in _FLOATS)


def _taking(original: Any) -> Any:
    """np.full, np.eye, ...: what comes out as floats takes expressions."""

    @functools.wraps(original)
    def make(*args: Any, **kwargs: Any) -> Any:
        if not _now():
            return original(*args, **kwargs)
        traced = graph_of((*args, *kwargs.values())) is not None
        if traced and kwargs.get("dtype") is not None and _is_floats(kwargs["dtype"]):
            kwargs["dtype"] = object
        elif traced and original is _array and len(args) > 1 and _is_floats(args[1]):
            args = (args[0], object, *args[2:])
        result = original(*args, **kwargs)
        if result.dtype.char == "d":
            return result.astype(object).view(TracedArray)
        return result.view(TracedArray) if traced and result.dtype.char == "O" else result

    return make


def _converting(original: Any) -> Any:
    """np.asarray and the like: expressions stay, whatever kind of float is asked for."""

    @functools.wraps(original)
    def convert(a: Any, dtype: Any = None, *args: Any, **kwargs: Any) -> Any:
        if not (_now() and _is_floats(dtype) and (_is_traced(a) or graph_of((a,)) is not None)):
            return original(a, dtype, *args, **kwargs)
        return a if isinstance(a, TracedArray) else original(a, dtype=object).view(TracedArray)

    return convert


def _vectorized(original: Any) -> Any:
    @functools.wraps(original)
    def call(self: Any, *args: Any, **kwargs: Any) -> Any:
        graph = graph_of((*args, *kwargs.values())) if _now() else None
        if graph is None or kwargs or getattr(self, "signature", None) or self.excluded:
            return original(self, *args, **kwargs)
        arrays = [asarray(a) for a in args]
        result = np.frompyfunc(self.pyfunc, len(args), 1)(*(a.view(np.ndarray) for a in arrays))
        return result.view(TracedArray) if isinstance(result, np.ndarray) else result

    return call


def _replacements() -> list[tuple[Any, str, Any]]:
    """(module, name, function) of what is replaced."""
    return [
        *(
            (math, name, _of_math(getattr(math, name), traced))
            for name, traced in _MATH.items()
            if hasattr(math, name)
        ),
        (np, "zeros", _making(np.zeros, 0.0)),
        (np, "ones", _making(np.ones, 1.0)),
        (np, "empty", _making(np.empty, None)),
        *(
            (np, name, _taking(getattr(np, name)))
            for name in ("full", "eye", "identity", "array", "diag")
        ),
        *(
            (np, name, _converting(getattr(np, name)))
            for name in ("asarray", "asanyarray", "ascontiguousarray")
        ),
        (np.vectorize, "__call__", _vectorized(np.vectorize.__call__)),
    ]


_REPLACEMENTS = _replacements()
_ORIGINALS = [(module, name, getattr(module, name)) for module, name, _ in _REPLACEMENTS]
_nesting = 0


@contextlib.contextmanager
def patched() -> Iterator[None]:
    """Replace the functions while the block runs, in one thread at a time."""
    global _nesting
    with _LOCK:
        _TRACING.depth = getattr(_TRACING, "depth", 0) + 1
        if _nesting == 0:
            for module, name, function in _REPLACEMENTS:
                setattr(module, name, function)
        _nesting += 1
        try:
            yield
        finally:
            _nesting -= 1
            _TRACING.depth -= 1
            if _nesting == 0:
                for module, name, function in _ORIGINALS:
                    setattr(module, name, function)

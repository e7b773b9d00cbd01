"""While a function is traced: Python's `math` and NumPy's constructors take expressions.

`math.sin(x)` asks x for a float, and `np.zeros(3)` is an array of floats: both stop a trace. It is
repeated with these functions replaced in the modules themselves, so that helpers of the traced
code see them too. For all but expressions, and in every thread but that which traces, they do what
the originals do: no harm if others call one, or keep it. They are put back at the end.
"""

from __future__ import annotations

import contextlib
import functools
import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from slipcar.planner.trace.arrays import TracedArray, graph_of, is_float
from slipcar.planner.trace.graph import Expression

_LOCK, _THREAD = threading.RLock(), threading.local()
_SAME_NAME = """
    sin cos tan sinh cosh tanh exp expm1 log1p log2 log10 sqrt fabs fmod copysign radians degrees
    floor ceil trunc exp2 cbrt isfinite isnan isinf
"""
#: Functions of `math` by NumPy's for the same.
_MATH: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in _SAME_NAME.split()},
    **{f"a{of}": getattr(np, f"arc{of}") for of in ("sin", "cos", "tan", "tan2")},
    **{f"a{of}": getattr(np, f"arc{of}") for of in ("sinh", "cosh", "tanh")},
    "pow": np.power,
    "log": lambda x, base=math.e: np.log(x) if base == math.e else np.log(x) / math.log(base),
    "erf": lambda x: 1.0 - x.item().erfc(),
    "erfc": lambda x: x.item().erfc(),
    "hypot": lambda *x: np.hypot(*x) if len(x) == 2 else np.sqrt(sum(v * v for v in x)),
}
#: NumPy's constructors whose floats take expressions, and those that keep what they are given.
_MAKING = ("zeros", "ones", "empty", "full", "eye", "identity", "array", "diag")
_KEEPING = ("asarray", "asanyarray", "ascontiguousarray")


def _of_math(original: Any, traced: Callable[..., Any]) -> Any:
    @functools.wraps(original)
    def function(*args: Any) -> Any:
        if any(isinstance(value, (Expression, TracedArray)) for value in args):
            return traced(*args).item()
        return original(*args)

    return function


def _constructor(name: str, original: Any) -> Any:
    @functools.wraps(original)
    def make(*args: Any, **kwargs: Any) -> Any:
        if not getattr(_THREAD, "traces", False):
            return original(*args, **kwargs)
        if graph_of((*args, *kwargs.values())) is not None:
            args = tuple(object if is_float(a) else a for a in args)
            kwargs = {key: object if is_float(a) else a for key, a in kwargs.items()}
        result = original(*args, **kwargs)
        if name in _MAKING and result.dtype.char == "d":
            result = result.astype(object)
            if name == "empty":
                result[...] = None
        return result.view(TracedArray) if result.dtype.char == "O" else result

    return make


_REPLACEMENTS: dict[tuple[Any, str], Any] = {
    (math, name): _of_math(getattr(math, name), traced)
    for name, traced in _MATH.items()
    if hasattr(math, name)
}
_REPLACEMENTS |= {(np, n): _constructor(n, getattr(np, n)) for n in (*_MAKING, *_KEEPING)}
_ORIGINALS = {(module, name): getattr(module, name) for module, name in _REPLACEMENTS}


@contextlib.contextmanager
def patched() -> Iterator[None]:
    """Replace the functions while the block runs, in one thread at a time."""
    with _LOCK:
        if getattr(_THREAD, "traces", False):  # within another trace
            yield
            return
        try:
            _THREAD.traces = True
            _set(_REPLACEMENTS)
            yield
        finally:
            _THREAD.traces = False
            _set(_ORIGINALS)


def _set(functions: dict[tuple[Any, str], Any]) -> None:
    for (module, name), function in functions.items():
        setattr(module, name, function)

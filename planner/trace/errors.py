"""What tracing refuses, and the user's line that asked for it."""

from __future__ import annotations

import inspect
import linecache
import os
import threading
import traceback as tracebacks
from collections.abc import Callable
from types import TracebackType
from typing import Any

import numpy as np

#: Folders whose frames are not the user's code, and packages that compute without NumPy's arrays.
_OWN = (os.path.dirname(os.path.abspath(__file__)), os.path.dirname(os.path.abspath(np.__file__)))
_FOREIGN = ("scipy", "torch", "jax", "numba", "pandas", "sympy", "casadi")
_WRAPPER = "array_api_compat"


class Raised(threading.local):
    """The last refusal in this thread: a function that catches it is not what it is on numbers."""

    last: TraceError | None = None


raised = Raised()


class TraceError(TypeError):
    """The code does something with its arguments that cannot be recorded.

    `function` is what was called: "np.sort", "a branch (if, and, or, while)", "float()", ...;
    `where` the user's line, "file.py:12: source", empty if unknown.
    """

    def __init__(self, message: str, function: str = "", where: str = "") -> None:
        super().__init__(message)
        self.function, self.where = function, where
        raised.last = self


class OpaqueError(TraceError):
    """The code asks for plain numbers: it leaves NumPy, for float(), Torch or compiled code."""


def user_line(traceback: TracebackType | None) -> str:
    """The innermost of the user's lines that led to an exception: "file.py:12: source"."""
    for frame, number in reversed(list(tracebacks.walk_tb(traceback))):
        if not _is_foreign(frame.f_code.co_filename):
            return _line(frame.f_code.co_filename, number, frame.f_globals)
    return ""


def definition(function: Callable[..., Any]) -> str:
    """Where a function is defined, "file.py:12: source"; empty if it is not written in Python."""
    function = inspect.unwrap(getattr(function, "func", function))
    code = getattr(function, "__code__", None)
    if code is None or _is_foreign(code.co_filename):
        return ""
    return _line(code.co_filename, code.co_firstlineno, getattr(function, "__globals__", None))


def in_foreign_package(traceback: TracebackType | None) -> bool:
    """Whether the exception came from inside a package that computes without NumPy's arrays."""
    packages = {_package(frame.f_code.co_filename) for frame, _ in tracebacks.walk_tb(traceback)}
    return not packages.isdisjoint(_FOREIGN)


def _package(file: str) -> str:
    """The installed package that a file belongs to; empty if it is not installed."""
    parts = file.split(os.sep)
    for folder in {"site-packages", "dist-packages"}.intersection(parts[:-1]):
        return parts[parts.index(folder) + 1]
    return ""


def _is_foreign(file: str) -> bool:
    """Whether a file is not the user's: generated, ours, NumPy's or of the packages above."""
    generated = file.startswith((*_OWN, "<__array", "<stringsource>", "<frozen importlib"))
    installed = _package(file) in (*_FOREIGN, _WRAPPER)
    return generated or installed or file.endswith((".pyx", ".pxd"))


def _line(file: str, number: int, scope: dict[str, Any] | None) -> str:
    source = linecache.getline(file, number, scope).strip()
    return f"{os.path.basename(file)}:{number}: {source}".removesuffix(": ")

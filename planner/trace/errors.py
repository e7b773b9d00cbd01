"""What tracing refuses, and the user's line that asked for it."""

from __future__ import annotations

import functools
import inspect
import linecache
import os
from collections.abc import Callable, Iterable
from types import FrameType, TracebackType
from typing import Any

import numpy as np

#: Folders and installed packages whose frames are not the user's code.
_OWN = (os.path.dirname(os.path.abspath(__file__)), os.path.dirname(os.path.abspath(np.__file__)))
_FOREIGN = ("array_api_compat", "scipy", "torch", "jax", "numba", "pandas", "sympy", "casadi")


class TraceError(TypeError):
    """The code does something with its arguments that cannot be recorded.

    Attributes:
        function: what was called: "np.sort", "a branch (if, and, or, while)", "float()", ...
        where: the user's line, "file.py:12: source"; empty if unknown.
    """

    def __init__(self, message: str, function: str = "", where: str = "") -> None:
        super().__init__(message)
        self.function, self.where = function, where


class OpaqueError(TraceError):
    """The code asks for plain numbers: it leaves NumPy, for float(), Torch or compiled code."""


def user_line(traceback: TracebackType | None) -> str:
    """The innermost of the user's lines that led to an exception: "file.py:12: source"."""
    calls = []
    while traceback is not None:
        calls.append((traceback.tb_frame, traceback.tb_lineno))
        traceback = traceback.tb_next
    return _innermost(reversed(calls))


def definition(function: Callable[..., Any]) -> str:
    """Where a function is defined, "file.py:12: source"; empty if it is not written in Python."""
    while isinstance(function, functools.partial):
        function = function.func
    function = inspect.unwrap(function)
    code = getattr(function, "__code__", None)
    if code is None or _is_foreign(code.co_filename):
        return ""
    return _line(code.co_filename, code.co_firstlineno, getattr(function, "__globals__", None))


def in_foreign_package(traceback: TracebackType | None) -> bool:
    """Whether the exception came from inside a package that computes without NumPy's arrays."""
    while traceback is not None:
        package = _package(traceback.tb_frame.f_code.co_filename)
        if package in _FOREIGN and package != "array_api_compat":
            return True
        traceback = traceback.tb_next
    return False


def _package(file: str) -> str:
    """The installed package that a file belongs to; empty if it is not installed."""
    parts = file.split(os.sep)
    for folder in ("site-packages", "dist-packages"):
        if folder in parts[:-1]:
            return parts[parts.index(folder) + 1]
    return ""


def _is_foreign(file: str) -> bool:
    """Whether a file is not the user's: ours, NumPy's or of the packages above."""
    generated = file.startswith("<__array") or "importlib" in file
    generated = generated or file == "<stringsource>" or file.endswith((".pyx", ".pxd"))
    return generated or file.startswith(_OWN) or _package(file) in _FOREIGN


def _innermost(calls: Iterable[tuple[FrameType, int]]) -> str:
    for frame, number in calls:
        file = frame.f_code.co_filename
        if not _is_foreign(file):
            return _line(file, number, frame.f_globals)
    return ""


def _line(file: str, number: int, scope: dict[str, Any] | None) -> str:
    source = linecache.getline(file, number, scope).strip()
    return f"{os.path.basename(file)}:{number}: {source}".removesuffix(": ")

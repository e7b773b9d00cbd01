"""The last few immutable problems and what was found out about them, by identity.

Checking and completing a problem takes longer than one sub-problem. For a frozen dataclass of
immutable values it need not be done again for the same object; anything else may have changed
between two calls. (By identity, because hashing a problem's numbers costs as much; a bounded
number, because a model refers to its problem, so that weak references would never die.)

The numbers of a frozen dataclass may still lie elsewhere: in attributes of its class, in globals
or in enclosing functions that its methods read. Those are kept too, and compared.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, MutableMapping
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

_KEPT = 64
_MISSING = object()


class Recent:
    """A bounded map from immutable objects to values; for all others it is always empty."""

    def __init__(self) -> None:
        self._kept: dict[int, tuple[Any, list[_Outside], Any]] = {}

    def get(self, key: Any) -> Any:
        """The value kept for this very object, or None."""
        kept = self._kept.get(id(key))
        if kept is None or kept[0] is not key or not all(v.unchanged for v in kept[1]):
            return None
        return kept[2]

    def keep(self, key: Any, value: Any) -> None:
        """Keep a value if the object is immutable, at the cost of the oldest."""
        if not is_immutable(key):
            return
        outside = list(_outside(type(key)))
        if all(_fixed(v.value) for v in outside):
            self._kept[id(key)] = (key, outside, value)
            while len(self._kept) > _KEPT:
                self._kept.pop(next(iter(self._kept)), None)


def is_immutable(problem: Any) -> bool:
    """Whether it is a frozen dataclass of numbers, text, tuples and read-only arrays.

    Of its own accord: a plain subclass of a frozen dataclass takes further attributes.
    """
    parameters = vars(type(problem)).get("__dataclass_params__")
    return (
        parameters is not None
        and parameters.frozen
        and all(_fixed(getattr(problem, field.name)) for field in dataclasses.fields(problem))
    )


def _fixed(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        while isinstance(value, np.ndarray) and not value.flags.writeable:
            if value.base is None:
                return True
            value = value.base  # a read-only view of memory that can be written
        return isinstance(value, bytes)
    if isinstance(value, tuple):
        return all(_fixed(item) for item in value)
    return value is None or isinstance(value, (bool, int, float, complex, str, bytes, np.generic))


@dataclasses.dataclass(frozen=True, slots=True)
class _Outside:
    """A value that a class's methods read, and where it lies: a namespace or a closure's cell."""

    where: Any
    name: str
    value: Any

    @property
    def unchanged(self) -> bool:
        if isinstance(self.where, CellType):
            return _contents(self.where) is self.value
        return self.where.get(self.name, _MISSING) is self.value


def _outside(cls: type) -> Iterator[_Outside]:
    """What the methods of a class read that is neither a field nor code."""
    own = {field.name for field in dataclasses.fields(cls)}
    seen: set[int] = set()
    for base in cls.__mro__[:-1]:
        for name, value in vars(base).items():
            if _is_dunder(name) or name == "_abc_impl":  # the machinery of classes
                continue
            if isinstance(value, functools.cached_property):
                value = value.func
            elif isinstance(value, property):
                value = value.fget
            elif isinstance(value, (staticmethod, classmethod)):
                value = value.__func__
            if isinstance(value, FunctionType):
                yield from _read_by(value, seen)
            elif name not in own and not _is_code(value):
                yield _Outside(vars(base), name, value)


def _read_by(function: FunctionType, seen: set[int]) -> Iterator[_Outside]:
    """Globals and enclosing variables that a function reads, and the functions among them."""
    function = getattr(function, "__wrapped__", function)
    if id(function) in seen or not isinstance(function, FunctionType):
        return
    seen.add(id(function))
    space: MutableMapping[str, Any] = function.__globals__
    names = {name for name in _names(function.__code__) if name in space and not _is_dunder(name)}
    values: list[tuple[Any, str, Any]] = [(space, name, space[name]) for name in sorted(names)]
    values += [(cell, "", _contents(cell)) for cell in function.__closure__ or ()]
    for where, name, value in values:
        if isinstance(value, FunctionType):
            # Of its own module only: libraries are taken to stay as they are.
            if value.__module__ == function.__module__:
                yield from _read_by(value, seen)
        elif not _is_code(value):
            yield _Outside(where, name, value)


def _names(code: CodeType) -> Iterator[str]:
    """Names that code looks up, lambdas and comprehensions in it included."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _contents(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # empty as yet
        return _MISSING


def _is_dunder(name: str) -> bool:
    return name.startswith("__") and name.endswith("__")


def _is_code(value: Any) -> bool:
    """Modules, classes, functions, ufuncs, type variables: no numbers of a problem's."""
    return callable(value) or isinstance(value, ModuleType)

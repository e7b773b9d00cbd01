"""The last few immutable problems and what was found out about them, by identity.

Checking and completing a problem takes longer than one sub-problem. For a frozen dataclass of
immutable values it need not be done again for the same object; anything else may have changed
between two calls. (By identity, because hashing a problem's numbers costs as much; a bounded
number, because a model refers to its problem, so that weak references would never die.)
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

_KEPT = 64


class Recent:
    """A bounded map from immutable objects to values; for all others it is always empty."""

    def __init__(self) -> None:
        self._kept: dict[int, tuple[Any, Any]] = {}

    def get(self, key: Any) -> Any:
        """The value kept for this very object, or None."""
        kept = self._kept.get(id(key))
        return kept[1] if kept is not None and kept[0] is key else None

    def keep(self, key: Any, value: Any) -> None:
        """Keep a value if the object is immutable, at the cost of the oldest."""
        if is_immutable(key):
            self._kept[id(key)] = (key, value)
            while len(self._kept) > _KEPT:
                self._kept.pop(next(iter(self._kept)), None)


def is_immutable(problem: Any) -> bool:
    """Whether it is a frozen dataclass of numbers, text, tuples and read-only arrays."""
    parameters = getattr(type(problem), "__dataclass_params__", None)
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

"""Checks at the boundary: each error names the field, the bad value and what is allowed."""

from __future__ import annotations

import dataclasses
import json
import numbers
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

#: The byte order mark, as some editors begin a file in UTF-8.
MARK = "\ufeff"


def checked_array(
    name: str,
    value: Any,
    shape: tuple[int | None, ...],
    *,
    at_least: float | None = None,
    above: float | None = None,
    repeat_scalar: bool = False,
) -> np.ndarray:
    """`value` as a read-only float64 array of the given shape, finite and in range.

    Args:
        name: what the error calls it.
        value: anything NumPy can turn into an array.
        shape: expected shape; None matches any length.
        at_least: smallest allowed entry.
        above: entries must exceed this.
        repeat_scalar: whether a scalar stands for a whole array.

    Raises:
        ValueError: naming `name`, the bad value and the allowed range or shape.
    """
    try:
        if np.iscomplexobj(value):  # NumPy would only warn and drop the imaginary part
            raise TypeError("complex numbers")
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be an array of numbers, not {value!r}") from error
    if repeat_scalar and array.ndim == 0:
        array = np.full([1 if n is None else n for n in shape], float(array))
    if len(array.shape) != len(shape) or any(
        want is not None and got != want for got, want in zip(array.shape, shape, strict=True)
    ):
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name} must have shape {wanted}, not {array.shape}")
    _check_range(name, array, at_least, above)
    array.setflags(write=False)
    return array


def checked_float(
    name: str, value: Any, *, at_least: float | None = None, above: float | None = None
) -> float:
    """`value` as a finite float in range; see :func:`checked_array`."""
    return float(checked_array(name, value, (), at_least=at_least, above=above))


def checked_int(name: str, value: Any, *, at_least: int, at_most: int | None = None) -> int:
    """`value` as an int in range.

    Raises:
        ValueError: naming `name`, the bad value and the allowed range.
    """
    allowed = f"at least {at_least}" if at_most is None else f"between {at_least} and {at_most}"
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise ValueError(f"{name} must be an integer {allowed}, not {value!r}")
    number = int(value)
    if number < at_least or (at_most is not None and number > at_most):
        raise ValueError(f"{name} must be {allowed}, not {number}")
    return number


def read_text(path: str | Path) -> str:
    """A text file in UTF-8, with or without the byte order mark that some editors write.

    Raises:
        ValueError: for another encoding, naming the file and the encoding.
        OSError: if it cannot be read.
    """
    content = Path(path).read_bytes()
    encoding = json.detect_encoding(content)  # by a byte order mark, or by where zeros are
    if not encoding.startswith("utf-8"):
        raise ValueError(f"{path} is written in {encoding.upper()}: save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        byte, place = content[error.start], error.start
        raise ValueError(
            f"{path} is not written in UTF-8 (byte 0x{byte:02x} at {place}): save it as UTF-8"
        ) from None


def parsed_object(text: Any, kind: str) -> dict[str, Any]:
    """The object that JSON text describes.

    Raises:
        ValueError: if it is no text, no JSON, or no object.
    """
    try:
        data = json.loads(text.removeprefix(MARK) if isinstance(text, str) else text)
    except (ValueError, TypeError) as error:
        raise ValueError(f"not a {kind}: the text is not JSON ({error})") from error
    if not isinstance(data, dict):
        raise ValueError(f"not a {kind}: expected a JSON object, not {type(data).__name__}")
    return data


def replaced(instance: T, kind: str, changes: dict[str, Any]) -> T:
    """A copy of a dataclass with some fields changed, validated again.

    Raises:
        ValueError: for an unknown field or a bad value.
    """
    known = [field.name for field in dataclasses.fields(instance)]  # type: ignore[arg-type]
    unknown = sorted(set(changes) - set(known))
    if unknown:
        raise ValueError(f"a {kind} has no field {unknown}; its fields are {known}")
    return dataclasses.replace(instance, **changes)  # type: ignore[type-var]


def _check_range(name: str, array: np.ndarray, at_least: float | None, above: float | None) -> None:
    if at_least is not None:
        allowed, good = f"finite and >= {at_least:g}", array >= at_least
    elif above is not None:
        allowed, good = f"finite and > {above:g}", array > above
    else:
        allowed, good = "finite", np.ones(array.shape, dtype=bool)
    good = good & np.isfinite(array)
    if not np.all(good):
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        where = f"{name}{list(index)}" if index else name
        raise ValueError(f"{where} must be {allowed}, not {float(array[index])!r}")

"""How numbers of a row are printed: each function makes one that takes the row."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from slipcar.evaluation.report.table import NONE


def with_error(key: str, digits: int = 3) -> Callable[[Any], str]:
    """Text of a mean and its standard error; of the mean alone where a single value has none."""

    def text(row: Any) -> str:
        mean, error = row[key], row[f"{key}_se"]
        return f"{mean:.{digits}f}" + (f" ± {error:.{digits}f}" if error == error else "")

    return text


def with_interval(
    key: str, ends: str, scale: float, digits: int, sign: str = ""
) -> Callable[[Any], str]:
    """Text of a scaled mean and its interval, `ends`_low to `ends`_high, if it has one."""

    def text(row: Any) -> str:
        mean, low, high = (
            f"{scale * row[name]:{sign}.{digits}f}" for name in (key, f"{ends}_low", f"{ends}_high")
        )
        return mean if low in ("nan", "+nan") else f"{mean} [{low}, {high}]"

    return text


def collisions(digits: int, key: str = "collision") -> Callable[[Any], str]:
    """Text of a rate of collisions and its interval, in percent."""
    return with_interval(f"{key}_rate", key, 100.0, digits)


def difference(key: str, scale: float, digits: int) -> Callable[[Any], str]:
    """Text of a scaled difference, with its sign, and its interval."""
    return with_interval(key, key, scale, digits, "+")


def number(key: str, digits: int, scale: float = 1.0) -> Callable[[Any], str]:
    """Text of a number."""
    # + 0.0: no "-0.000"
    return lambda row: f"{round(scale * row[key], digits) + 0.0:.{digits}f}"


def duration(key: str) -> Callable[[Any], str]:
    """Text of seconds, in the unit that suits them."""

    def text(row: Any) -> str:
        seconds = row[key]
        for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
            if seconds >= size:
                return f"{seconds / size:.3g} {unit}"
        if seconds != seconds:
            return NONE
        return f"{seconds / 1e-9:.3g} ns" if seconds > 0.0 else "0 s"

    return text

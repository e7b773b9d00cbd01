"""Expressions as NumPy code over all nodes at once: one call of NumPy for each operation."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from slipcar.planner.trace.graph import Expression, reachable

Array = np.ndarray
_OPERATORS = {
    "add": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "neg": "-{}",
    "greater": "np.greater({}, {}) * 1.0",
    "greater_equal": "np.greater_equal({}, {}) * 1.0",
    "equal": "np.equal({}, {}) * 1.0",
    "where": "np.where(np.greater({}, 0.0), {}, {})",
    "erfc": "erfc({})",
}


def numpy_function(
    inputs: Mapping[str, int],
    outputs: Mapping[str, Sequence[Expression]],
    shared: frozenset[str] = frozenset(),
) -> Callable[..., dict[str, Array]]:
    """A function of arrays, (count, width) each, that computes expressions for every row.

    Args:
        inputs: widths of the inputs by name.
        outputs: expressions in one row of each output.
        shared: inputs that have one row for all.

    Returns:
        Called with the inputs by name, it returns the outputs by name, (count, width) each. It
        raises a ValueError if numbers of rows or widths do not agree.
    """
    arguments = {name: f"a{i}" for i, name in enumerate(inputs)}
    results = {name: f"r{i}" for i, name in enumerate(outputs)}
    lines = _lines(arguments, results, outputs)
    head = ", ".join((*arguments.values(), *results.values()))
    run = _compiled(f"def run({head}):\n    " + "\n    ".join(lines or ["pass"]) + "\n")
    widths = {name: len(entries) for name, entries in outputs.items()}

    def evaluate(**arrays: Array) -> dict[str, Array]:
        rows, count = _rows(arrays, inputs, shared)
        computed = {name: np.zeros((count, width)) for name, width in widths.items()}
        with np.errstate(all="ignore"):
            run(*(row.T for row in rows), *computed.values())
        return computed

    return evaluate


def _lines(
    arguments: dict[str, str], results: dict[str, str], outputs: Mapping[str, Sequence[Expression]]
) -> list[str]:
    """The code: a line for every operation, then one for every entry that is not zero."""
    names: dict[int, str] = {}
    lines = []
    wanted = reachable(e for entries in outputs.values() for e in entries if not e.is_zero)
    for e in wanted:
        if e.op == "constant":
            names[e.index] = f"({e.value!r})"
        elif e.op == "input":
            name, entry = e.value
            names[e.index] = f"{arguments[name]}[{entry}]"
        else:
            operands = [names[a.index] for a in e.args]
            code = _OPERATORS.get(e.op) or f"np.{e.op}({', '.join(['{}'] * len(operands))})"
            names[e.index] = f"v{e.index}"
            lines.append(f"v{e.index} = {code.format(*operands)}")
    for name, entries in outputs.items():
        lines += [
            f"{results[name]}[:, {i}] = {names[e.index]}"
            for i, e in enumerate(entries)
            if not e.is_zero
        ]
    return lines


def _rows(
    arrays: Mapping[str, Array], inputs: Mapping[str, int], shared: frozenset[str]
) -> tuple[list[Array], int]:
    """The inputs as rows of float64, (count, width) each, and their count.

    Raises:
        ValueError: if they do not agree.
    """
    rows, count = [], None
    for name, width in inputs.items():
        given = np.asarray(arrays[name], dtype=np.float64)
        row = given.reshape(len(given) if width == 0 else -1, width)
        expected = 1 if name in shared else count
        if expected is not None and len(row) != expected:
            raise ValueError(f"{name} must have {expected} rows, not {len(row)}")
        if name not in shared:
            count = len(row)
        rows.append(row)
    return rows, 1 if count is None else count


@functools.lru_cache(maxsize=256)
def _compiled(text: str) -> Callable[..., None]:
    scope: dict[str, Any] = {"np": np, "inf": np.inf, "nan": np.nan, "erfc": _erfc}
    exec(compile(text, "<slipcar traced>", "exec"), scope)
    return scope["run"]


def _erfc(x: Array) -> Array:
    from scipy.special import erfc

    return erfc(x)

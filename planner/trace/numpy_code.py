"""Expressions as NumPy code over all nodes at once: one call of NumPy for each operation."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from slipcar.planner.trace.derivatives import OPERATIONS
from slipcar.planner.trace.graph import Expression, reachable

Array = np.ndarray


def numpy_function(
    inputs: Mapping[str, int],
    outputs: Mapping[str, Sequence[Expression]],
    shared: frozenset[str] = frozenset(),
) -> Callable[..., dict[str, Array]]:
    """A function of arrays (count, width) that computes the outputs' expressions for every row.

    Called with the inputs by name, whose widths are given, it returns the outputs by name; inputs
    that are shared have one row for all. It raises a ValueError if rows do not agree.
    """
    run = _compiled(_code(inputs, outputs))
    widths = {name: len(entries) for name, entries in outputs.items()}

    def evaluate(**arrays: Array) -> dict[str, Array]:
        rows, count = _rows(arrays, inputs, shared)
        computed = {name: np.zeros((count, width)) for name, width in widths.items()}
        with np.errstate(all="ignore"):
            run(*(row.T for row in rows), *computed.values())
        return computed

    return evaluate


def _code(inputs: Mapping[str, int], outputs: Mapping[str, Sequence[Expression]]) -> str:
    """A line for every operation, then one for every entry that is not zero."""
    arguments = {name: f"a{i}" for i, name in enumerate(inputs)}
    head = ", ".join((*arguments.values(), *(f"r{i}" for i in range(len(outputs)))))
    lines = [f"def run({head}):", "pass"]
    names: dict[int, str] = {}
    for e in reachable(e for entries in outputs.values() for e in entries if not e.is_zero):
        if e.op == "constant":
            names[e.index] = f"({e.value!r})"
        elif e.op == "input":
            name, entry = e.value
            names[e.index] = f"{arguments[name]}[{entry}]"
        else:
            kind, name = OPERATIONS[e.op], f"v{e.index}"
            call = kind.numpy or f"np.{e.op}({', '.join(['{}'] * kind.arity)})"
            lines.append(f"{name} = {call.format(*(names[a.index] for a in e.args))}")
            names[e.index] = name
    for i, entries in enumerate(outputs.values()):
        wanted = ((j, e) for j, e in enumerate(entries) if not e.is_zero)
        lines += [f"r{i}[:, {j}] = {names[e.index]}" for j, e in wanted]
    return "\n    ".join(lines)


def _rows(
    arrays: Mapping[str, Array], inputs: Mapping[str, int], shared: frozenset[str]
) -> tuple[list[Array], int]:
    """The inputs as rows of float64, (count, width) each, and their count."""
    rows = {}
    for name, width in inputs.items():
        given = np.asarray(arrays[name], dtype=np.float64)
        rows[name] = given.reshape(len(given) if width == 0 else -1, width)
    count = max((len(row) for name, row in rows.items() if name not in shared), default=1)
    for name, row in rows.items():
        expected = 1 if name in shared else count
        if len(row) != expected:
            raise ValueError(f"{name} must have {expected} rows, not {len(row)}")
    return list(rows.values()), count


@functools.lru_cache(maxsize=256)
def _compiled(text: str) -> Callable[..., None]:
    scope: dict[str, Any] = {"np": np, "inf": np.inf, "nan": np.nan}
    if "erfc(" in text:  # an import that takes long
        from scipy.special import erfc

        scope["erfc"] = erfc
    exec(compile(text, "<slipcar traced>", "exec"), scope)
    return scope["run"]

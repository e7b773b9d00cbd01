"""Expressions as NumPy code over all nodes at once: what runs where there is no compiler.

The same functions as :mod:`.llvm` makes, with the same interface; one NumPy call for each
operation, whatever the number of nodes.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from slipcar.planner.trace.expression import Expression, reachable

_OPERATORS = {"add": "{} + {}", "sub": "{} - {}", "mul": "{} * {}", "div": "{} / {}"}


@dataclasses.dataclass(frozen=True)
class VectorizedKernel:
    """A generated function; see :class:`slipcar.planner.trace.llvm.Kernel`.

    Attributes:
        inputs: widths of the rows of each input.
        outputs: widths of the rows of each output.
        shared: names of inputs with one row for all nodes.
    """

    inputs: dict[str, int]
    outputs: dict[str, int]
    shared: frozenset[str]
    run: Callable[..., None] = dataclasses.field(repr=False)

    def __call__(self, **arrays: np.ndarray) -> dict[str, np.ndarray]:
        """Evaluate: inputs by name, (count, width) each -> outputs by name."""
        rows, count = rows_of(arrays, self.inputs, self.shared)
        out = {name: np.zeros((count, width)) for name, width in self.outputs.items()}
        self.run(*(array.T for array in rows.values()), *out.values())
        return out

    def unchecked(self, **arrays: np.ndarray) -> dict[str, np.ndarray]:
        """The same for float64 arrays of the right shapes: (count, width), or (count,) for one."""
        columns = [a if a.ndim == 1 else a.T for a in (arrays[name] for name in self.inputs)]
        columns = [c[None] if c.ndim == 1 else c for c in columns]
        count = columns[0].shape[1]
        out = {name: np.zeros((count, width)) for name, width in self.outputs.items()}
        self.run(*columns, *out.values())
        return out


def rows_of(
    arrays: dict[str, np.ndarray], widths: dict[str, int], shared: frozenset[str]
) -> tuple[dict[str, np.ndarray], int]:
    """Arguments of a kernel as contiguous rows (count, width), and their count.

    Raises:
        ValueError: if they differ in their numbers of rows: native code would not notice.
    """
    rows, count = {}, None
    for name, width in widths.items():
        given = np.asarray(arrays[name], dtype=np.float64)
        row = np.ascontiguousarray(given.reshape(len(given) if width == 0 else -1, width))
        expected = 1 if name in shared else count
        if expected is not None and len(row) != expected:
            raise ValueError(f"{name} must have {expected} rows, not {len(row)}")
        if name not in shared:
            count = len(row)
        rows[name] = row
    return rows, 1 if count is None else count


def vectorize_kernel(
    inputs: dict[str, int],
    outputs: dict[str, Sequence[Expression]],
    shared: frozenset[str] = frozenset(),
) -> VectorizedKernel:
    """Generate the NumPy function for the expressions of some outputs; arguments as for llvm."""
    names: dict[int, str] = {}
    lines: list[str] = []
    wanted = reachable(e for entries in outputs.values() for e in entries if not e.is_zero)
    for e in wanted:
        args = [names[a.index] for a in e.args]
        if e.op == "constant":
            names[e.index] = f"({e.value!r})"
            continue
        if e.op == "input":
            array, entry = e.value
            names[e.index] = f"{array}_[{entry}]"
            continue
        names[e.index] = f"v{e.index}"
        if e.op in _OPERATORS:
            code = _OPERATORS[e.op].format(*args)
        elif e.op == "neg":
            code = f"-{args[0]}"
        else:
            code = f"np.{e.op}({', '.join(args)})"
        lines.append(f"v{e.index} = {code}")
    for array, entries in outputs.items():
        lines += [
            f"{array}_[:, {i}] = {names[e.index]}" for i, e in enumerate(entries) if not e.is_zero
        ]
    arguments = ", ".join(f"{name}_" for name in (*inputs, *outputs))
    body = "\n    ".join(lines or ["pass"])
    return VectorizedKernel(
        inputs=dict(inputs),
        outputs={name: len(entries) for name, entries in outputs.items()},
        shared=shared,
        run=_compiled(f"def run({arguments}):\n    {body}\n"),
    )


@functools.lru_cache(maxsize=256)
def _compiled(text: str) -> Callable[..., None]:
    scope: dict[str, Any] = {"np": np, "inf": np.inf, "nan": np.nan}
    exec(compile(text, "<slipcar traced>", "exec"), scope)
    return scope["run"]

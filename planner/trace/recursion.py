"""Loops over nodes, written once: what happens at a node, and what is carried to the next one.

A :class:`Recursion` reads and writes rows of named arrays (:class:`Layout`) and carries values from
node to node. It runs as machine code (:mod:`.emit`, on arrays of expressions) or in NumPy
(:func:`in_numpy`, on numbers): the same Python functions either way.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from slipcar.planner.trace.graph import Expression, Graph

Array = np.ndarray
Carried = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Field:
    """An array of a layout.

    Attributes:
        shape: of one row.
        single: whether it has one row for all nodes.
    """

    shape: tuple[int, ...]
    single: bool = False

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return math.prod(self.shape)


Layout = Mapping[str, Field]


@dataclasses.dataclass(frozen=True)
class Recursion:
    """A loop over nodes 0..K−1 (or back), between a beginning and an end.

    Ascending, `start` looks at node 0 and `end` at node K; descending it is the other way round.

    Attributes:
        name: of the kernel.
        step: (rows at a node, carried) -> carried to the next one.
        start: rows where it begins -> carried to the first node.
        end: (rows where it ends, carried); None does nothing there.
        descending: whether it goes from node K − 1 to node 0.
    """

    name: str
    step: Callable[[Any, Carried], Carried]
    start: Callable[[Any], Carried]
    end: Callable[[Any, Carried], None] | None = None
    descending: bool = False


@dataclasses.dataclass(frozen=True)
class Symmetric:
    """A symmetric matrix to be carried: its upper triangle is enough."""

    matrix: Array


def pack(carried: Carried) -> tuple[list[Any], Callable[[list[Any]], Carried]]:
    """Carried values as one flat list, and the function that puts such a list together again."""
    flat: list[Any] = []
    parts: list[tuple[str, tuple[int, ...], Any]] = []
    for name, value in carried.items():
        if isinstance(value, Symmetric):
            upper = np.triu_indices(len(value.matrix))
            parts.append((name, value.matrix.shape, upper))
            flat.extend(value.matrix[upper])
        else:
            value = np.asarray(value)
            parts.append((name, value.shape, None))
            flat.extend(value.ravel())

    def unpack(values: list[Any]) -> Carried:
        rest = iter(values)
        return {name: _part(rest, shape, upper) for name, shape, upper in parts}

    return flat, unpack


def _part(values: Iterator[Any], shape: tuple[int, ...], upper: Any) -> Any:
    if upper is None:
        array = np.empty(math.prod(shape), dtype=object)
        for i in range(len(array)):
            array[i] = next(values)
        return array.reshape(shape) if shape else array[0]
    full = np.empty(shape, dtype=object)
    for i, j in zip(*upper, strict=True):
        full[i, j] = full[j, i] = next(values)
    return full


class SymbolRows:
    """Rows of a layout as symbols of a graph; entries known to be constant are constants.

    Args:
        graph: owner of the symbols.
        layout: the arrays.
        known: arrays of expressions, entries of which that are constants replace the symbols.
    """

    AHEAD = ">"

    def __init__(self, graph: Graph, layout: Layout, known: Mapping[str, Array]) -> None:
        self.graph, self._layout, self._known = graph, layout, known
        self.writes: dict[tuple[str, int], Expression] = {}
        self._read: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        return self._symbols(name, name)

    def ahead(self, name: str) -> Any:
        """The row of the next node."""
        return self._symbols(name, name + self.AHEAD)

    def _symbols(self, name: str, place: str) -> Any:
        if place not in self._read:
            symbols = self.graph.inputs(place, self._layout[name].shape)
            if symbols.ndim == 0:
                symbols = symbols[()]
            elif name in self._known:
                for index, entry in np.ndenumerate(self._known[name]):
                    if entry.op == "constant":
                        symbols[index] = entry
            self._read[place] = symbols
        value = self._read[place]
        return value.copy() if isinstance(value, np.ndarray) else value

    def write(self, name: str, value: Any) -> None:
        """Store a row of this node."""
        self._write(name, name, value)

    def write_ahead(self, name: str, value: Any) -> None:
        """Store a row of the next node."""
        self._write(name, name + self.AHEAD, value)

    def _write(self, name: str, place: str, value: Any) -> None:
        flat = np.ravel(np.asarray(value, dtype=object))
        if len(flat) != self._layout[name].width:
            raise ValueError(f"{name} has rows of {self._layout[name].width}, not {len(flat)}")
        for i, entry in enumerate(flat):
            self.writes[place, i] = self.graph.lift(entry)


class NumberRows:
    """Rows of a layout as views of arrays of numbers, those of node k."""

    def __init__(self, layout: Layout, arrays: Mapping[str, Array]) -> None:
        self._layout, self._arrays, self.k = layout, arrays, 0

    def _row(self, name: str, k: int) -> Array:
        field = self._layout[name]
        return self._arrays[name][0 if field.single else k].reshape(field.shape)

    def __getitem__(self, name: str) -> Any:
        row = self._row(name, self.k)
        return row.copy() if row.ndim else row[()]

    def ahead(self, name: str) -> Any:
        """The row of the next node."""
        row = self._row(name, self.k + 1)
        return row.copy() if row.ndim else row[()]

    def write(self, name: str, value: Any) -> None:
        """Store a row of this node."""
        self._row(name, self.k)[...] = np.reshape(
            np.asarray(value, float), self._layout[name].shape
        )

    def write_ahead(self, name: str, value: Any) -> None:
        """Store a row of the next node."""
        field = self._layout[name]
        self._row(name, self.k + 1)[...] = np.reshape(np.asarray(value, float), field.shape)


@np.errstate(all="ignore")
def in_numpy(recursion: Recursion, layout: Layout, arrays: Mapping[str, Array], K: int) -> None:
    """Run a recursion over K intervals on arrays of numbers, node by node."""
    rows = NumberRows(layout, arrays)
    rows.k = K if recursion.descending else 0
    carried = _plain(recursion.start(rows))
    for k in range(K - 1, -1, -1) if recursion.descending else range(K):
        rows.k = k
        carried = _plain(recursion.step(rows, carried))
    if recursion.end is not None:
        rows.k = 0 if recursion.descending else K
        recursion.end(rows, carried)


def _plain(carried: Carried) -> Carried:
    return {n: v.matrix if isinstance(v, Symmetric) else v for n, v in carried.items()}

"""Loops over nodes, written once: what happens at a node, and what is carried to the next one.

A :class:`Recursion` reads and writes rows of named arrays (:class:`Layout`) and carries values from
node to node. It runs as machine code (:mod:`.emit`, on arrays of expressions) or in NumPy
(:func:`in_numpy`, on numbers): the same Python functions either way.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partialmethod
from typing import Any

import numpy as np

from slipcar.planner.trace.graph import Expression, Graph

Array = np.ndarray
Carried = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Field:
    """An array of a layout: rows of a shape, one for each node, or a single one for all."""

    shape: tuple[int, ...]
    single: bool = False

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return math.prod(self.shape)


Layout = Mapping[str, Field]


@dataclasses.dataclass(frozen=True)
class Recursion:
    """A loop over nodes 0..K−1, or back if it is descending, between a beginning and an end.

    What is carried from node to node `start` makes of the rows at node 0, and `step` of those at
    every node; `end` looks at node K. Descending, it begins at K and ends at 0.
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
    places: dict[str, Array] = {}  # of every entry in the list
    for name, value in carried.items():
        if isinstance(value, Symmetric):
            upper = np.triu_indices(len(value.matrix))
            places[name] = np.zeros(value.matrix.shape, dtype=int)
            places[name][upper] = places[name].T[upper] = len(flat) + np.arange(len(upper[0]))
            flat.extend(value.matrix[upper])
        else:
            value = np.asarray(value)
            places[name] = len(flat) + np.arange(value.size).reshape(value.shape)
            flat.extend(value.ravel())

    def unpack(values: list[Any]) -> Carried:
        entries = np.empty(len(values), dtype=object)
        entries[:] = values
        return {name: entries[place] for name, place in places.items()}

    return flat, unpack


class SymbolRows:
    """Rows of a layout as symbols of a graph, of arrays in `known` as the constants they hold.

    Arrays begin at zero: zeros that are known are not written.

    Attributes:
        writes: expressions by place and entry; the place of the next node's row ends in `AHEAD`.
    """

    AHEAD = ">"

    def __init__(self, graph: Graph, layout: Layout, known: Mapping[str, Array]) -> None:
        self.graph, self._layout, self._known = graph, layout, known
        self.writes: dict[tuple[str, int], Expression] = {}
        self._rows: dict[str, Array] = {}  # read or written so far

    def __getitem__(self, name: str, ahead: bool = False) -> Any:
        place = name + self.AHEAD * ahead
        if place not in self._rows:
            symbols = self._rows[place] = self.graph.inputs(place, self._layout[name].shape)
            for index, entry in np.ndenumerate(self._known.get(name, ()) if symbols.ndim else ()):
                if entry.op == "constant":
                    symbols[index] = entry
        row = self._rows[place]
        return row.copy() if row.ndim else row[()]

    def write(self, name: str, value: Any, ahead: bool = False) -> None:
        """Store a row of this node, or of the next."""
        flat, field = np.ravel(np.asarray(value, dtype=object)), self._layout[name]
        if len(flat) != field.width:
            raise ValueError(f"{name} has rows of {field.width}, not {len(flat)}")
        place, row = name + self.AHEAD * ahead, np.empty(field.width, dtype=object)
        row[:] = list(map(self.graph.lift, flat))
        known = np.ravel(self._known.get(name, ()))
        there = {i for i, entry in enumerate(known) if entry.is_zero and row[i].is_zero}
        self.writes.update({(place, i): row[i] for i in range(len(row)) if i not in there})
        self._rows[place] = row.reshape(field.shape)  # what is written is read again

    ahead, write_ahead = partialmethod(__getitem__, ahead=True), partialmethod(write, ahead=True)


class NumberRows:
    """Rows of a layout as views of arrays of numbers, those of node k."""

    def __init__(self, layout: Layout, arrays: Mapping[str, Array]) -> None:
        self._layout, self._arrays, self.k = layout, arrays, 0

    def _view(self, name: str, ahead: bool) -> Array:
        field = self._layout[name]
        return self._arrays[name][0 if field.single else self.k + ahead].reshape(field.shape)

    def __getitem__(self, name: str, ahead: bool = False) -> Any:
        row = self._view(name, ahead)
        return row.copy() if row.ndim else row[()]

    def write(self, name: str, value: Any, ahead: bool = False) -> None:
        """Store a row of this node, or of the next."""
        row = self._view(name, ahead)
        row[...] = np.reshape(np.asarray(value, float), row.shape)

    ahead, write_ahead = partialmethod(__getitem__, ahead=True), partialmethod(write, ahead=True)


@np.errstate(all="ignore")
def in_numpy(
    recursion: Recursion,
    layout: Layout,
    arrays: Mapping[str, Array],
    K: int,
    before: Callable[[int], None] | None = None,
) -> None:
    """Run a recursion over K intervals on arrays of numbers, node by node.

    `before` is called with each node's number before its step, to fill in what the step reads.
    """
    rows, down = NumberRows(layout, arrays), recursion.descending
    rows.k = K if down else 0
    carried = _plain(recursion.start(rows))
    for k in range(K - 1, -1, -1) if down else range(K):
        rows.k = k
        if before is not None:
            before(k)
        carried = _plain(recursion.step(rows, carried))
    if recursion.end is not None:
        rows.k = 0 if down else K
        recursion.end(rows, carried)


def _plain(carried: Carried) -> Carried:
    return {n: v.matrix if isinstance(v, Symmetric) else v for n, v in carried.items()}

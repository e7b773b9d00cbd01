"""Recursions as LLVM's assembly: one function each, a loop round straight lines of arithmetic.

    void name(i64 K, ptr table)        table: addresses of the arrays, in the layout's order

There are no common sub-expressions and no zeros in the straight lines (expressions are hash-consed
and folded), so there is little left to optimise.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from slipcar.planner.trace.derivatives import OPERATIONS
from slipcar.planner.trace.graph import Expression, Graph, reachable
from slipcar.planner.trace.recursion import Layout, Recursion, SymbolRows, pack


class Block:
    """Straight-line code at one node; functions that it calls are added to `external`."""

    def __init__(self, layout: Layout, prefix: str, external: dict[str, int]) -> None:
        self._layout, self._prefix, self._external = layout, prefix, external
        self.lines: list[str] = []
        self.names: dict[int, str] = {}  # of values, by the indices of their expressions
        self.rows: dict[str, str] = {}  # names of addresses, by place

    def value(self, wanted: Expression) -> str:
        """The name of an expression's value, after the code that computes it."""
        for e in reachable([wanted], self.names):
            self.names[e.index] = self._compute(e)
        return self.names[wanted.index]

    def store(self, writes: Mapping[tuple[str, int], Expression]) -> None:
        """Write values into rows: all are computed before one can be overwritten."""
        values = {place: self.value(e) for place, e in writes.items()}
        for i, ((place, entry), value) in enumerate(values.items()):
            address = f"%{self._prefix}s{i}"
            self._point(address, place, entry)
            self.lines.append(f"store double {value}, ptr {address}")

    def _point(self, address: str, place: str, entry: int) -> None:
        """The address of an entry in a row of this node, or of the next (`name>`)."""
        if place not in self.rows:
            name = place.removesuffix(SymbolRows.AHEAD)
            row, offset = f"%{self._prefix}.row{len(self.rows)}", "0"
            if not self._layout[name].single:
                node, offset = "at" if place == name else "next", f"{row}.offset"
                width = self._layout[name].width
                self.lines.append(f"{offset} = mul i64 %{self._prefix}.{node}, {width}")
            self.lines.append(f"{row} = getelementptr double, ptr %base.{name}, i64 {offset}")
            self.rows[place] = row
        self.lines.append(f"{address} = getelementptr double, ptr {self.rows[place]}, i64 {entry}")

    def _compute(self, e: Expression) -> str:
        """The name of a value whose operands are there; of a constant, itself."""
        if e.op == "constant":
            return literal(e.value)
        name, args = f"%{self._prefix}v{e.index}", [self.names[a.index] for a in e.args]
        if e.op == "input":
            self._point(f"{name}p", *e.value)
            self.lines.append(f"{name} = load double, ptr {name}p")
            return name
        llvm = OPERATIONS[e.op].llvm or e.op
        operands, given = ", ".join(args), [f"double {a}" for a in args]
        if llvm.startswith("fcmp"):
            lines = [f"c = {llvm} double {operands}", f" = uitofp i1 {name}c to double"]
        elif e.op == "where":
            test = f"c = fcmp ogt {given[0]}, {literal(0.0)}"
            lines = [test, f" = select i1 {name}c, {given[1]}, {given[2]}"]
        elif e.op == "sign":  # ±1, or x + 0: not a number if x is none
            lines = [
                f"z = fadd {given[0]}, {literal(0.0)}",
                f"d = fcmp olt {given[0]}, {literal(0.0)}",
                f"n = select i1 {name}d, double {literal(-1.0)}, double {name}z",
                f"u = fcmp ogt {given[0]}, {literal(0.0)}",
                f" = select i1 {name}u, double {literal(1.0)}, double {name}n",
            ]
        elif e.op in ("add", "sub", "mul", "div", "neg"):
            lines = [f" = {llvm} double {operands}"]
        else:
            self._external[llvm] = len(args)
            lines = [f" = call double @{llvm}({', '.join(given)})"]
        self.lines.extend(name + line for line in lines)
        return name


def literal(value: float) -> str:
    """A double, to the last bit, as LLVM writes it."""
    return "0x" + struct.pack(">d", value).hex().upper()


def module(
    recursions: Sequence[Recursion], graph: Graph, layout: Layout, known: Mapping[str, np.ndarray]
) -> str:
    """Assembly of some recursions, a function each, on arrays in the layout's order.

    Expressions are those of the graph; for `known` see :class:`.recursion.SymbolRows`.
    """
    external: dict[str, int] = {}
    functions = [_function(r, graph, layout, known, external) for r in recursions]
    given = {name: ", ".join(["double"] * arity) for name, arity in external.items()}
    return "\n".join([*(f"declare double @{f}({given[f]})" for f in given), *functions])


def _function(
    recursion: Recursion,
    graph: Graph,
    layout: Layout,
    known: Mapping[str, np.ndarray],
    external: dict[str, int],
) -> str:
    start, node, end = (Block(layout, p, external) for p in ("start", "node", "end"))
    rows = SymbolRows(graph, layout, known)
    begun, unpack = pack(recursion.start(rows))
    initial = [start.value(graph.lift(e)) for e in begun]
    start.store(rows.writes)

    symbols = list(graph.inputs(f"{recursion.name}.carried", (len(begun),)))
    rows = SymbolRows(graph, layout, known)
    following, _ = pack(recursion.step(rows, unpack(symbols)))
    node.names.update({symbol.index: f"%carried{i}" for i, symbol in enumerate(symbols)})
    after = [node.value(graph.lift(e)) for e in following]
    node.store(rows.writes)

    if recursion.end is not None:
        rows = SymbolRows(graph, layout, known)
        recursion.end(rows, unpack(symbols))
        end.names.update({s.index: name for s, name in zip(symbols, after, strict=True)})
        end.store(rows.writes)
    phis = [
        f"%carried{i} = phi double [{a}, %start], [{b}, %node]"
        for i, (a, b) in enumerate(zip(initial, after, strict=True))
    ]
    return "\n".join(_lines(recursion, layout, (start, node, end), phis))


def _lines(
    recursion: Recursion, layout: Layout, blocks: tuple[Block, Block, Block], phis: list[str]
) -> list[str]:
    used = {place.removesuffix(SymbolRows.AHEAD) for block in blocks for place in block.rows}
    bases = [
        f"%slot.{name} = getelementptr ptr, ptr %table, i64 {i}\n"
        f"%base.{name} = load ptr, ptr %slot.{name}"
        for i, name in enumerate(layout)
        if name in used
    ]
    start, node, end = blocks
    down = recursion.descending
    return [
        f"define void @{recursion.name}(i64 %K, ptr %table) {{",
        "start:",
        *bases,
        "%last = sub i64 %K, 1",
        f"%start.at = add i64 {'%K' if down else '0'}, 0",
        "%start.next = add i64 %start.at, 1",
        *start.lines,
        "br label %node",
        "node:",
        "%k = phi i64 [0, %start], [%k.next, %node]",
        *phis,
        f"%node.at = {'sub i64 %last, %k' if down else 'add i64 %k, 0'}",
        "%node.next = add i64 %node.at, 1",
        *node.lines,
        "%k.next = add i64 %k, 1",
        "%more = icmp slt i64 %k.next, %K",
        "br i1 %more, label %node, label %done",
        "done:",
        f"%end.at = add i64 {'0' if down else '%K'}, 0",
        "%end.next = add i64 %end.at, 1",
        *end.lines,
        "ret void",
        "}",
    ]

"""Recursions as LLVM's assembly: one function each, a loop round straight lines of arithmetic.

    void name(i64 K, ptr table)        table: addresses of the arrays, in the layout's order

There are no common sub-expressions and no zeros in the straight lines (expressions are hash-consed
and folded), so there is little left to optimise.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from slipcar.planner.trace.graph import Expression, Graph
from slipcar.planner.trace.recursion import Layout, Recursion, SymbolRows, pack

_OPERATORS = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_COMPARISONS = {"greater": "ogt", "greater_equal": "oge", "equal": "oeq"}
_INTRINSICS = {
    **{name: name for name in ("sin", "cos", "exp", "log", "sqrt", "floor", "exp2", "log2", "log10")},
    "abs": "fabs",
    "minimum": "minimum",
    "maximum": "maximum",
}  # fmt: skip
#: NumPy's names where the C library's differ.
_C_NAMES = {
    "arcsin": "asin", "arccos": "acos", "arctan": "atan", "arctan2": "atan2", "power": "pow",
    "arcsinh": "asinh", "arccosh": "acosh", "arctanh": "atanh",
}  # fmt: skip


class Block:
    """Straight-line code at one node.

    Args:
        layout: the arrays.
        prefix: of its names.
        external: functions called so far and their numbers of arguments; added to.
    """

    def __init__(self, layout: Layout, prefix: str, external: dict[str, int]) -> None:
        self._layout, self._prefix, self._external = layout, prefix, external
        self.lines: list[str] = []
        self.names: dict[int, str] = {}
        self.rows: dict[str, str] = {}
        self._calls: dict[tuple[str, str], str] = {}

    def value(self, wanted: Expression) -> str:
        """The name of an expression's value, after the code that computes it."""
        stack = [wanted]
        while stack:
            e = stack[-1]
            if e.index in self.names:
                stack.pop()
                continue
            missing = [a for a in e.args if a.index not in self.names]
            if missing:
                stack.extend(reversed(missing))
                continue
            stack.pop()
            self.names[e.index] = self._compute(e)
        return self.names[wanted.index]

    def store(self, place: str, entry: int, value: str) -> None:
        """Write a value into a row."""
        address = f"%{self._prefix}s{len(self.lines)}"
        self.lines.append(f"{address} = getelementptr double, ptr {self._row(place)}, i64 {entry}")
        self.lines.append(f"store double {value}, ptr {address}")

    def _row(self, place: str) -> str:
        """The address of a row of this node, or of the next (`name>`)."""
        if place not in self.rows:
            name = place.removesuffix(SymbolRows.AHEAD)
            field = self._layout[name]
            row = self.rows[place] = f"%{self._prefix}.row{len(self.rows)}"
            if field.single:
                self.lines.append(f"{row} = getelementptr double, ptr %base.{name}, i64 0")
            else:
                node = f"%{self._prefix}.{'at' if place == name else 'next'}"
                self.lines.append(f"{row}.offset = mul i64 {node}, {field.width}")
                self.lines.append(
                    f"{row} = getelementptr double, ptr %base.{name}, i64 {row}.offset"
                )
        return self.rows[place]

    def _compute(self, e: Expression) -> str:
        if e.op == "constant":
            return literal(e.value)
        name, lines = f"%{self._prefix}v{e.index}", self.lines
        args = [self.names[a.index] for a in e.args]
        if e.op == "input":
            place, entry = e.value
            lines.append(f"{name}p = getelementptr double, ptr {self._row(place)}, i64 {entry}")
            lines.append(f"{name} = load double, ptr {name}p")
        elif e.op in _OPERATORS:
            lines.append(f"{name} = {_OPERATORS[e.op]} contract double {', '.join(args)}")
        elif e.op == "neg":
            lines.append(f"{name} = fneg double {args[0]}")
        elif e.op == "where":
            lines.append(f"{name}c = fcmp ogt double {args[0]}, {literal(0.0)}")
            lines.append(f"{name} = select i1 {name}c, double {args[1]}, double {args[2]}")
        elif e.op in _COMPARISONS:
            lines.append(f"{name}c = fcmp {_COMPARISONS[e.op]} double {args[0]}, {args[1]}")
            lines.append(f"{name} = uitofp i1 {name}c to double")
        elif e.op == "sign":
            for side, test in (("u", "ogt"), ("d", "olt")):
                lines.append(f"{name}{side}c = fcmp {test} double {args[0]}, {literal(0.0)}")
                lines.append(f"{name}{side} = uitofp i1 {name}{side}c to double")
            lines.append(f"{name} = fsub double {name}u, {name}d")
        else:
            intrinsic = _INTRINSICS.get(e.op)
            function = f"llvm.{intrinsic}.f64" if intrinsic else _C_NAMES.get(e.op, e.op)
            self._external[function] = len(args)
            given = ", ".join(f"double {a}" for a in args)
            lines.append(f"{name} = call double @{function}({given})")
        return name


def literal(value: float) -> str:
    """A double, to the last bit, as LLVM writes it."""
    return "0x" + struct.pack(">d", value).hex().upper()


def module(
    recursions: Sequence[Recursion], graph: Graph, layout: Layout, known: Mapping[str, np.ndarray]
) -> str:
    """Assembly of some recursions.

    Args:
        recursions: one function each.
        graph: where the problem's expressions live.
        layout: arrays, in the order of the table of addresses.
        known: see :class:`.recursion.SymbolRows`.
    """
    external: dict[str, int] = {}
    functions = [_function(r, graph, layout, known, external) for r in recursions]
    declared = [
        f"declare double @{name}({', '.join(['double'] * arity)})"
        for name, arity in external.items()
    ]
    return "\n".join([*declared, *functions])


def _function(
    recursion: Recursion,
    graph: Graph,
    layout: Layout,
    known: Mapping[str, np.ndarray],
    external: dict[str, int],
) -> str:
    start, node, end = (Block(layout, p, external) for p in ("start", "node", "end"))
    rows = SymbolRows(graph, layout, known)
    begun, _ = pack(recursion.start(rows))
    initial = [start.value(graph.lift(e)) for e in begun]
    _finish(start, rows)

    symbols = list(graph.inputs(f"{recursion.name}.carried", (len(begun),)))
    rows, (_, unpack) = SymbolRows(graph, layout, known), pack(recursion.start(rows))
    following, _ = pack(recursion.step(rows, unpack(symbols)))
    for i, symbol in enumerate(symbols):
        node.names[symbol.index] = f"%carried{i}"
    after = [node.value(graph.lift(e)) for e in following]
    _finish(node, rows)

    if recursion.end is not None:
        rows = SymbolRows(graph, layout, known)
        recursion.end(rows, unpack(symbols))
        for symbol, name in zip(symbols, after, strict=True):
            end.names[symbol.index] = name
        _finish(end, rows)
    return _text(recursion, layout, (start, node, end), initial, after)


def _finish(block: Block, rows: SymbolRows) -> None:
    """Values first, then stores: what is read is what was there before."""
    values = {place: block.value(e) for place, e in rows.writes.items()}
    for (place, entry), value in values.items():
        block.store(place, entry, value)


def _text(
    recursion: Recursion,
    layout: Layout,
    blocks: tuple[Block, Block, Block],
    initial: list[str],
    after: list[str],
) -> str:
    start, node, end = blocks
    used = {place.removesuffix(SymbolRows.AHEAD) for block in blocks for place in block.rows}
    bases = [
        line
        for i, name in enumerate(layout)
        if name in used
        for line in (
            f"%slot.{name} = getelementptr i64, ptr %table, i64 {i}",
            f"%word.{name} = load i64, ptr %slot.{name}",
            f"%base.{name} = inttoptr i64 %word.{name} to ptr",
        )
    ]
    down = recursion.descending
    phis = [
        f"%carried{i} = phi double [{a}, %start], [{b}, %node]"
        for i, (a, b) in enumerate(zip(initial, after, strict=True))
    ]
    lines = [
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
    return "\n".join(lines)

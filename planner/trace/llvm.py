"""Native code for lists of expressions: straight lines of arithmetic inside a loop over nodes.

One `Kernel` is a C function

    void kernel(int64 count, address of each input ..., address of each output ...)

Every input and output is an array of `count` rows (or one row for all nodes: `shared`). Entries
of an output that are the number zero are not written: hand in arrays filled with zeros.

LLVM (through llvmlite, which numba brings along) is given straight-line code without common
sub-expressions, so there is little left to optimise, and it compiles in milliseconds; nothing is
kept on disk.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import struct
from collections.abc import Sequence

import llvmlite.binding as llvm
import numpy as np

from slipcar.planner.trace.expression import Expression, reachable
from slipcar.planner.trace.vectorized import rows_of

_INTRINSIC = {"sin", "cos", "exp", "log", "sqrt"}
#: NumPy's names where the C library's differ.
_C_NAMES = {
    "arcsin": "asin",
    "arccos": "acos",
    "arctan": "atan",
    "arctan2": "atan2",
    "power": "pow",
}
_OPERATORS = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}


@dataclasses.dataclass(frozen=True)
class Kernel:
    """A compiled function; see the module's docstring.

    Attributes:
        address: where its code is.
        inputs: widths of the rows of each input.
        outputs: widths of the rows of each output.
        shared: names of inputs with one row for all nodes.
    """

    address: int
    inputs: dict[str, int]
    outputs: dict[str, int]
    shared: frozenset[str]
    engine: llvm.ExecutionEngine = dataclasses.field(repr=False)  # owns the code

    def __call__(self, **arrays: np.ndarray) -> dict[str, np.ndarray]:
        """Evaluate from Python: inputs by name, (count, width) each -> outputs by name."""
        rows, count = rows_of(arrays, self.inputs, self.shared)
        out = {name: np.zeros((count, width)) for name, width in self.outputs.items()}
        addresses = [a.ctypes.data for a in (*rows.values(), *out.values())]
        prototype = ctypes.CFUNCTYPE(None, *([ctypes.c_int64] * (1 + len(addresses))))
        prototype(self.address)(count, *addresses)
        return out


def compile_kernel(
    inputs: dict[str, int],
    outputs: dict[str, Sequence[Expression]],
    shared: frozenset[str] = frozenset(),
    ahead: frozenset[str] = frozenset(),
    descending: bool = False,
) -> Kernel:
    """Compile the expressions of some outputs.

    Args:
        inputs: width of each input's rows, in the order of the arguments.
        outputs: entries of one row of each output, in the order of the arguments.
        shared: inputs that have one row for all nodes.
        ahead: arrays of which node k uses row k + 1; with these, an output may be an input of
            the next node, under another name and with the same address.
        descending: go through the nodes from the last to the first.
    """
    text = _module(inputs, outputs, shared, ahead, descending)
    engine = _engine(text)
    return Kernel(
        address=engine.get_function_address("kernel"),
        inputs=dict(inputs),
        outputs={name: len(entries) for name, entries in outputs.items()},
        shared=shared,
        engine=engine,
    )


def _module(
    inputs: dict[str, int],
    outputs: dict[str, Sequence[Expression]],
    shared: frozenset[str],
    ahead: frozenset[str],
    descending: bool,
) -> str:
    """LLVM's assembly text of the function."""
    numbers: dict[int, str] = {}
    body: list[str] = []
    external: dict[str, int] = {}
    wanted = reachable(e for entries in outputs.values() for e in entries if not e.is_zero)
    for e in wanted:
        name = numbers[e.index] = f"%v{e.index}"
        args = [numbers[a.index] for a in e.args]
        if e.op == "constant":
            numbers[e.index] = _literal(e.value)
        elif e.op == "input":
            array, entry = e.value
            body.append(f"{name}p = getelementptr double, ptr %{array}.row, i64 {entry}")
            body.append(f"{name} = load double, ptr {name}p")
        elif e.op in _OPERATORS:
            body.append(f"{name} = {_OPERATORS[e.op]} contract double {', '.join(args)}")
        elif e.op == "neg":
            body.append(f"{name} = fneg double {args[0]}")
        else:
            function = f"llvm.{e.op}.f64" if e.op in _INTRINSIC else _C_NAMES.get(e.op, e.op)
            external[function] = len(args)
            given = ", ".join(f"double {a}" for a in args)
            body.append(f"{name} = call double @{function}({given})")
    for array, entries in outputs.items():
        for i, e in enumerate(entries):
            if not e.is_zero:
                body.append(f"%{array}.at{i} = getelementptr double, ptr %{array}.row, i64 {i}")
                body.append(f"store double {numbers[e.index]}, ptr %{array}.at{i}")
    widths = {**inputs, **{name: len(entries) for name, entries in outputs.items()}}
    rows = []
    for array, width in widths.items():
        rows.append(f"%{array}.base = inttoptr i64 %{array} to ptr")
        offset = "0" if array in shared else f"%{array}.offset"
        if array not in shared:
            rows.append(f"{offset} = mul i64 {'%.after' if array in ahead else '%.at'}, {width}")
        rows.append(f"%{array}.row = getelementptr double, ptr %{array}.base, i64 {offset}")
    declared = [
        f"declare double @{name}({', '.join(['double'] * arity)})"
        for name, arity in external.items()
    ]
    arguments = ", ".join(f"i64 %{name}" for name in ("count", *widths))
    at = "sub i64 %.last, %.k" if descending else "add i64 %.k, 0"
    lines = [
        *declared,
        f"define void @kernel({arguments}) {{",
        "start:",
        "  %.last = sub i64 %count, 1",
        "  %.any = icmp sgt i64 %count, 0",
        "  br i1 %.any, label %node, label %done",
        "node:",
        "  %.k = phi i64 [0, %start], [%.next, %node]",
        f"  %.at = {at}",
        "  %.after = add i64 %.at, 1",
        *(f"  {line}" for line in (*rows, *body)),
        "  %.next = add i64 %.k, 1",
        "  %.more = icmp slt i64 %.next, %count",
        "  br i1 %.more, label %node, label %done",
        "done:",
        "  ret void",
        "}",
    ]
    return "\n".join(lines)


def _literal(value: float) -> str:
    """A double, to the last bit, as LLVM writes it."""
    return "0x" + struct.pack(">d", value).hex().upper()


@functools.lru_cache(maxsize=256)
def _engine(text: str) -> llvm.ExecutionEngine:
    """Compile a module; the same text is compiled once in a process."""
    module = llvm.parse_assembly(text)
    module.verify()
    return _compile(module)


def _compile(module: llvm.ModuleRef) -> llvm.ExecutionEngine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    machine = target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=2
    )
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return engine

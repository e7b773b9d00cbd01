"""Programs and workspaces: the equations of one kind of problem, ready to run on arrays.

A program is machine code (or, without LLVM, the recursions themselves, run by NumPy); a workspace
is the arrays it runs on, for one number of intervals. Points of a workspace come in pairs, the
iterate and the candidate: kernels run on either side, and what is `x` to one is `x_new` to the
other.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import struct
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from slipcar.planner.newton.equations import (
    NEW,
    Equations,
    Evaluation,
    Form,
    Model,
    Promise,
    Residuals,
    layout,
)
from slipcar.planner.newton.quantities import Dimensions, Filled, Traced
from slipcar.planner.trace import emit, machine_code
from slipcar.planner.trace.recursion import Field, Layout, Recursion, in_numpy

Array = np.ndarray
#: Programs kept in a process; each is some hundred kilobytes.
_KEPT = 128
#: Beyond this sum of states, controls and terminal conditions NumPy is used: kernels have no loops
#: over matrices, and grow with the cube.
_LARGEST = 72
#: Kernels of so large a K (n + m)³ take longer than a thread needs to take over, some 50 µs.
_LONG = 150_000


@dataclasses.dataclass(frozen=True, eq=False)
class Program:
    """The equations of one kind of problem.

    Attributes:
        dims: sizes.
        form: which equations.
        layout: arrays.
        recursions: by name.
        code: machine code, or None: NumPy runs the recursions.
        filled: whether NumPy fills the problem's quantities in.
    """

    dims: Dimensions
    form: Form
    layout: Layout
    recursions: Mapping[str, Recursion]
    code: machine_code.Code | None
    filled: Filled | None


def called_with(function: Any, K: int, table: Array) -> Callable[[], None]:
    """A kernel over K intervals on a table of addresses, which must live as long."""
    # ctypes takes its own integers in half the time.
    return functools.partial(function, ctypes.c_int64(K), ctypes.c_int64(table.ctypes.data))


def compilable(dims: Dimensions) -> bool:
    """Whether kernels of such a problem are short enough to be compiled."""
    return dims.n + dims.m + dims.q <= _LARGEST


def brief(dims: Dimensions, K: int) -> bool:
    """Whether kernels over K intervals are over before another thread could use the time."""
    return K * (dims.n + dims.m) ** 3 < _LONG


_programs: OrderedDict[Any, Program] = OrderedDict()
_lock = threading.RLock()


def program_of(problem: Traced | Filled, form: Form, structure: bytes, native: bool) -> Program:
    """The program of a kind of problem, compiled where it is not known.

    Args:
        problem: its quantities.
        form: which equations.
        structure: what tells kinds apart: of the trace, or of the dimensions.
        native: machine code rather than NumPy; the caller knows that there is LLVM.
    """
    filled = problem if isinstance(problem, Filled) else None
    key = (structure, problem.dims, form, native)
    with _lock:
        program = _programs.get(key)
        if program is None:
            program = _programs[key] = _made(problem, filled, form, repr(key).encode(), native)
            while len(_programs) > _KEPT:
                _programs.popitem(last=False)
        else:
            _programs.move_to_end(key)
    return program


def _made(
    problem: Traced | Filled, filled: Filled | None, form: Form, key: bytes, native: bool
) -> Program:
    fields = layout(problem.dims, form, *((filled.own, filled.second) if filled else ({}, {})))
    recursions = {r.name: r for r in Equations(problem, form).recursions}
    code = None
    if native:
        code = machine_code.code(
            key, list(recursions), functools.partial(_assembly, problem, recursions, fields),
            _estimate(problem.dims),
        )  # fmt: skip
    return Program(problem.dims, form, fields, recursions, code, filled)


def _assembly(problem: Any, recursions: Mapping[str, Recursion], fields: Layout) -> str:
    if isinstance(problem, Filled):
        from slipcar.planner.trace.graph import Graph

        return emit.module(list(recursions.values()), Graph(), fields, {})
    n = problem.dims.n
    known = {name: getattr(problem, name) for name in ("A", "B", "C", "G")}
    known["S"] = problem.lagrangian_hessian(problem.graph.inputs("lam", (n,)))[n:, :n]
    return emit.module(list(recursions.values()), problem.graph, fields, known)


def _estimate(dims: Dimensions) -> str:
    """What to say before a compilation that takes longer than a second; empty otherwise."""
    size = dims.n + dims.m + dims.q
    seconds = 1e-5 * size**3
    if seconds < 1.0:
        return ""
    return f"compiling for {dims.n} states and {dims.m} controls, some {seconds:.0f} s (once) ..."


#: What a trajectory is, in the order of `Workspace.trajectories`.
TRAJECTORY = ("x", "u", "nu")


class Probe:
    """A traced problem's functions at a few points, as machine code.

    Args:
        problem: its expressions.
        structure: what tells kinds apart.
        count: points.
    """

    def __init__(self, problem: Traced, structure: bytes, count: int) -> None:
        dims, entries = problem.dims, problem.entries
        self._layout = {
            "t": Field(()), "dt": Field(()), "x": Field((dims.n,)), "u": Field((dims.m,)),
            "number": Field((dims.numbers,), True), "values": Field((len(entries),)),
        }  # fmt: skip

        def step(rows: Any, carried: dict[str, Any]) -> dict[str, Any]:
            rows.write("values", np.array(entries, dtype=object))
            return {}

        recursion = Recursion("probe", step, lambda rows: {})
        key = repr(("probe", structure, dims)).encode()
        assembly = functools.partial(emit.module, [recursion], problem.graph, self._layout, {})
        self._code = machine_code.code(key, ["probe"], assembly)
        self._arrays = {
            name: np.zeros((1 if field.single else count, field.width))
            for name, field in self._layout.items()
        }
        table = [array.ctypes.data for array in self._arrays.values()]
        self._table = np.array(table, dtype=np.int64)
        self._run = called_with(self._code.short["probe"], count, self._table)
        self._lock = threading.Lock()

    def __call__(self, t: Array, dt: float, x: Array, u: Array, number: Array) -> Array:
        """Values at times (count,), states (count, n), controls (count, m): (count, width)."""
        arrays = self._arrays
        with self._lock:
            arrays["t"][:, 0], arrays["dt"][:, 0] = t, dt
            arrays["x"][:], arrays["u"][:], arrays["number"][0] = x, u, number
            self._run()
            return arrays["values"].copy()


class Workspace:
    """Arrays of a program for K intervals, and its kernels on either side.

    Attributes:
        program: what runs.
        K: intervals.
        arrays: by name, (K + 1, width) or (1, width) each.
        trajectories: x, u and ν of either side, one after the other.
        knobs: the numbers of :class:`.equations.Knobs`.
        kernels: each on either side, by name.
        evaluation: reads what `evaluate` said.
        model: reads what `backward` said.
        promise: reads what `forward` said.
        residuals: reads what `residuals` said.
    """

    def __init__(self, program: Program, K: int) -> None:
        self.program, self.K = program, K
        self.arrays = {
            name: np.zeros((1 if field.single else K + 1, field.width))
            for name, field in program.layout.items()
        }
        self.trajectories = (self._together(""), self._together(NEW))
        swapped = [
            {name: self.arrays[_other(name, program.layout) if side else name]
             for name in program.layout}
            for side in (0, 1)
        ]  # fmt: skip
        self._sides = swapped
        self._numbers = {name: array.reshape(-1).data for name, array in self.arrays.items()}
        self._views = [
            {name: array.reshape(len(array), *program.layout[name].shape)
             for name, array in side.items()}
            for side in swapped
        ]  # fmt: skip
        self._tables = [
            np.array([a.ctypes.data for a in side.values()], dtype=np.int64) for side in swapped
        ]
        self.knobs: Any = self.view("knob")
        self.kernels: dict[str, tuple[Callable[[], None], Callable[[], None]]] = {
            name: (self._bound(name, 0), self._bound(name, 1)) for name in program.recursions
        }
        self.evaluation = self._reader("evaluated", Evaluation)
        self.model = self._reader("modelled", Model)
        self.promise = self._reader("promised", Promise)
        self.residuals = self._reader("verified", Residuals)

    def _together(self, suffix: str) -> Array:
        """Put a point's x, u and ν side by side, so that one copy keeps them all."""
        names = [name + suffix for name in TRAJECTORY]
        sizes = [self.arrays[name].size for name in names]
        whole, ends = np.zeros(sum(sizes)), np.cumsum(sizes)
        for name, size, end in zip(names, sizes, ends, strict=True):
            self.arrays[name] = whole[end - size : end].reshape(self.arrays[name].shape)
        return whole

    def view(self, name: str) -> Any:
        """The numbers of an array that has one row."""
        return self._numbers[name]

    def at(self, side: int, name: str) -> Array:
        """What a kernel on that side calls `name`, (K + 1, ...) or (1, ...)."""
        return self._views[side][name]

    def trajectory(self, flat: Array) -> tuple[Array, Array, Array]:
        """States (N, n), controls (K, m) and ν (q,) of a copy of one of the `trajectories`."""
        shapes = [self.arrays[name].shape for name in TRAJECTORY]
        ends = np.cumsum([rows * width for rows, width in shapes])
        x, u, nu = (
            part.reshape(shape)
            for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True)
        )
        return x, u[:-1], nu[0]

    def step_by_step(self, name: str, side: int, before: Callable[[int], None]) -> None:
        """Run a kernel in NumPy, told of every node before its step."""
        program = self.program
        in_numpy(program.recursions[name], program.layout, self._sides[side], self.K, before)

    def _reader(self, name: str, record: Any) -> Callable[[], Any]:
        """A function that reads a row of numbers as a record."""
        buffer, new = self.view(name), tuple.__new__
        unpack = struct.Struct(f"{len(buffer)}d").unpack_from
        return lambda: new(record, unpack(buffer))

    def _bound(self, name: str, side: int) -> Callable[[], None]:
        program = self.program
        if program.code is None:
            recursion = program.recursions[name]
            return functools.partial(in_numpy, recursion, program.layout, self._sides[side], self.K)
        functions = program.code.short if brief(program.dims, self.K) else program.code.long
        return called_with(functions[name], self.K, self._tables[side])


def _other(name: str, fields: Layout) -> str:
    if name.endswith(NEW):
        return name.removesuffix(NEW)
    return name + NEW if name + NEW in fields else name


_spare: dict[Any, list[Workspace]] = {}


def borrow(program: Program, K: int) -> Workspace:
    """A workspace that nobody uses; give it back with :func:`give_back`."""
    with _lock:
        idle = _spare.get((id(program), K))
        if idle:
            return idle.pop()
    return Workspace(program, K)


def give_back(workspace: Workspace) -> None:
    """Keep a workspace for the next one who needs such a one."""
    with _lock:
        idle = _spare.setdefault((id(workspace.program), workspace.K), [])
        if len(idle) < 4:
            idle.append(workspace)
        while len(_spare) > _KEPT:
            _spare.pop(next(iter(_spare)))

"""Paths of a traced problem under a plan's law, as machine code: what Monte Carlo counts.

Equations and meaning are those of :mod:`slipcar.planner.moments.monte_carlo`, which runs where
there is no machine code, path by path the same. A kernel moves a block of paths by one step; noise
comes from NumPy.
"""

from __future__ import annotations

import functools
import math
import threading
from typing import Any, NamedTuple

import numpy as np

from slipcar.planner.moments.bridge import exponent
from slipcar.planner.moments.monte_carlo import BLOCK, Kept, Law, block_generator, block_starts
from slipcar.planner.newton.posing import Posed
from slipcar.planner.newton.program import called_with
from slipcar.planner.newton.quantities import Traced
from slipcar.planner.trace import emit, machine_code
from slipcar.planner.trace.elementwise import choose, larger, magnitude, within
from slipcar.planner.trace.recursion import Carried, Field, Recursion

Array = np.ndarray
Rows = Any
#: Beyond it a state is lost.
_HUGE = 1e300
#: Bridges touch with the exponential of it, or less, by chance: never.
_NEVER = -40.0
_lock = threading.Lock()


class _Kernels:
    """One kind of problem: layout, and functions that move a block of paths."""

    def __init__(self, problem: Traced, tails: int, angles: tuple[int, ...]) -> None:
        self.problem, self.tails, self.angles = problem, tails, angles
        dims = problem.dims
        n, m = dims.n, dims.m
        self.layout = {
            "t": Field((), True), "dt": Field((), True), "number": Field((dims.numbers,), True),
            "mean": Field((n,), True), "nominal": Field((m,), True), "gains": Field((m, n), True),
            "lower": Field((m,), True), "upper": Field((m,), True), "node": Field((), True),
            "x": Field((n,)), "u": Field((m,)), "noise": Field((dims.d,)),
            "exponent": Field((tails,)), "worst": Field((), True),
            "gap": Field((tails,)), "variance": Field((tails,)), "kept": Field((2,)),
        }  # fmt: skip

    @property
    def recursions(self) -> list[Recursion]:
        """`law` answers to states, `look` and `charge` see what was passed, the others go on."""
        steps = {"law": self._law, "chain": self._chain, "charge": self._charge,
                 "kick": self._kick, "glide": self._glide}  # fmt: skip
        looks = {"look": self._look, "drift": self._drift}
        return [
            *(Recursion(name, step, lambda rows: {}) for name, step in steps.items()),
            *(Recursion(name, step, _unharmed, _worst) for name, step in looks.items()),
        ]

    def _law(self, rows: Rows, carried: Carried) -> Carried:
        error = rows["x"] - rows["mean"]
        for i in self.angles:
            turns = error[i] * (0.5 / math.pi) + 0.5
            error[i] = error[i] - 2.0 * math.pi * turns.floor()
        u = rows["nominal"] + rows["gains"].dot(error)
        rows.write("u", within(u, rows["lower"], rows["upper"]))
        return {}

    def _constraints(self) -> Array:
        return self.problem.c[len(self.problem.c) - self.tails :]

    def _whole(self, rows: Rows) -> Any:
        """1 where every constraint and the state's size are kept at x, else 0: also for NaN."""
        kept: Any = magnitude(np.sum(rows["x"])) <= _HUGE
        for h in self._constraints():
            kept = kept * (h <= 0.0)
        return kept

    def _chain(self, rows: Rows, carried: Carried) -> Carried:
        """Look at a node and go on to the next."""
        kept = rows["kept"]
        seen = choose(rows["node"], kept[1] * self._whole(rows), kept[1])
        rows.write("kept", np.array([kept[0], seen], dtype=object))
        p, dt = self.problem, rows["dt"]
        rows.write("x", p.next + p.sigma.dot(np.sqrt(dt) * rows["noise"]))
        return {}

    def _look(self, rows: Rows, carried: Carried) -> Carried:
        """The bridge that ends at x, to be charged if one of a block comes near a border."""
        kept, here, gap = rows["kept"], self._whole(rows), -self._constraints()
        powers, worst = exponent(rows["gap"], gap, rows["variance"]), carried["worst"]
        rows.write("gap", gap)
        rows.write("exponent", powers)
        seen = choose(rows["node"], kept[1] * here, kept[1])
        rows.write("kept", np.array([kept[0] * here, seen], dtype=object))
        for power in powers:
            worst = larger(power, worst)
        return {"worst": worst}

    def _charge(self, rows: Rows, carried: Carried) -> Carried:
        """What bridges leave."""
        kept = rows["kept"]
        clear = kept[0]
        for q in np.exp(rows["exponent"]):
            clear = clear * (1.0 - q)
        rows.write("kept", np.array([clear, kept[1]], dtype=object))
        return {}

    def _drift(self, rows: Rows, carried: Carried) -> Carried:
        """Look, and begin the next substep: half of its drift."""
        worst = self._look(rows, carried)
        rows.write("x", self.problem.next)
        return worst

    def _kick(self, rows: Rows, carried: Carried) -> Carried:
        """The noise of a substep, twice dt long, at its middle."""
        p, h = self.problem, 2.0 * rows["dt"]
        pushed = [row.dot(p.sigma) for row in p.C[len(p.c) - self.tails :]]
        rows.write("variance", np.array([h * push.dot(push) for push in pushed], dtype=object))
        rows.write("x", rows["x"] + p.sigma.dot(np.sqrt(h) * rows["noise"]))
        return {}

    def _glide(self, rows: Rows, carried: Carried) -> Carried:
        """The other half of its drift."""
        rows.write("x", self.problem.next)
        return {}

    def code(self, structure: bytes) -> machine_code.Code:
        """Machine code."""
        recursions = self.recursions
        key = repr(("paths", structure, self.problem.dims, self.tails, self.angles)).encode()
        assembly = functools.partial(emit.module, recursions, self.problem.graph, self.layout, {})
        return machine_code.code(key, [r.name for r in recursions], assembly)


def _unharmed(rows: Rows) -> Carried:
    return {"worst": -_HUGE}


def _worst(rows: Rows, carried: Carried) -> None:
    rows.write("worst", carried["worst"])


class _Block(NamedTuple):
    """Arrays of a block of paths, and kernels bound to them."""

    arrays: dict[str, Array]
    run: dict[str, Any]
    table: Array


def _block(kernels: _Kernels, code: machine_code.Code) -> _Block:
    arrays = {
        name: np.zeros((1 if field.single else BLOCK, field.width))
        for name, field in kernels.layout.items()
    }
    table = np.array([array.ctypes.data for array in arrays.values()], dtype=np.int64)
    run = {name: called_with(function, BLOCK, table) for name, function in code.long.items()}
    return _Block(arrays, run, table)


class CompiledPaths:
    """Paths of a problem whose constraints are its last rows; see :class:`Kept`.

    Args:
        posed: traced, with machine code.
        law: what drives.
    """

    def __init__(self, posed: Posed, law: Law) -> None:
        assert isinstance(posed.problem, Traced)
        self._model, self._law, problem = posed.model, law, posed.problem
        angles = tuple(int(i) for i in getattr(posed.model.problem, "angles", ()))
        key = ("paths", angles)
        with _lock:
            if key not in problem.programs:
                kernels = _Kernels(problem, posed.tails, angles)
                problem.programs[key] = (kernels, kernels.code(posed.structure))
            # Its code must live as long as the functions that are taken from it.
            self._program = problem.programs[key]
        self._blocks = [_block(*self._program) for _ in range(2)]
        for block in self._blocks:
            block.arrays["number"][0] = posed.numbers

    def chain(self, seed: int, block: int) -> Array:
        """Paths of one block that keep the constraints at every node, (BLOCK,) of 0 and 1."""
        model, (arrays, run, _) = self._model, self._blocks[0]
        rng = block_generator(seed, block)
        self._begin(arrays, block_starts(model, seed, block))
        for k, dt in enumerate(model.dt):
            arrays["t"][:], arrays["dt"][:], arrays["node"][:] = model.times[k], dt, float(k > 0)
            self._lead(arrays, k)
            run["law"]()
            rng.standard_normal(out=arrays["noise"])
            run["chain"]()
        arrays["t"][:], arrays["node"][:] = model.times[-1], 1.0
        run["look"]()
        return arrays["kept"][:, 1].copy()

    def path(self, seed: int, block: int, substeps: int, halved: bool) -> list[Kept]:
        """What a block keeps at every instant, in `substeps`; `halved` in half as many too.

        Both see the same Brownian motion; the finer comes first.
        """
        model, blocks = self._model, self._blocks[: 1 + halved]
        rng = block_generator(seed, block)
        for arrays, _, _ in blocks:
            self._begin(arrays, block_starts(model, seed, block))
        first, noise = blocks[0], blocks[0].arrays["noise"]
        for k, dt in enumerate(model.dt):
            for arrays, run, _ in blocks:
                self._lead(arrays, k)
                run["law"]()
            for j in range(substeps):
                h = dt / substeps
                rng.standard_normal(out=noise)
                if halved:
                    coarse = blocks[1].arrays["noise"]
                    coarse[:] = noise if j % 2 == 0 else (coarse + noise) * math.sqrt(0.5)
                self._substep(first, model.times[k] + j * h, h, float(k > 0 and j == 0))
                if halved and j % 2:
                    begun = model.times[k] + (j - 1) * h
                    self._substep(blocks[1], begun, 2.0 * h, float(k > 0 and j == 1))
        for arrays, run, _ in blocks:
            arrays["t"][:], arrays["node"][:] = model.times[-1], 1.0
            run["look"]()
            run["charge"]()
        return [Kept(*arrays["kept"].T.copy()) for arrays, _, _ in blocks]

    @staticmethod
    def _substep(block: _Block, t: float, h: float, node: float) -> None:
        arrays, run = block.arrays, block.run
        arrays["t"][:], arrays["dt"][:], arrays["node"][:] = t, 0.5 * h, node
        run["drift"]()
        if arrays["worst"][0, 0] > _NEVER:
            run["charge"]()
        arrays["t"][:] = t + 0.5 * h
        run["kick"]()
        run["glide"]()

    def _begin(self, arrays: dict[str, Array], x: Array) -> None:
        arrays["x"][:], arrays["kept"][:] = x, 1.0
        # Nothing is charged for what lies before the start, unless it is broken there.
        arrays["gap"][:], arrays["variance"][:] = 1.0, 0.0

    def _lead(self, arrays: dict[str, Array], k: int) -> None:
        law, model = self._law, self._model
        arrays["mean"][0], arrays["nominal"][0] = law.x[k], law.u[k]
        arrays["gains"][0] = law.gains[k].ravel()
        arrays["lower"][0], arrays["upper"][0] = model.lower, model.upper


def compiles(posed: Posed) -> bool:
    """Whether paths of a posed problem can be machine code."""
    return posed.native and isinstance(posed.problem, Traced)

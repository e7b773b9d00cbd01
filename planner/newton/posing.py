"""From a model to what the kernels run on: traced, its structure the key, its numbers parameters.

A problem is traced anew in every call, which costs less than a millisecond: what is planned for is
what its functions are now. Where it names its numbers, `parameters()` and `with_parameters()`, one
trace serves every problem of the kind; that this one is of the kind is tried at a few points each
time. A problem that cannot be traced is filled in by NumPy (:mod:`.filling`).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from slipcar.planner.moments.losses import deviations
from slipcar.planner.newton.equations import Form
from slipcar.planner.newton.filling import ModelFiller, TracedFiller
from slipcar.planner.newton.loop import Filler
from slipcar.planner.newton.program import Probe, Program, brief, compilable, program_of
from slipcar.planner.newton.quantities import Dimensions, Filled, Traced
from slipcar.planner.problem import checks
from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.model import Model
from slipcar.planner.trace import machine_code
from slipcar.planner.trace.arrays import TracedArray
from slipcar.planner.trace.errors import OpaqueError, TraceError
from slipcar.planner.trace.graph import Expression, Graph, jacobian
from slipcar.planner.trace.tracing import trace_call

Array = np.ndarray

#: Points at which a trace is held against the problem's functions, and how near it must come: to
#: each value, and to rounding of the largest.
_PROBES, _AGREEMENT, _ROUNDING = 2, 1e-9, 2e-15
#: Traces kept for a kind of problem that names its numbers.
_TRACES = 4


@dataclasses.dataclass(frozen=True, eq=False)
class Posed:
    """A model on its way to the kernels.

    Attributes:
        model: the problem.
        problem: its quantities at a node.
        structure: what tells kinds of problems apart.
        numbers: constants of the traced functions.
        tails: rows that are constraints, the last ones.
        native: machine code rather than NumPy.
        reason: why it could not be traced; empty if it could.
    """

    model: Model
    problem: Traced | Filled
    structure: bytes
    numbers: Array
    tails: int
    native: bool
    reason: str = ""

    def of(self, model: Model | None, **changes: Any) -> Posed:
        """The same for a model that differs in numbers only."""
        copy = object.__new__(Posed)
        vars(copy).update(vars(self), model=model, **changes)
        vars(copy).pop("filler", None)
        return copy

    @property
    def brief(self) -> bool:
        """Whether its kernels take no longer than threads need to take turns."""
        return self.native and not self.reason and brief(self.problem.dims, len(self.model.dt))

    def program(self, form: Form) -> Program:
        """The kernels of a form of the equations."""
        if not isinstance(self.problem, Traced):
            return program_of(self.problem, form, self.structure, self.native)
        known, key = self.problem.programs, (form, self.native)
        program = known.get(key)
        if program is None:
            problem = self.problem if self.native else self.problem.filled
            program = known[key] = program_of(problem, form, self.structure, self.native)
        return program

    @functools.cached_property
    def filler(self) -> Filler | None:
        """What fills in the quantities that the kernels do not compute; None if they do."""
        if not isinstance(self.problem, Traced):
            return ModelFiller(self.model, self.tails)
        if self.native:
            return None
        known = self.problem.programs
        if "filler" not in known:
            known["filler"] = TracedFiller(self.problem)
        return known["filler"]

    def row_moments(self, x: Array, S: Array) -> tuple[Array, Array]:
        """Expectations and deviations of all rows at nodes 1..K.

        Args:
            x: means, (N, n).
            S: Σ, (N, n, n).

        Returns:
            c̄ = c(μ) + ½ tr(∂²c Σ) and s = (C Σ Cᵀ)^½, at least a part of the row's largest,
            (K, p) each.
        """
        t, x = self.model.times[1:], x[1:]
        if isinstance(self.problem, Traced):
            c, C, bend = self.problem.rows(t, x, self.numbers)
        else:
            c, C, bend = ModelFiller(self.model, self.tails).rows(t, x)
        return c + 0.5 * np.einsum("kpij,kij->kp", bend, S[1:]), deviations(C, S[1:])


def pose(model: Model, *, constraints: bool = False, compiled: bool | None = None) -> Posed:
    """Trace a model's problem, or find out that it has to be filled in.

    Args:
        model: the problem.
        constraints: whether its constraints are rows, after its penalties.
        compiled: False runs without machine code; True insists on it.

    Raises:
        ImportError: if machine code is asked for and llvmlite is missing.
        ValueError: if a function is written so that it can neither be traced nor differentiated; or
            cannot be traced and machine code is asked for.
    """
    native = compiled is not False and machine_code.available()
    if compiled and not native:
        raise ImportError("compiled=True needs llvmlite: pip install llvmlite")
    if compiled is None and not native:
        machine_code.tell_once("llvmlite is missing: plans take some hundred times longer")
    try:
        traced = _trace_of(model, constraints, native)
        if traced is None:
            model.jacobians.distrust(_OTHER_VALUES)
            raise OpaqueError(_OTHER_VALUES)
    except TraceError as error:
        if compiled:
            raise ValueError(
                f"compiled=True, but the functions of {type(model.problem).__name__} cannot be "
                f"compiled: {error}"
            ) from error
        return _untraced(model, constraints, native, str(error))
    tails = traced.problem.dims.p - len(model.weight)
    native = native and compilable(traced.problem.dims)
    return traced.of(model, tails=tails, native=native)


# ------------------------------------------------------------------------------------ tracing


#: Traces of kinds of problems that name their numbers, the latest first.
_kinds: dict[Any, tuple[Posed, ...]] = {}

#: Said of functions that depend on more than their arguments, or on their arguments' types.
_OTHER_VALUES = "traced, they give other values than called (do they depend on anything else?)"


def _trace_of(model: Model, constraints: bool, native: bool) -> Posed | None:
    """A trace that says what the problem's functions say now, known or new; None if none does."""
    named = _parameters(model.problem)
    posed = None if named is None else _named_trace(model, constraints, native, named)
    if posed is None:
        # None are named, or not all, or another's: a problem wrapped round one.
        posed = _traced(model, constraints, {})
        if not _agrees(posed, constraints, native):
            return None
    return posed


def _named_trace(
    model: Model, constraints: bool, native: bool, named: dict[str, Array]
) -> Posed | None:
    """A trace with the numbers that a problem names as parameters, if it agrees with it."""
    kind = (
        getattr(model.problem, "_kind", type(model.problem)), model.integrator, constraints,
        tuple((name, value.shape) for name, value in named.items()), len(model.weight),
        model.state_dim, model.control_dim,
    )  # fmt: skip
    known = _kinds.get(kind, ())
    own = [value.ravel() for value in named.values()]
    count = sum(len(value) for value in own)
    for posed in known:
        numbers = np.concatenate([*own, posed.numbers[count:]])
        candidate = posed.of(model, numbers=numbers)
        if _agrees(candidate, constraints, native):
            if posed is not known[0]:
                _remember(kind, posed)
            return candidate
    try:
        posed = _traced(model, constraints, named)
    except (TraceError, AttributeError):
        return None
    if not _agrees(posed, constraints, native):
        return None
    _remember(kind, posed.of(None))  # without its model, lest the problem live for ever
    return posed


def _remember(kind: Any, posed: Posed) -> None:
    """Put a trace first of its kind's; others may be reading the old ones."""
    others = (other for other in _kinds.get(kind, ()) if other is not posed)
    _kinds[kind] = (posed, *others)[:_TRACES]


def _parameters(problem: Any) -> dict[str, Array] | None:
    """The numbers a problem names, as float64 arrays; None if it names none."""
    if not hasattr(problem, "parameters") or not hasattr(problem, "with_parameters"):
        return None
    return {name: np.asarray(v, dtype=np.float64) for name, v in problem.parameters().items()}


def _traced(model: Model, constraints: bool, named: dict[str, Array]) -> Posed:
    """Trace a problem's functions, the numbers it names as symbols.

    Raises:
        TraceError: if they do something that a trace cannot record.
    """
    graph, n, m = Graph(), model.state_dim, model.control_dim
    problem: Any = model.problem
    if named:
        problem = problem.with_parameters(_symbols(graph, named))
    t, dt = graph.inputs("t", (1,)), graph.inputs("dt", (1,))
    x, u = graph.inputs("x", (1, n)), graph.inputs("u", (1, m))

    def drift(t: Array, x: Array, u: Array) -> Array:
        return trace_call("drift", problem.drift, t, x, u).view(np.ndarray)

    def state(name: str) -> Array:
        return np.asarray(trace_call(name, getattr(problem, name), t, x))[0]

    rows = [state(name) for name in ("penalty", "constraint") if _wanted(model, name, constraints)]
    ell = state("control_cost") if model.has("control_cost") else np.full(m, graph.constant(0.0))
    H = np.asarray(state("state_cost")) if model.has("state_cost") else None
    b = drift(t, x, u)
    with_step = change(model.integrator, drift, t, dt, x, u)
    traced = Traced(
        graph=graph, x=x[0], u=u[0], dt=dt[0], next=(x + with_step)[0], sigma=state("diffusion"),
        c=np.concatenate(rows) if rows else np.empty(0, dtype=object),
        g=np.asarray(trace_call("terminal", problem.terminal, x))[0],
        H=graph.constant(0.0) if H is None else H.item(), ell=ell, state_cost=H is not None,
        numbers=np.array(graph.numbers or [0.0]),
    )  # fmt: skip
    outputs = (traced.next, traced.sigma, traced.c, traced.g, ell, np.array([traced.H]), b[0])
    structure = graph.structure(*(array.ravel() for array in outputs))
    known = _structures.get(structure)
    if known is None:
        known = _structures[structure] = (traced, _facts(traced, b[0]))
        while len(_structures) > 256:
            _structures.pop(next(iter(_structures)))
    return Posed(model, known[0], structure, traced.numbers, 0, native=True)


#: Traces by structure, with what their structure says of the method's assumptions.
_structures: dict[bytes, tuple[Traced, checks.Facts]] = {}


def _wanted(model: Model, name: str, constraints: bool) -> bool:
    return model.has(name) and (name == "penalty" or constraints)


def _symbols(graph: Graph, named: dict[str, Array]) -> dict[str, Array]:
    """The named numbers as the first entries of the input "number"."""

    def symbol(value: float) -> Expression:
        graph.numbers.append(value)
        return graph.make("input", (), ("number", len(graph.numbers) - 1))

    symbols: dict[str, Array] = {}
    for name, value in named.items():
        flat = np.empty(value.size, dtype=object)
        flat[:] = [symbol(float(v)) for v in value.ravel()]
        symbols[name] = flat.reshape(value.shape).view(TracedArray)
        symbols[name].setflags(write=False)
    return symbols


def check_assumptions(posed: Posed, x: Array, u: Array, *, charged: bool) -> None:
    """What the method assumes of a problem, looked at near a guess x (N, n), u (K, m).

    At points the first time that a structure is met; then by the structure, where that is enough.

    Raises:
        ValueError: naming the function, the entry and what is assumed of it.
    """
    known = _structures.get(posed.structure)
    if known is None:
        checks.check(posed.model, x, u, None, charged=charged)
        return
    # The same lines of code, whatever numbers they read.
    functions = [getattr(posed.model.problem, name, None) for name in _FUNCTIONS]
    lines = [getattr(function, "__code__", type(function)) for function in functions]
    kind = (posed.structure, *lines)
    if kind not in _checked:
        checks.check(posed.model, x, u, None, charged=charged)
        checks.check_given(posed.model, x, u)
        _checked.add(kind)
        return
    checks.check(posed.model, x, u, known[1], charged=charged)


#: Structures, with the code they come from, whose functions were looked at.
_checked: set[tuple[Any, ...]] = set()
_FUNCTIONS = (
    "drift", "diffusion", "penalty", "terminal", "state_cost", "control_cost", "drift_jacobian",
    "diffusion_jacobian", "penalty_jacobian", "terminal_jacobian", "state_cost_derivatives",
    "control_cost_jacobian",
)  # fmt: skip


def _facts(traced: Traced, b: Array) -> checks.Facts:
    """Which entries can depend on which: of the drift b (n,), the diffusion, and on controls."""
    B, A = jacobian(b, traced.u), jacobian(b, traced.x)
    bent = jacobian(B, traced.u)
    nonzero = np.frompyfunc(lambda e: not e.is_zero, 1, 1)
    return checks.Facts(
        affine=not nonzero(bent).any(),
        depends=nonzero(A).astype(bool),
        noisy=nonzero(traced.sigma).astype(bool).any(axis=1),
        sigma_depends=nonzero(traced.d_sigma).astype(bool).any(axis=(0, 1)),
    )


def _agrees(posed: Posed, constraints: bool, native: bool) -> bool:
    """Whether a known trace says what the problem's functions say, at a few points."""
    model, problem = posed.model, posed.problem
    assert isinstance(problem, Traced)
    t, x, u = _probe_points(model)
    try:
        given = _called(model, constraints, t, x, u)
    except (ValueError, TypeError, IndexError):
        return False
    if given.shape[1] != len(problem.entries):
        return False
    dt = float(model.dt[0])
    if native:
        known = problem.programs
        if "probe" not in known:
            known["probe"] = Probe(problem, posed.structure, _PROBES)
        if _near(known["probe"](t, dt, x, u, posed.numbers), given):
            return True
    # As NumPy rounds, where machine code rounds otherwise.
    return _near(problem.values(t, dt, x, u, posed.numbers), given)


def _near(traced: Array, given: Array) -> bool:
    """Whether values are equal but for rounding; where neither is finite, they are."""
    given = given.ravel()
    off = traced.ravel() - given
    # No entry is further off than rounding of the root mean square, itself below the largest.
    if off.dot(off) * off.size <= _ROUNDING * _ROUNDING * given.dot(given):
        return True
    finite = np.isfinite(given)
    if not finite.any() or not np.array_equal(finite, np.isfinite(traced).ravel()):
        return False
    size = np.abs(given[finite])
    return bool((np.abs(off[finite]) <= _AGREEMENT * size + _ROUNDING * size.max()).all())


@functools.lru_cache(maxsize=64)
def _noise(n: int, m: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(0)
    return 0.1 * rng.normal(size=(_PROBES, n)), rng.normal(size=(_PROBES, m))


def _probe_points(model: Model) -> tuple[Array, Array, Array]:
    """Times, states and controls round the start; random, as a guess at rest would see no drag."""
    noise = _noise(model.state_dim, model.control_dim)
    x = model.start + (1.0 + abs(model.start)) * noise[0]
    return model.times[:_PROBES], x, noise[1]


def _called(model: Model, constraints: bool, t: Array, x: Array, u: Array) -> Array:
    """The problem's functions at some points, in the order of `Traced.entries`."""
    problem: Any = model.problem
    moved = change(model.integrator, problem.drift, t, model.dt[0], x, u)
    values = [x + moved, problem.diffusion(t, x)]
    values.append(problem.control_cost(t, x) if model.has("control_cost") else np.zeros(u.shape))
    for name in ("penalty", "constraint"):
        if _wanted(model, name, constraints):
            values.append(getattr(problem, name)(t, x))
    values.append(problem.state_cost(t, x) if model.has("state_cost") else np.zeros(t.shape))
    values.append(problem.terminal(x))
    rows = [np.asarray(value, np.float64).reshape(len(t), -1) for value in values]
    return np.concatenate(rows, axis=1)


# --------------------------------------------------------------------------------- not traced


def _untraced(model: Model, constraints: bool, native: bool, reason: str) -> Posed:
    """A problem whose functions are called, if it can be differentiated at all."""
    names = ["drift", "diffusion", "terminal"]
    names += [n for n in ("penalty", "constraint") if _wanted(model, n, constraints)]
    names += [n for n in ("state_cost", "control_cost") if model.has(n)]
    for name in names:
        model.jacobians.check_given(name)
    t, x = model.times[:1], model.start[None]
    d = np.shape(model.diffusion(t, x))[-1]
    q = np.shape(model.terminal(x))[-1]
    tails = 0
    if constraints and model.has("constraint"):
        tails = np.shape(model.problem.constraint(t, x))[-1]  # type: ignore[attr-defined]
    dims = Dimensions(model.state_dim, model.control_dim, d, len(model.weight) + tails, q)
    state_cost = model.has("state_cost")
    structure = repr(("filled", dims, state_cost)).encode()
    native = native and compilable(dims)
    return Posed(model, Filled(dims, state_cost), structure, np.zeros(1), tails, native, reason)

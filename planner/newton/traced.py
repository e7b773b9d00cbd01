"""A problem's functions compiled: what one iteration of the planner asks of a model, as kernels.

The functions are traced as they are, so the physics stays where it is written. Everything else
follows by differentiation: A and B of a step of the integrator, ∂σ/∂x, the Jacobians of
penalties and terminal condition, and the Hessians that Newton's method needs.

A problem may name its numbers, `parameters() -> {name: array}`, and pose itself with others,
`with_parameters({name: array}) -> problem`. Then all problems of a kind share one compiled
code; otherwise each problem object is compiled by itself (some 30 ms).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.model import Model
from slipcar.planner.trace.expression import Expression, Graph, TraceError, derivative, jacobian
from slipcar.planner.trace.vectorized import vectorize_kernel

Array = np.ndarray
Kernel = Any  # llvm.Kernel or vectorized.VectorizedKernel: the same interface
_lift = np.frompyfunc(lambda graph, value: graph.lift(value), 2, 1)


@dataclasses.dataclass(frozen=True)
class Kernels:
    """Compiled functions of a kind of problem; `parameters` is one row for all nodes.

    Attributes:
        stage: t, dt, x, u -> next (n), A (n n), B (n m), sigma (n d), d_sigma (n d n),
            ell (m), d_ell (m n).
        node: t, x -> c (p), C (p n), H (1), H_x (n), H_xx (n n).
        terminal: x -> g (q), G (q n).
        stage_hessian: t, dt, x, u, adjoint (n) -> xx (n n), ux (m n), uu (m m) of
            adjointᵀnext + dt ℓᵀu.
        node_hessian: t, x, weight (p) -> xx (n n) of weightᵀc.
        terminal_hessian: x, multiplier (q) -> xx (n n) of multiplierᵀg.
        recursion: the Riccati recursion of such problems (:mod:`.recursion`), None if they are
            too large for it or not compiled to machine code.
    """

    stage: Kernel
    node: Kernel
    terminal: Kernel
    stage_hessian: Kernel
    node_hessian: Kernel
    terminal_hessian: Kernel
    recursion: Any = None

    @functools.cached_property
    def addresses(self) -> Array:
        """Of the six functions, in the order above, and of the recursion's two (or 0), (8,)."""
        six = (
            self.stage,
            self.node,
            self.terminal,
            self.stage_hessian,
            self.node_hessian,
            self.terminal_hessian,
        )
        two = (0, 0)
        if self.recursion is not None:
            two = (self.recursion.backward.address, self.recursion.forward.address)
        return np.array([*(kernel.address for kernel in six), *two])


def parameters_of(problem: Any) -> dict[str, Array]:
    """The numbers a problem names, as float64 arrays; empty if it names none."""
    named = getattr(problem, "parameters", None)
    if named is None or not hasattr(problem, "with_parameters"):
        return {}
    return {name: np.asarray(value, dtype=np.float64) for name, value in named().items()}


def parameter_row(problem: Any) -> Array:
    """All named numbers in one row; one zero if there are none."""
    flat = [value.ravel() for value in parameters_of(problem).values()]
    return np.concatenate(flat) if flat else np.zeros(1)


def kind_of(model: Model) -> tuple[Any, ...] | None:
    """What problems must agree in to share kernels; None if this one names no parameters."""
    parameters = parameters_of(model.problem)
    if not parameters:
        return None
    shapes = tuple((name, value.shape) for name, value in parameters.items())
    # Bound and free functions alike are found again on the traced copy: the class decides.
    posed = getattr(model.problem, "_problem", model.problem)  # of a `Reposed` one
    kind = getattr(posed, "_kind", type(posed))  # of a guarded problem
    return (kind, model.integrator, model.state_dim, model.control_dim, shapes)


def trace(model: Model, *, native: bool) -> Kernels:
    """Trace, differentiate and compile a problem's functions.

    Args:
        model: the problem.
        native: to machine code, which needs llvmlite; otherwise to NumPy code.

    Raises:
        TraceError: if they do something a trace cannot record; what, in its message.
    """
    try:
        return _trace(model, native)
    except TraceError:
        raise
    except Exception as error:  # NumPy's ufuncs and the user's code raise their own
        raise TraceError(f"tracing failed: {error}") from error


def _trace(model: Model, native: bool) -> Kernels:
    make = _native() if native else vectorize_kernel
    n, m, p = model.state_dim, model.control_dim, len(model.weight)
    graph = Graph()
    problem: Any = model.problem
    parameters = parameters_of(problem)
    symbols, used = {}, 0
    row = graph.inputs("parameters", (max(1, sum(v.size for v in parameters.values())),))
    row.setflags(write=False)  # code that writes in its arguments would change what they mean
    for name, value in parameters.items():
        symbols[name] = row[used : used + value.size].reshape(value.shape)
        used += value.size
    if symbols:
        problem = problem.with_parameters(symbols)
    t, dt = graph.inputs("t", (1,)), graph.inputs("dt", (1,))
    x, u = graph.inputs("x", (1, n)), graph.inputs("u", (1, m))
    for argument in (t, dt, x, u):
        argument.setflags(write=False)
    zero = graph.constant(0.0)
    lift = functools.partial(_lift, graph)

    def array(value: Any) -> Array:
        """The result for the one node of the trace, all entries expressions."""
        return np.asarray(lift(np.asarray(value, dtype=object)[0]), dtype=object)

    following = array(x + change(model.integrator, problem.drift, t, dt, x, u))
    sigma = array(problem.diffusion(t, x))
    c = np.empty(0, dtype=object) if p == 0 else array(problem.penalty(t, x))
    g = array(problem.terminal(x))
    H: Any = zero
    ell = np.full(m, zero)
    if model.state_cost is not None:
        H = array(problem.state_cost(t, x))[()]
    if model.control_cost is not None:
        ell = array(problem.control_cost(t, x))
    one_x, one_u = x[0], u[0]
    H_x = jacobian(np.array([H], dtype=object), one_x)[0]

    common = {"parameters": len(row)}
    shared = frozenset(common)
    at_stage = {"t": 1, "dt": 1, "x": n, "u": m}

    def kernel(inputs: dict[str, int], **outputs: Any) -> Kernel:
        rows: dict[str, Sequence[Expression]] = {
            name: list(np.ravel(value)) for name, value in outputs.items()
        }
        return make({**inputs, **common}, rows, shared)

    adjoint = graph.inputs("adjoint", (n,))
    lagrangian = _dot(adjoint, following, zero) + dt[0] * _dot(ell, one_u, zero)
    xx, ux, uu = _hessian(lagrangian, one_x, one_u)
    weight = graph.inputs("weight", (p,))
    multiplier = graph.inputs("multiplier", (len(g),))
    A, B = jacobian(following, one_x), jacobian(following, one_u)
    return Kernels(
        stage=kernel(
            at_stage,
            next=following,
            A=A,
            B=B,
            sigma=sigma,
            d_sigma=jacobian(sigma, one_x),
            ell=ell,
            d_ell=jacobian(ell, one_x),
        ),
        node=kernel(
            {"t": 1, "x": n},
            c=c,
            C=jacobian(c, one_x),
            H=H,
            H_x=H_x,
            H_xx=jacobian(H_x, one_x),
        ),
        terminal=kernel({"x": n}, g=g, G=jacobian(g, one_x)),
        stage_hessian=kernel({**at_stage, "adjoint": n}, xx=xx, ux=ux, uu=uu),
        node_hessian=kernel(
            {"t": 1, "x": n, "weight": p}, xx=_hessian(_dot(weight, c, zero), one_x, one_u)[0]
        ),
        terminal_hessian=kernel(
            {"x": n, "multiplier": len(g)},
            xx=_hessian(_dot(multiplier, g, zero), one_x, one_u)[0],
        ),
        recursion=_recursion(A, B, len(g)) if native else None,
    )


def _native() -> Any:
    from slipcar.planner.trace.llvm import compile_kernel

    return compile_kernel


def _recursion(A: Array, B: Array, t: int) -> Any:
    from slipcar.planner.newton.recursion import generate

    return generate(A, B, t)


def _dot(a: Array, b: Array, zero: Expression) -> Expression:
    return sum((x * y for x, y in zip(a, b, strict=True)), start=zero)


def _hessian(f: Expression, x: Array, u: Array) -> tuple[Array, Array, Array]:
    """Second derivatives of a scalar: xx (n, n), ux (m, n), uu (m, m)."""
    everything = np.concatenate([x, u])
    gradient = np.array([derivative([f], v)[0] for v in everything], dtype=object)
    full = jacobian(gradient, everything)
    n = len(x)
    return full[:n, :n], full[n:, :n], full[n:, n:]

"""What the iteration asks of a problem: six functions, traced where that is possible.

Where a problem cannot be traced (its code branches on values, calls foreign libraries, ...) the
same six are put together from the model's own functions, with Hessians by central differences
of its Jacobians; see :mod:`slipcar.planner.newton.traced` for what they return.
"""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.newton.traced import Kernels, kind_of, parameter_row, trace
from slipcar.planner.problem.integrators import change, jacobian
from slipcar.planner.problem.model import Model
from slipcar.planner.problem.recent import Recent
from slipcar.planner.trace.expression import TraceError

Array = np.ndarray
Rows = dict[str, Array]

#: Traced and model's own values must agree to this, relative to their size.
_AGREEMENT = 1e-8
#: The cube root of the machine epsilon balances truncation and rounding of central differences.
_STEP = 6e-6


@dataclasses.dataclass(frozen=True)
class Functions:
    """The six functions of a problem, parameters bound; see `codegen.traced.Kernels`.

    Attributes:
        kernels: what they are bound from; None if they are put together from the model's own.
        parameters: in one row.
        reason: why the problem could not be traced; empty if it could.
    """

    stage: Callable[..., Rows]
    node: Callable[..., Rows]
    terminal: Callable[..., Rows]
    stage_hessian: Callable[..., Rows]
    node_hessian: Callable[..., Rows]
    terminal_hessian: Callable[..., Rows]
    kernels: Kernels | None
    parameters: Array
    reason: str = ""


#: Kernels by kind of problem, or by the object where it names no parameters; why not, where
#: it cannot be traced. And what was found for immutable problems, comparison included.
_KINDS: dict[Any, Kernels | str] = {}
_OBJECTS: weakref.WeakKeyDictionary[Any, dict[Any, Kernels | str]] = weakref.WeakKeyDictionary()
_FOUND = Recent()


def functions_of(model: Model, x: Array, u: Array, *, native: bool) -> Functions:
    """The six functions of a problem.

    Traced ones are compared with the model's own near x (N, n), u (K, m), every time unless the
    problem is immutable: it might have changed, and a trace can miss what it cannot see.

    Args:
        model: the problem.
        x: states near which to compare.
        u: controls.
        native: traced to machine code rather than to NumPy code.
    """
    key = (native, model.integrator)
    kept = _FOUND.get(model.problem) or {}
    if key not in kept:
        kept[key] = _find(model, x, u, native)
        _FOUND.keep(model.problem, kept)
    return kept[key]


def _find(model: Model, x: Array, u: Array, native: bool) -> Functions:
    parameters = parameter_row(model.problem)
    for fresh in (False, True):
        kernels = _kernels(model, native, fresh)
        if isinstance(kernels, str):
            return dataclasses.replace(_from_model(model), reason=kernels)
        if _agree(model, kernels, parameters, x, u):
            return _bound(kernels, parameters)
    say = "traced, they give other values than called (do they depend on anything else?)"
    return dataclasses.replace(_from_model(model), reason=say)


def _bound(kernels: Kernels, parameters: Array) -> Functions:
    def bound(kernel: Any) -> Callable[..., Rows]:
        call = getattr(kernel, "unchecked", kernel)
        row = parameters[None]
        return lambda **arrays: call(**arrays, parameters=row)

    return Functions(
        stage=bound(kernels.stage),
        node=bound(kernels.node),
        terminal=bound(kernels.terminal),
        stage_hessian=bound(kernels.stage_hessian),
        node_hessian=bound(kernels.node_hessian),
        terminal_hessian=bound(kernels.terminal_hessian),
        kernels=kernels,
        parameters=parameters,
    )


def _kernels(model: Model, native: bool, fresh: bool) -> Kernels | str:
    """Known kernels or, `fresh`, from a new trace; why there are none."""
    kind = kind_of(model)
    kinds: dict[Any, Kernels | str] = _KINDS
    if kind is None:
        try:
            kinds = _OBJECTS.setdefault(model.problem, {})
        except TypeError:  # neither hashable nor weakly referable: traced anew each time
            kinds = {}
    key = (native, kind or (model.integrator, model.state_dim, model.control_dim))
    if fresh or key not in kinds:
        kinds[key] = _try_trace(model, native)
    return kinds[key]


def _try_trace(model: Model, native: bool) -> Kernels | str:
    try:
        return trace(model, native=native)
    except TraceError as error:
        return str(error)


def _agree(model: Model, kernels: Kernels, parameters: Array, x: Array, u: Array) -> bool:
    """Whether traced functions and the problem's own agree, at random points near x and u.

    Random, because along a guess at rest, say, no drag would be seen.
    """
    own = _from_model(model)
    rng = np.random.default_rng(0)
    dt = model.dt
    x = x + 0.1 * (1.0 + np.abs(x).max(axis=0)) * rng.normal(size=x.shape)
    u = u + 0.1 * (1.0 + np.abs(u).max(axis=0)) * rng.normal(size=u.shape)
    pairs = (
        (kernels.stage, own.stage, {"t": model.times[:-1], "dt": dt, "x": x[:-1], "u": u}),
        (kernels.node, own.node, {"t": model.times[1:], "x": x[1:]}),
        (kernels.terminal, own.terminal, {"x": x[-1:]}),
    )
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for traced, given, arguments in pairs:
            a, b = traced(**arguments, parameters=parameters), given(**arguments)
            # Beyond the edge of a domain, of a root for example, the complex step has values.
            inside = _finite_rows(b)
            if not inside.any() or not np.array_equal(_finite_rows(a), inside):
                return False
            for name in a:
                # H_xx: by differences
                if name != "H_xx" and not _same(a[name][inside], b[name][inside]):
                    return False
    return True


def _finite_rows(rows: Rows) -> Array:
    """At which nodes all values, derivatives not counted, are finite, (K,)."""
    values = [v for name, v in rows.items() if name in ("next", "sigma", "ell", "c", "H", "g")]
    return np.isfinite(np.concatenate(values, axis=1)).all(axis=1)


def _same(a: Array, b: Array) -> bool:
    finite = np.isfinite(b)
    if not np.array_equal(np.isfinite(a), finite):
        return False
    a, b = np.where(finite, a, 0.0), np.where(finite, b, 0.0)
    size = np.abs(b).max(axis=0, initial=0.0)  # of each entry: they may differ in their units
    rounding = 1e-13 * (1.0 + size.max(initial=0.0))
    return bool((np.abs(a - b) <= _AGREEMENT * size + rounding).all())


def _from_model(model: Model) -> Functions:
    """The six functions from the model's own; Hessians by differences."""
    n, m = model.state_dim, model.control_dim

    def stage(t: Array, dt: Array, x: Array, u: Array) -> Rows:
        A, B = jacobian(model.integrator, model.drift, model.drift_jacobian, t, dt, x, u)
        rows = {
            "next": x + change(model.integrator, model.drift, t, dt, x, u),
            "A": A,
            "B": B,
            "sigma": model.diffusion(t, x),
            "d_sigma": model.diffusion_jacobian(t, x),
        }
        if model.control_cost is not None and model.control_cost_jacobian is not None:
            rows |= {
                "ell": model.control_cost(t, x),
                "d_ell": model.control_cost_jacobian(t, x),
            }
        else:
            rows |= {"ell": np.zeros((len(t), m)), "d_ell": np.zeros((len(t), m, n))}
        return _flat(rows)

    def node(t: Array, x: Array) -> Rows:
        rows = {"c": model.penalty(t, x), "C": model.penalty_jacobian(t, x)}
        if model.state_cost is not None and model.state_cost_derivatives is not None:
            gradient, hessian = model.state_cost_derivatives(t, x)
            rows |= {"H": model.state_cost(t, x), "H_x": gradient, "H_xx": hessian}
        else:
            K = len(t)
            rows |= {"H": np.zeros(K), "H_x": np.zeros((K, n)), "H_xx": np.zeros((K, n, n))}
        return _flat(rows)

    def terminal(x: Array) -> Rows:
        return _flat({"g": model.terminal(x), "G": model.terminal_jacobian(x)})

    def stage_hessian(t: Array, dt: Array, x: Array, u: Array, adjoint: Array) -> Rows:
        def gradient(z: Array) -> Array:
            y, v = z[..., :n], z[..., n:]
            shape = y.shape[:-1]
            tt, dd = np.broadcast_to(t, shape), np.broadcast_to(dt, shape)
            A, B = jacobian(model.integrator, model.drift, model.drift_jacobian, tt, dd, y, v)
            by_x = np.einsum("ki,ckij->ckj", adjoint, A)
            by_u = np.einsum("ki,ckij->ckj", adjoint, B)
            if model.control_cost is not None and model.control_cost_jacobian is not None:
                d_ell = np.asarray(model.control_cost_jacobian(tt, y))
                by_x += dd[..., None] * np.einsum("ckmn,ckm->ckn", d_ell, v)
                by_u += dd[..., None] * np.asarray(model.control_cost(tt, y))
            return np.concatenate([by_x, by_u], axis=-1)

        full = _differences(gradient, np.concatenate([x, u], axis=1))
        return _flat({"xx": full[:, :n, :n], "ux": full[:, n:, :n], "uu": full[:, n:, n:]})

    def node_hessian(t: Array, x: Array, weight: Array) -> Rows:
        def gradient(y: Array) -> Array:
            tt = np.broadcast_to(t, y.shape[:-1])
            return np.einsum("kp,ckpn->ckn", weight, np.asarray(model.penalty_jacobian(tt, y)))

        if not weight.any():
            return {"xx": np.zeros((len(t), n * n))}
        return _flat({"xx": _differences(gradient, x)})

    def terminal_hessian(x: Array, multiplier: Array) -> Rows:
        def gradient(y: Array) -> Array:
            return np.einsum("kq,ckqn->ckn", multiplier, np.asarray(model.terminal_jacobian(y)))

        return _flat({"xx": _differences(gradient, x)})

    return Functions(
        stage, node, terminal, stage_hessian, node_hessian, terminal_hessian, None, np.zeros(1)
    )


def _flat(rows: dict[str, Any]) -> Rows:
    return {name: _rows(np.asarray(value, dtype=np.float64)) for name, value in rows.items()}


def _rows(value: Array) -> Array:
    """(K, ...) -> (K, width), also where the width is zero."""
    return value.reshape(len(value), int(np.prod(value.shape[1:])))


def _differences(gradient: Callable[[Array], Array], x: Array) -> Array:
    """Symmetric Jacobian of a gradient (copies, K, n) -> (copies, K, n) at x (K, n): (K, n, n)."""
    K, n = x.shape
    steps = _STEP * (1.0 + np.max(np.abs(x), axis=0))
    shifted = np.broadcast_to(x, (2 * n, K, n)).copy()
    for i in range(n):
        shifted[2 * i, :, i] += steps[i]
        shifted[2 * i + 1, :, i] -= steps[i]
    values = gradient(shifted)
    full = np.moveaxis((values[::2] - values[1::2]) / (2.0 * steps[:, None, None]), 0, -1)
    return 0.5 * (full + full.swapaxes(1, 2))

"""Problems' quantities put into a workspace by NumPy: where there is no LLVM, or no trace.

A traced problem is evaluated by NumPy code made from its expressions; one that cannot be traced by
its own functions and their Jacobians, with second derivatives by differences of those.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.newton.program import Workspace
from slipcar.planner.newton.quantities import Traced
from slipcar.planner.problem.integrators import change, jacobian
from slipcar.planner.problem.model import Model
from slipcar.planner.trace.numpy_code import numpy_function

Array = np.ndarray

#: The cube root of the machine epsilon balances truncation and rounding of central differences.
_STEP = 6e-6
_VALUES = (
    "next", "A", "B", "sigma", "d_sigma", "ell", "d_ell", "c", "C", "H", "H_x", "H_xx", "g", "G",
)  # fmt: skip


class TracedFiller:
    """Fills in what a trace says, by NumPy code over all nodes at once.

    Args:
        problem: its expressions.
    """

    def __init__(self, problem: Traced) -> None:
        dims, graph = problem.dims, problem.graph
        inputs = {"t": 1, "dt": 1, "x": dims.n, "u": dims.m, "number": dims.numbers}
        shared = frozenset({"number"})
        lam = graph.inputs("adjoint", (dims.n,))
        one = np.eye(dims.n)
        values = {name: _flat(graph, getattr(problem, name)) for name in _VALUES}
        z = np.concatenate([problem.x, problem.u])
        hessians = [problem.lagrangian_hessian(row) for row in np.zeros((1, dims.n))]
        del lam, z
        bends = [problem.lagrangian_hessian(row) - hessians[0] for row in one]
        second = {
            "next_hessians": bends, "cost_hessian": hessians[0],
            "row_hessians": problem.row_hessians, "end_hessians": problem.end_hessians,
        }  # fmt: skip
        self._values = numpy_function(inputs, values, shared)
        self._next = numpy_function(inputs, {"next": values["next"]}, shared)
        self._second = numpy_function(
            inputs, {name: _flat(graph, value) for name, value in second.items()}, shared
        )

    def point(self, workspace: Workspace, side: int) -> None:
        """Values and first derivatives at a point."""
        self._fill(self._values, workspace, side)

    def second(self, workspace: Workspace, side: int) -> None:
        """Second derivatives there."""
        self._fill(self._second, workspace, side)

    def rollout(self, workspace: Workspace, side: int) -> None:
        """The candidate that follows its dynamics, node by node."""
        points = {name: workspace.at(side, name) for name in ("x", "u", "next")}
        arrays = workspace.arrays

        def before(k: int) -> None:
            one = slice(k, k + 1)
            given = {name: points[name][one] for name in ("x", "u")}
            given |= {"t": arrays["t"][one], "dt": arrays["dt"][one], "number": arrays["number"]}
            points["next"][one] = self._next(**given)["next"]

        workspace.step_by_step("rollout", side, before)

    @staticmethod
    def _fill(function: Callable[..., dict[str, Array]], workspace: Workspace, side: int) -> None:
        arguments = {name: workspace.at(side, name) for name in ("x", "u")}
        arguments |= {name: workspace.arrays[name] for name in ("t", "dt", "number")}
        _put(workspace, side, function(**arguments))


def _flat(graph: Any, value: Any) -> list[Any]:
    entries = np.ravel(np.asarray(value, dtype=object))
    return [graph.lift(entry) for entry in entries]


def _put(workspace: Workspace, side: int, rows: dict[str, Array]) -> None:
    """Rows of all nodes into a workspace; those of arrays with one row from the last node."""
    for name, value in rows.items():
        target = workspace.at(side, name)
        target[:] = value[-len(target) :].reshape(target.shape)


class ModelFiller:
    """Fills in what the functions of a model say.

    Args:
        model: the problem.
        tails: rows that are constraints, after the penalties.
    """

    def __init__(self, model: Model, tails: int) -> None:
        self._model, self._tails = model, tails

    def _rows(self, t: Array, x: Array) -> Array:
        """Penalties, then constraints, (..., p)."""
        rows = self._model.penalty(t, x)
        if self._tails:
            own = self._model.problem.constraint(t, x)  # type: ignore[attr-defined]
            rows = np.concatenate([rows, own], axis=-1)
        return rows

    def _row_slopes(self, t: Array, x: Array) -> Array:
        """Their Jacobians, (..., p, n)."""
        slopes = np.asarray(self._model.penalty_jacobian(t, x))
        if self._tails:
            own = self._model.jacobians.state("constraint", t, x)
            slopes = np.concatenate([slopes, own], axis=-2)
        return slopes

    def rows(self, t: Array, x: Array) -> tuple[Array, Array, Array]:
        """Rows c (K, p), their Jacobians (K, p, n) and Hessians (K, p, n, n) at states (K, n)."""

        def slopes(y: Array) -> Array:
            return self._row_slopes(np.broadcast_to(t, y.shape[:-1]), y)

        return self._rows(t, x), self._row_slopes(t, x), _differences(slopes, x)

    @np.errstate(all="ignore")
    def point(self, workspace: Workspace, side: int) -> None:
        """Values and first derivatives at a point."""
        model, K, arrays = self._model, workspace.K, workspace.arrays
        x, u = workspace.at(side, "x"), workspace.at(side, "u")[:K]
        t, dt = arrays["t"][:, 0], arrays["dt"][:K, 0]
        at = (t[:K], dt, x[:K], u)
        A, B = jacobian(model.integrator, model.drift, model.drift_jacobian, *at)
        stage = {
            "next": x[:K] + change(model.integrator, model.drift, *at), "A": A, "B": B,
        }  # fmt: skip
        if model.control_cost is not None:
            stage |= {"ell": model.control_cost(t[:K], x[:K]),
                      "d_ell": model.control_cost_jacobian(t[:K], x[:K])}  # fmt: skip
        for name, value in stage.items():
            workspace.at(side, name)[:K] = value
        node = {"sigma": model.diffusion(t, x), "d_sigma": model.diffusion_jacobian(t, x)}
        if workspace.program.dims.p:
            node |= {"c": self._rows(t, x), "C": self._row_slopes(t, x)}
        if model.state_cost is not None:
            slope, bend = model.state_cost_derivatives(t, x)
            node |= {"H": model.state_cost(t, x), "H_x": slope, "H_xx": bend}
        for name, value in node.items():
            workspace.at(side, name)[:] = value
        workspace.at(side, "g")[0] = model.terminal(x[K:])[0]
        workspace.at(side, "G")[0] = model.terminal_jacobian(x[K:])[0]

    def rollout(self, workspace: Workspace, side: int) -> None:
        """The candidate that follows its dynamics, node by node."""
        model, arrays = self._model, workspace.arrays
        x, u, ahead = (workspace.at(side, name) for name in ("x", "u", "next"))

        def before(k: int) -> None:
            at = (arrays["t"][k : k + 1, 0], arrays["dt"][k : k + 1, 0], x[k : k + 1], u[k : k + 1])
            ahead[k] = (x[k : k + 1] + change(model.integrator, model.drift, *at))[0]

        workspace.step_by_step("rollout", side, before)

    @np.errstate(all="ignore")
    def second(self, workspace: Workspace, side: int) -> None:
        """Second derivatives there, by central differences of first ones."""
        model, K, arrays = self._model, workspace.K, workspace.arrays
        x = workspace.at(side, "x")
        n = x.shape[1]
        u, t, dt = workspace.at(side, "u")[:K], arrays["t"][:, 0], arrays["dt"][:K, 0]

        def stage(z: Array) -> Array:
            y, v = z[..., :n], z[..., n:]
            tt, dd = np.broadcast_to(t[:K], y.shape[:-1]), np.broadcast_to(dt, y.shape[:-1])
            parts = jacobian(model.integrator, model.drift, model.drift_jacobian, tt, dd, y, v)
            return np.concatenate(parts, axis=-1)

        def cost(z: Array) -> Array:
            y, v = z[..., :n], z[..., n:]
            tt = np.broadcast_to(t[:K], y.shape[:-1])
            by_x = np.einsum("ckmn,ckm->ckn", np.asarray(model.control_cost_jacobian(tt, y)), v)
            by_u = np.asarray(model.control_cost(tt, y))  # type: ignore[misc]
            return dt[:, None] * np.concatenate([by_x, by_u], axis=-1)

        z = np.concatenate([x[:K], u], axis=1)
        workspace.at(side, "next_hessians")[:K] = _differences(stage, z)
        if model.control_cost is not None:
            workspace.at(side, "cost_hessian")[:K] = _differences(cost, z)
        if workspace.program.dims.p:
            workspace.at(side, "row_hessians")[:] = self.rows(t, x)[2]
        end = _differences(lambda y: np.asarray(model.terminal_jacobian(y)), x[K:])
        workspace.at(side, "end_hessians")[:] = end


def _differences(gradient: Callable[[Array], Array], x: Array) -> Array:
    """Symmetric Jacobian of gradients (copies, K, ..., n) -> (copies, K, ..., n) at x (K, n)."""
    K, n = x.shape
    size = np.max(np.abs(x), axis=0)
    steps = _STEP * np.where(size > 0.0, size, 1.0)
    shifted = np.broadcast_to(x, (2 * n, K, n)).copy()
    for i in range(n):
        shifted[2 * i, :, i] += steps[i]
        shifted[2 * i + 1, :, i] -= steps[i]
    values = gradient(shifted)
    scale = (2.0 * steps).reshape(n, *[1] * (values.ndim - 1))
    full = np.moveaxis((values[::2] - values[1::2]) / scale, 0, -1)
    return 0.5 * (full + full.swapaxes(-1, -2))

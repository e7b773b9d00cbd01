"""What an iterate lacks: a path that its controls lead to, an end that is where it shall be."""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.linearization import Linearization
from slipcar.planner.problem.model import Model
from slipcar.planner.trace.elementwise import magnitude

Array = np.ndarray

#: A converged plan leaves no more than this of a terminal condition, relative to its moves.
FEASIBILITY = 1e-6

#: Of what a state is put together from, this part may be rounding.
_ROUNDING = 1e-8
#: Controls are compared with their own size; at least with what moves a state by this part of how
#: far it moves.
LEAST_MOVE = 1e-3
#: That size is how far they are from where their own cost is least; at least this part of them:
#: the last digits are rounding.
_LEAST_PART = 1e-6
#: Against division by zero.
TINY = 1e-150


def path_sizes(moved: Array, terms: Array, A: Array) -> Any:
    """How far each state moves along a path, (n,): its unit, whatever the units of the problem.

    Args:
        moved: largest less smallest value of each state, (n,).
        terms: largest |A| |x| + |B| |u| of each state, what it is put together from, (n,).
        A: of some interval, (n, n), which carries the rounding of one state to others.

    Arrays of numbers and of expressions alike.
    """
    for _ in range(3):
        terms = magnitude(A).dot(terms)
    return moved + _ROUNDING * terms + TINY


def control_size(own: Array, u: Array, weight: Array) -> Any:
    """The square of the size of controls, in the norm of their weights: (...,).

    Args:
        own: how far they are from where their own cost is least, (..., m).
        u: controls, (..., m).
        weight: diagonal of R, (m,).

    Arrays of numbers and of expressions alike.
    """
    return (own * own + _LEAST_PART**2 * (u * u)).dot(weight)


def end_sizes(G: Array, sizes: Any) -> Any:
    """How far each terminal condition moves when the states do, (q,): its unit."""
    return magnitude(G).dot(sizes) + TINY


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def terminal_force(model: Model, at: Linearization) -> float:
    """How large a multiplier moves the linearised end to where it shall be, at least.

    With W = Σ Φ_k B_k (2 dt R)⁻¹ B_kᵀ Φ_kᵀ the controllability Gramian seen by G, a change γ of
    the end at least cost takes W ν = γ, so ‖ν‖ ≥ ‖γ‖ / λ_max(W). This sets the scale of the
    terminal penalty, whatever the units of states and costs.
    """
    _, W, missing = _reach(model, at)
    strength = float(np.max(np.linalg.eigvalsh(W), initial=0.0)) if np.isfinite(W).all() else 0.0
    return float(np.linalg.norm(missing)) / strength if strength > 0.0 else 0.0


def least_push(model: Model, at: Linearization) -> Array:
    """Changes of the controls, (K, m), that lead to the linearised end at least effort.

    Zeros where the model is not finite; what is out of reach is left out (least squares).
    """
    pushed, W, missing = _reach(model, at)
    if not (np.isfinite(W).all() and np.isfinite(missing).all()):
        return np.zeros(at.u.shape)
    scale = 1.0 / np.sqrt(W.diagonal() + TINY)
    nu = scale * np.linalg.lstsq(scale[:, None] * W * scale, scale * missing, rcond=1e-10)[0]
    force = np.einsum("kqi,q->ki", pushed, nu) / model.dt[:, None]
    return -0.5 * np.linalg.solve(model.R, force.T).T


def _reach(model: Model, at: Linearization) -> tuple[Array, Array, Array]:
    """G Φ_k B_k of each control (K, q, m), the Gramian W (q, q), and what the end lacks (q,)."""
    Phi = np.empty((len(at.A), *at.G.shape))  # G Φ_k: what arrives at node k + 1 does at the end
    Phi[-1] = at.G
    for k in range(len(at.A) - 1, 0, -1):
        Phi[k - 1] = Phi[k].dot(at.A[k])
    missing = at.g + np.einsum("kqi,ki->q", Phi, at.defect)
    pushed = Phi @ at.B
    W = np.einsum("kqi,ij,krj,k->qr", pushed, np.linalg.inv(2.0 * model.R), pushed, 1.0 / model.dt)
    return pushed, W, missing


def states_moved(at: Linearization) -> Array:
    """How far each state moves along a trajectory, (n,)."""
    terms = np.abs(at.A) @ np.abs(at.x[:-1, :, None]) + np.abs(at.B) @ np.abs(at.u[..., None])
    return np.asarray(path_sizes(np.ptp(at.x, axis=0), terms.max(axis=0)[:, 0], at.A[0]))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def inconsistency(at: Linearization) -> float:
    """How far, to first order, the mean is from the path of its controls, relative to its moves.

    The defects carried forward along the linearised dynamics.
    """
    gap, worst = np.zeros(at.x.shape[1]), np.zeros(at.x.shape[1])
    for A, defect in zip(at.A, at.defect, strict=True):
        gap = A.dot(gap) + defect
        worst = np.maximum(worst, np.abs(gap))
    return float(np.max(worst / states_moved(at)))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def lacks(at: Linearization, tolerance: float, g: Array | None = None) -> Array:
    """What each terminal condition lacks beyond its tolerance, relative to its moves, (q,).

    Args:
        at: the trajectory.
        tolerance: half-width of the terminal box.
        g: residuals instead of the trajectory's, (q,).
    """
    beyond = np.maximum(np.abs(at.g if g is None else g) - tolerance, 0.0)
    return np.asarray(beyond / end_sizes(at.G, states_moved(at)))


def what_lacks(at: Linearization, tolerance: float) -> str:
    """Terminal conditions that are not met, the worst first, with their residuals."""
    relative = np.nan_to_num(lacks(at, tolerance), nan=np.inf)
    worst = [j for j in np.argsort(-relative, kind="stable") if relative[j] > FEASIBILITY]
    return ", ".join(f"g[{j}] = {at.g[j]:.4g}" for j in worst)


@np.errstate(all="ignore")
def not_finite(model: Model, x: Array, u: Array, along: str = "along the guess") -> str:
    """Which function of the problem gave NaN or infinity along a path, and where: a sentence.

    Args:
        model: the problem.
        x: states, (N, n).
        u: controls, (N−1, m).
        along: what path that is.
    """
    t, last = model.times, len(u)
    starts = np.arange(last), (t[:-1], x[:-1])
    ends = np.arange(1, last + 1), (t[1:], x[1:])
    final = np.arange(last, last + 1), (t[-1:], x[-1:])
    # The constraint last, for it is charged only where risk has a price.
    nodes = {
        "drift": starts, "diffusion": starts, "terminal": final, "penalty": ends,
        "state_cost": ends, "control_cost": starts, "constraint": ends,
    }  # fmt: skip
    nodes = {name: at for name, at in nodes.items() if model.has(name)}
    for name, (node, at) in nodes.items():
        given = {"drift": (*at, u), "terminal": at[1:]}.get(name, at)
        value = np.asarray(getattr(model.problem, name)(*given), dtype=np.float64)
        if not np.isfinite(value).all():
            return _where(name, name, value, node, at, u, along)
    moved = change(model.integrator, model.drift, t[:-1], model.dt, x[:-1], u)
    if not np.isfinite(moved).all():
        return _where("drift", "its step to the next node", np.asarray(moved), *starts, u, along)
    for name, (node, at) in nodes.items():
        for value in _derivatives(model, name, at, u):
            if not np.isfinite(value).all():
                return _where(
                    f"the derivative of {name}", "it", np.asarray(value), node, at, u, along
                )
    return (
        f"the cost is not finite {along}, though every function is: states go up to "
        f"{np.abs(x).max():.3g}, controls to {np.abs(u).max():.3g}"
    )


def _derivatives(model: Model, name: str, at: tuple[Array, Array], u: Array) -> tuple[Array, ...]:
    if name == "drift":
        return model.drift_jacobian(*at, u)
    if name == "state_cost":
        return model.state_cost_derivatives(*at)
    return (model.jacobians.state(name, *at),)


def _where(
    name: str,
    label: str,
    value: Array,
    node: Array,
    at: tuple[Array, Array],
    u: Array,
    along: str,
) -> str:
    """Say which entry of a function's values (nodes, ...) is the first that is not finite."""
    k, *entry = (int(i) for i in np.argwhere(~np.isfinite(value))[0])
    t, x = at
    place = f"node {node[k]}, t = {t[k]:.4g}, x = {_show(x[k])}"
    if name.endswith("drift"):
        place += f", u = {_show(u[k])}"
    bad = f"{label}{entry or ''} = {value[(k, *entry)]}"
    return f"{name} is not finite {along}: {bad} at {place}"


def _show(values: Array) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"

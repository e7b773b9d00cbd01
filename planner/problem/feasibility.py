"""What an iterate lacks: a path that its controls lead to, an end that is where it shall be."""

from __future__ import annotations

import numpy as np

from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.linearization import Linearization
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: A converged plan leaves no more than this of the terminal condition, per unit of the state.
FEASIBILITY = 1e-6


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def terminal_force(model: Model, at: Linearization) -> float:
    """How large a multiplier moves the linearised end to where it shall be, at least.

    With W = Σ Φ_k B_k (2 dt R)⁻¹ B_kᵀ Φ_kᵀ the controllability Gramian seen by G, a change γ of
    the end at least cost takes W ν = γ, so ‖ν‖ ≥ ‖γ‖ / λ_max(W). This sets the scale of the
    terminal penalty, whatever the units of states and costs.
    """
    Phi = np.empty((len(at.A), *at.G.shape))  # G Φ_k: what arrives at node k + 1 does at the end
    Phi[-1] = at.G
    for k in range(len(at.A) - 1, 0, -1):
        Phi[k - 1] = Phi[k].dot(at.A[k])
    missing = at.g + np.einsum("kqi,ki->q", Phi, at.defect)
    pushed = Phi @ at.B
    W = np.einsum("kqi,ij,krj,k->qr", pushed, np.linalg.inv(2.0 * model.R), pushed, 1.0 / model.dt)
    strength = float(np.max(np.linalg.eigvalsh(W), initial=0.0)) if np.isfinite(W).all() else 0.0
    return float(np.linalg.norm(missing)) / strength if strength > 0.0 else 0.0


def inconsistency(at: Linearization, tolerance: float, lacking: float = 0.0) -> float:
    """How far, to first order, the mean is from the path that the controls lead to.

    The defects carried forward along the linearised dynamics; and the terminal residual beyond
    what the sub-problem said is lacking.
    """
    gap, worst = np.zeros(at.x.shape[1]), 0.0
    for A, defect in zip(at.A, at.defect, strict=True):
        gap = A.dot(gap) + defect
        worst = max(worst, np.abs(gap).max())
    beyond = np.maximum(np.abs(at.g) - tolerance, 0.0)
    return max(worst, abs(float(beyond.sum()) - lacking))


def what_lacks(at: Linearization, tolerance: float, size: float) -> str:
    """Which components of the terminal condition cannot be met, and by how much."""
    beyond = at.g - np.clip(at.g, -tolerance, tolerance)
    worst = sorted(
        np.flatnonzero(np.abs(beyond) > FEASIBILITY * size), key=lambda j: -abs(beyond[j])
    )
    named = ", ".join(f"g[{j}] = {at.g[j]:.4g}" for j in worst)
    return f"the terminal condition is out of reach; nearest path: {named}"


@np.errstate(all="ignore")
def not_finite(model: Model, x: Array, u: Array) -> str:
    """Which function of the problem gave NaN or infinity along a guess, and where: a sentence.

    Args:
        model: the problem.
        x: states of the guess, (N, n).
        u: its controls, (N−1, m).
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
            return _where(name, name, value, node, at, u)
    moved = change(model.integrator, model.drift, t[:-1], model.dt, x[:-1], u)
    if not np.isfinite(moved).all():
        return _where("drift", "its step to the next node", np.asarray(moved), *starts, u)
    for name, (node, at) in nodes.items():
        for value in _derivatives(model, name, at, u):
            if not np.isfinite(value).all():
                return _where(f"the derivative of {name}", "it", np.asarray(value), node, at, u)
    return (
        "the cost is not finite along the guess, though every function is: states go up to "
        f"{np.abs(x).max():.3g}, controls to {np.abs(u).max():.3g}"
    )


def _derivatives(model: Model, name: str, at: tuple[Array, Array], u: Array) -> tuple[Array, ...]:
    if name == "drift":
        return model.drift_jacobian(*at, u)
    if name == "state_cost":
        return model.state_cost_derivatives(*at)
    return (model.jacobians.state(name, *at),)


def _where(
    name: str, label: str, value: Array, node: Array, at: tuple[Array, Array], u: Array
) -> str:
    """Say which entry of a function's values (nodes, ...) is the first that is not finite."""
    k, *entry = (int(i) for i in np.argwhere(~np.isfinite(value))[0])
    t, x = at
    place = f"node {node[k]}, t = {t[k]:.4g}, x = {_show(x[k])}"
    if name.endswith("drift"):
        place += f", u = {_show(u[k])}"
    bad = f"{label}{entry or ''} = {value[(k, *entry)]}"
    return f"{name} is not finite along the guess: {bad} at {place}"


def _show(values: Array) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"

"""What an iterate lacks: a path that its controls lead to, an end that is where it shall be."""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.planner.problem.linearization import Linearization
from slipcar.planner.problem.model import Model
from slipcar.planner.trace.elementwise import magnitude

Array = np.ndarray

#: A converged plan leaves no more than this of the terminal condition, per unit of the state.
FEASIBILITY = 1e-6

#: Of what a state is put together from, this part may be rounding.
_ROUNDING = 1e-8
#: Controls are compared with their own size; at least with what moves a state by this part of how
#: far it moves.
LEAST_MOVE = 1e-3
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


def not_finite(at: Linearization) -> str:
    """Which function of the problem gave NaN or infinity."""
    named = {
        "drift": (at.defect,),
        "drift_jacobian": (at.A, at.B),
        "diffusion": (at.sigma,),
        "penalty": (at.c,),
        "penalty_jacobian": (at.C,),
        "terminal": (at.g,),
        "terminal_jacobian": (at.G,),
    }
    for name, arrays in named.items():
        if not all(np.isfinite(a).all() for a in arrays):
            return name
    return "state_cost or control_cost"

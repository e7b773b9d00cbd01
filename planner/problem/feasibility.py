"""What an iterate lacks: a path that its controls lead to, an end that is where it shall be."""

from __future__ import annotations

from typing import Any

import numpy as np

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

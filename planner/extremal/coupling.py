"""How the variance penalty's Λ moves with a Newton step, which no band can hold.

Λ_k = dt I + A_kᵀ Λ_{k+1} A_k depends on all later nodes, so its change in the adjoint equation
couples every node with those after it. It is small, and put in by solving the banded system again
with the change that the last step caused on its right-hand side, until the two agree.
"""

from __future__ import annotations

import numpy as np

from slipcar.planner.extremal.maximum_principle import FirstOrder
from slipcar.planner.extremal.newton_step import NewtonSystem
from slipcar.planner.extremal.second_order import SecondOrder
from slipcar.planner.lq.banded import PrimalDual
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: Solves at most for one step.
_SOLVES = 12


def coupled_step(
    model: Model,
    gradients: FirstOrder,
    hessians: SecondOrder,
    system: NewtonSystem,
    step: PrimalDual,
    variance_weight: float,
    enough: float,
) -> PrimalDual | None:
    """The Newton step with what the change of Λ along it adds; None if it overflows.

    Args:
        model: the problem.
        gradients: first derivatives, with Λ.
        hessians: Hessian blocks.
        system: factorised for the pieces of `step`.
        step: with Λ held.
        variance_weight: w > 0.
        enough: largest error of the adjoint equation to leave.
    """
    d_sigma = np.asarray(model.diffusion_jacobian(model.times[:-1], gradients.lin.x[:-1]))
    push = np.zeros_like(step.d)
    pushes: list[Array] = []
    errors: list[Array] = []
    for _ in range(_SOLVES):
        error = variance_weight * gradient_change(model, gradients, hessians, d_sigma, step) - push
        if not np.max(np.abs(error)) > enough:
            break
        pushes.append(push)
        errors.append(error)
        push = _next_guess(pushes, errors)
        coupled = system.solve(push)
        if coupled is None:
            return None
        step = coupled
    return step


def _next_guess(pushes: list[Array], errors: list[Array]) -> Array:
    """The next guess at a linear fixed point: exact after as many as there are directions.

    Plain repetition converges only while the variance weighs little; combining the guesses so
    that their errors cancel (Anderson 1965, for linear maps the same as GMRES) always does.
    """
    latest = pushes[-1] + errors[-1]
    if len(pushes) == 1:
        return latest
    E = np.stack([(errors[-1] - error).ravel() for error in errors[:-1]], axis=1)
    P = np.stack([(pushes[-1] - push).ravel() for push in pushes[:-1]], axis=1)
    share = np.linalg.lstsq(E, errors[-1].ravel(), rcond=None)[0]
    return latest - ((P + E) @ share).reshape(latest.shape)


def gradient_change(
    model: Model, gradients: FirstOrder, hessians: SecondOrder, d_sigma: Array, step: PrimalDual
) -> Array:
    """Change of the gradient of ∫ tr Σ at nodes 1..K because Λ moves with the step.

    Args:
        model: the problem.
        gradients: first derivatives, with Λ.
        hessians: for ∂A/∂x and ∂A/∂u.
        d_sigma: ∂σ/∂x at nodes 0..K−1, (K, n, d, n).
        step: the step.

    Returns:
        (K, n).
    """
    Lambda, A = gradients.weights, gradients.lin.A
    assert Lambda is not None
    d = step.d
    K, n = d.shape
    dA = np.matmul(hessians.A_u, step.e[:, None, :, None])[..., 0]
    dA[1:] += np.matmul(hessians.A_x[1:], d[:-1, None, :, None])[..., 0]
    one_sided = dA[1:].swapaxes(1, 2) @ Lambda[1:] @ A[1:]
    driven = one_sided + one_sided.swapaxes(1, 2)
    change = np.zeros((K, n, n))
    for k in range(K - 2, -1, -1):
        change[k] = driven[k] + A[k + 1].T.dot(change[k + 1]).dot(A[k + 1])
    against = 2.0 * model.dt[:, None, None] * (change @ gradients.lin.sigma)
    total = np.zeros((K, n))
    total[:-1] = np.einsum("kac,kaci->ki", against, d_sigma)[1:]
    return total

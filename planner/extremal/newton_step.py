"""A Newton step on the conditions of an extremal: banded linear systems, one per active set.

Linearised but for their kinks, the conditions are those of a sub-problem whose Q, S and R are the
blocks of the Lagrangian's Hessian (:mod:`.second_order`): hinges, limits of the controls and the
terminal box are on one piece or another, and which ones is settled as in
:mod:`slipcar.planner.convex.solvers`. On given pieces a step (d, e, δλ, δν) solves an LQ problem
(:mod:`slipcar.planner.lq.banded`).

The variance penalty's Λ_k = dt I + A_kᵀ Λ_{k+1} A_k depends on all later nodes, so its change in
the adjoint equation couples every node with those after it, which no band can hold. It is small,
and put in by solving the banded system again with the change that the last step caused on its
right-hand side, until the two agree.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from slipcar.planner.convex.subproblem import Pieces
from slipcar.planner.extremal.maximum_principle import FirstOrder
from slipcar.planner.extremal.second_order import SecondOrder
from slipcar.planner.lq.banded import BandedLq, PrimalDual
from slipcar.planner.problem.model import Model

Array = np.ndarray
#: The step with so much added to the gradient of the Lagrangian at nodes 1..K, (K, n); None if it
#: overflows.
System = Callable[[Array], PrimalDual | None]

#: Solves at most for the coupling of one step.
_COUPLING_SOLVES = 12


def newton_system(
    at: FirstOrder,
    hessians: SecondOrder,
    adjoint: Array,
    terminal: Array,
    pieces: Pieces,
    tolerance: float,
) -> System | None:
    """The linearised conditions on given pieces, factorised; None if singular.

    λ_1..λ_K (K, n), ν (q,); `tolerance` is the half-width of the terminal box.
    """
    sub = at.sub
    M, e0 = sub.free_controls(pieces.held, hessians.uu, at.slope(adjoint))
    drift = sub.f + np.matmul(sub.B, e0[..., None])[..., 0]
    h, held = sub.h * pieces.hinge, pieces.terminal != 0
    q = sub.q - adjoint + np.matmul((h * sub.b)[:, None], sub.a)[:, 0]
    q[:-1] += np.matmul(adjoint[1:, None], sub.A[1:])[:, 0]
    q[-1] += terminal @ sub.G
    side = np.where(held, tolerance * pieces.terminal - sub.g, -terminal)
    K, n = sub.f.shape
    lq = BandedLq(K, n, len(sub.g))
    lq.load(sub.A, sub.B, M, hessians.ux)
    lq.end(sub.G, held, np.where(held, 0.0, 1.0))
    if not lq.factor(hessians.xx + sub.a.swapaxes(1, 2) @ (h[..., None] * sub.a)):
        return None
    return lambda push: lq.solve(e0, drift, q + push, side)


def coupled_step(
    model: Model,
    at: FirstOrder,
    hessians: SecondOrder,
    solve: System,
    step: PrimalDual | None,
    variance_weight: float,
    enough: float,
) -> PrimalDual | None:
    """The Newton step, from that with Λ held; `enough` is the error of the adjoint to leave.

    Plain repetition converges only while the variance weighs little; combining the guesses so
    that their errors cancel (Anderson 1965, for linear maps the same as GMRES) always does.
    """
    d_sigma = np.asarray(model.diffusion_jacobian(model.times[:-1], at.lin.x[:-1]))
    push = np.zeros_like(at.lin.defect)
    pushes: list[Array] = []
    errors: list[Array] = []
    while step is not None and len(pushes) < _COUPLING_SOLVES:
        error = variance_weight * _gradient_change(model.dt, at, hessians, d_sigma, step) - push
        if not np.max(np.abs(error)) > enough:
            break
        pushes.append(push.ravel())
        errors.append(error.ravel())
        gamma = np.linalg.lstsq(np.diff(errors, axis=0).T, errors[-1], rcond=None)[0]
        alpha = np.diff(gamma, prepend=0.0, append=1.0)
        push = (alpha @ (np.array(pushes) + errors)).reshape(push.shape)
        step = solve(push)
    return step


def _gradient_change(
    dt: Array, at: FirstOrder, hessians: SecondOrder, d_sigma: Array, step: PrimalDual
) -> Array:
    """Change of the gradient of ∫ tr Σ at nodes 1..K because Λ moves with the step, (K, n)."""
    Lambda, A, d = at.weights, at.lin.A, step.d
    assert Lambda is not None
    dA = np.matmul(hessians.A_u, step.e[:, None, :, None])[..., 0]
    dA[1:] += np.matmul(hessians.A_x[1:], d[:-1, None, :, None])[..., 0]
    one_sided = dA[1:].swapaxes(1, 2) @ Lambda[1:] @ A[1:]
    driven = one_sided + one_sided.swapaxes(1, 2)
    change = np.zeros_like(A)
    for k in range(len(A) - 2, -1, -1):
        change[k] = driven[k] + A[k + 1].T.dot(change[k + 1]).dot(A[k + 1])
    against = 2.0 * dt[:, None, None] * (change @ at.lin.sigma)
    gradient = np.zeros_like(d)
    gradient[:-1] = np.einsum("kac,kaci->ki", against, d_sigma)[1:]
    return gradient

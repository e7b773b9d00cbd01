"""Second derivatives of the Lagrangian along a trajectory, by differences of first ones.

The conditions of :mod:`.maximum_principle` are separable in the nodes, so shifting one component
of x (or u) at all nodes at once gives a column of every node's Hessian. The shifted copies of
the trajectory are strung together into one long one, and the model is called once for all.

Central differences of exact gradients leave a relative error of 1e-10. In a Newton matrix that
is as good as none: it changes how fast the last digits come, not where they end. And they ask
nothing of the model: not that it can be traced, nor that it is smooth.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.extremal.maximum_principle import FirstOrder, first_order
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: The cube root of the machine epsilon balances truncation and rounding.
_STEP = 6e-6


@dataclasses.dataclass(frozen=True)
class SecondOrder:
    """Hessian blocks of the Lagrangian, Λ of the variance penalty and the slopes of φ held."""

    xx: Array  # nodes 1..K, (K, n, n)
    ux: Array  # nodes 0..K−1, (K, m, n)
    uu: Array  # (K, m, m)
    A_x: Array  # ∂A_k/∂x_k, (K, n, n, n), last axis the state that is differentiated
    A_u: Array  # ∂A_k/∂u_k, (K, n, n, m)


def second_order(
    model: Model, here: FirstOrder, adjoint: Array, terminal: Array, variance_weight: float
) -> SecondOrder:
    """Hessians at a trajectory with λ_1..λ_K (K, n) and ν (q,)."""
    x, u = here.lin.x, here.lin.u
    (N, n), K = x.shape, len(u)
    steps = np.diag(_STEP * (1.0 + np.concatenate([np.abs(z).max(axis=0) for z in (x, u)])))
    if model.integrator == "euler":  # affine in u, as the drift is: nothing to be learnt there
        steps = steps[:n]
    shifts = np.concatenate([steps, -steps])

    def strung(values: Array) -> Array:
        """Of every interval, (K, ...), once for each copy, an interval of no length between."""
        whole = np.concatenate([values, np.zeros_like(values[:1])])
        return np.concatenate([whole] * len(shifts))[:-1]

    def parts(values: Array) -> Array:
        """The other way round: (copies · N − 1, ...) -> (copies, K, ...)."""
        whole = np.concatenate([values, values[-1:]])
        return whole.reshape(len(shifts), N, *values.shape[1:])[:, :K]

    def derivatives(values: Array) -> Array:
        """By the components that copies shift, as a last axis, from (copies, ...)."""
        ahead, back = values[: len(steps)], values[len(steps) :]
        return np.moveaxis(ahead - back, 0, -1) * (0.5 / steps.diagonal())

    chain = dataclasses.replace(model, times=np.tile(model.times, len(shifts)), dt=strung(model.dt))
    X = x + shifts[:, None, :n]
    U = strung(u) + np.repeat(shifts[:, n:], N, axis=0)[:-1]
    weights = None if here.weights is None else strung(here.weights)
    at = first_order(chain, X.reshape(-1, n), U, variance_weight, weights)
    A, B = parts(at.lin.A), parts(at.lin.B)
    # Nodes 1..K; the hinges' own square stays out: its pieces are for the Newton step to choose.
    by_state = parts(at.sub.q) + np.einsum("kp,ckpn->ckn", here.push, parts(at.sub.a))
    by_state[:, :-1] += np.einsum("kj,ckji->cki", adjoint[1:], A[:, 1:])
    G = np.asarray(model.terminal_jacobian(X[:, -1]))
    by_state[:, -1] += np.einsum("q,cqi->ci", terminal, G)
    by_control = derivatives(parts(at.sub.r) + np.einsum("kj,ckji->cki", adjoint, B))
    xx = derivatives(by_state)[..., :n]
    uu = by_control[..., n:] if len(steps) > n else here.sub.R
    return SecondOrder(
        xx=0.5 * (xx + xx.swapaxes(1, 2)),
        ux=by_control[..., :n],
        uu=0.5 * (uu + uu.swapaxes(1, 2)),
        A_x=derivatives(A)[..., :n],
        A_u=derivatives(B)[..., :n].swapaxes(-1, -2),  # ∂²F/∂x∂u, either way round
    )

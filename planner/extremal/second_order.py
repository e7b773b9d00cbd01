"""Second derivatives of the Lagrangian along a trajectory, by differences of first ones.

The conditions of :mod:`.maximum_principle` are separable in the nodes, so shifting one component
of x (or u) at all nodes at once gives a column of every node's Hessian. The shifted copies of
the trajectory are strung together into one long one, and the model is called once for all.

Central differences of exact gradients leave a relative error of 1e-10. In a Newton matrix that
is as good as none: it changes how fast the last digits come, not where they end. And they ask
nothing of the model: not that its Jacobians let complex arrays pass, nor that it is smooth.
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
    """Hessian blocks of the Lagrangian, Λ of the variance penalty and the slopes of φ held.

    Attributes:
        xx: nodes 1..K, (K, n, n).
        ux: at nodes 0..K−1, (K, m, n).
        uu: (K, m, m).
        A_x: ∂A_k/∂x_k, (K, n, n, n), last axis the state that is differentiated.
        A_u: ∂A_k/∂u_k, (K, n, n, m).
    """

    xx: Array
    ux: Array
    uu: Array
    A_x: Array
    A_u: Array


def second_order(
    model: Model,
    here: FirstOrder,
    adjoint: Array,
    terminal: Array,
    variance_weight: float,
) -> SecondOrder:
    """Hessians at a trajectory with λ_1..λ_K (K, n) and ν (q,)."""
    x, u, weights, push = here.lin.x, here.lin.u, here.weights, here.push
    (N, n), (K, m) = x.shape, u.shape
    # Euler's step is affine in u, as the drift is: nothing to be learnt by shifting it.
    moved = 0 if model.integrator == "euler" else m
    steps = _STEP * (1.0 + np.concatenate([np.abs(x).max(axis=0), np.abs(u).max(axis=0)]))
    copies = 2 * (n + moved)
    X = np.broadcast_to(x, (copies, N, n)).copy()
    U = np.zeros((copies, N, m))  # a filler after each copy's last control
    U[:, :K] = u
    for i in range(n):
        X[2 * i, :, i] += steps[i]
        X[2 * i + 1, :, i] -= steps[i]
    for j in range(n, n + moved):
        U[2 * j, :K, j - n] += steps[j]
        U[2 * j + 1, :K, j - n] -= steps[j]
    if weights is not None:
        repeated = np.zeros((copies, N, n, n))
        repeated[:, :K] = weights
        weights = repeated.reshape(-1, n, n)[:-1]
    filler = model.dt[-1:]
    chain = dataclasses.replace(
        model,
        times=np.tile(model.times, copies),
        dt=np.tile(np.concatenate([model.dt, filler]), copies)[:-1],
    )
    u = U.reshape(-1, m)[:-1]
    at = first_order(chain, X.reshape(-1, n), u, variance_weight, weights)

    def parts(values: Array) -> Array:
        """(copies · N − 1, ...) -> (copies, K, ...)."""
        whole = np.concatenate([values, values[-1:]])
        return whole.reshape(copies, N, *values.shape[1:])[:, :K]

    A, B = parts(at.lin.A), parts(at.lin.B)
    # Nodes 1..K; the hinges' own square stays out: its pieces are for the Newton step to choose.
    by_state = parts(at.sub.q) + np.einsum("kp,ckpn->ckn", push, parts(at.sub.a))
    by_state[:, :-1] += np.einsum("kj,ckji->cki", adjoint[1:], A[:, 1:])
    G = np.asarray(model.terminal_jacobian(X[:, -1]))
    by_state[:, -1] += np.einsum("q,cqi->ci", terminal, G)
    by_control = parts(at.sub.r) + np.einsum("kj,ckji->cki", adjoint, B)

    def derivative(values: Array, begin: int, count: int) -> Array:
        """Differences over the copies that shift these components, as a last axis."""
        chosen = values[2 * begin : 2 * (begin + count)]
        scale = 0.5 / steps[begin : begin + count]
        return np.moveaxis(chosen[::2] - chosen[1::2], 0, -1) * scale

    xx = derivative(by_state, 0, n)
    uu = derivative(by_control, n, m) if moved else here.sub.R
    return SecondOrder(
        xx=0.5 * (xx + xx.swapaxes(1, 2)),
        ux=derivative(by_control, 0, n),
        uu=0.5 * (uu + uu.swapaxes(1, 2)),
        A_x=derivative(A, 0, n),
        A_u=derivative(B, 0, n).swapaxes(-1, -2),  # ∂²F/∂x∂u, either way round
    )

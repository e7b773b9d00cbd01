"""One node of the covariance, the gains and the weights of the noise: the equations of a belief.

With rows' derivatives by variance η and J the quadratic in deviations that follows from them,

    Σ_{k+1} = (A + BK)_k Σ_k (A + BK)_kᵀ + dt (σ_k σ_kᵀ + Σ_d σ′_kd Σ_k σ′_kdᵀ)
    K_k = −(dt R + BᵀP_{k+1}B)⁻¹ BᵀP_{k+1}A                                 (K = 0 in open loop)
    P_k = D_k + K_kᵀ dt R K_k + (A + BK)_kᵀ P_{k+1} (A + BK)_k + dt Σ_d σ′_kdᵀ P_{k+1} σ′_kd

(column d of σ linearised, σ_d + σ′_d δx) the expected cost is that of the mean plus
Σ_k dt tr(P_{k+1} σ_k σ_kᵀ) + tr(P_0 Σ_0), for D what deviations at a node cost (paper §6.2). Arrays
of numbers and of expressions alike; shapes are those of one node: Σ, P, A (n, n), B (n, m),
σ (n, d), σ′ (n, d, n), K (m, n).
"""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray


def covariance_step(A: Array, S: Array, sigma: Array, d_sigma: Array | None, dt: Any) -> Array:
    """Σ at the next node; A is the closed loop's under feedback. None for σ′ is zero."""
    noise = sigma.dot(sigma.T)
    if d_sigma is not None:
        for a in range(sigma.shape[1]):
            noise = noise + d_sigma[:, a].dot(S).dot(d_sigma[:, a].T)
    return A.dot(S).dot(A.T) + dt * noise


def congruence(A: Array, P: Array) -> Array:
    """AᵀPA."""
    return A.T.dot(P).dot(A)


def gain(A: Array, B: Array, P: Array, R: Array) -> Array:
    """K = −(R + BᵀPB)⁻¹ BᵀPA, by Gauss–Jordan: R + BᵀPB is positive definite; R is dt R here."""
    m = B.shape[1]
    BP = B.T.dot(P)
    T = np.concatenate([R + BP.dot(B), BP.dot(A)], axis=1)
    for i in range(m):
        row = T[i] / T[i, i]
        T = T - T[:, i, None] * row
        T[i] = row
    return -T[:, m:]


def weight_step(
    A: Array, B: Array, P: Array, K: Array, R: Array, d_sigma: Array | None, dt: Any
) -> Array:
    """P_k − D_k from P_{k+1}; R is dt R here. None for σ′ leaves its term out."""
    closed = A + B.dot(K)
    M = congruence(closed, P) + K.T.dot(R).dot(K)
    if d_sigma is not None:
        for a in range(d_sigma.shape[1]):
            M = M + dt * d_sigma[:, a].T.dot(P).dot(d_sigma[:, a])
    return M


def noise_charge(P: Array, sigma: Array, dt: Any) -> Any:
    """Dt tr(P σσᵀ): what the noise of an interval adds to the cost."""
    return dt * (sigma * P.dot(sigma)).sum()


def noise_model(P: Array, sigma: Array, d_sigma: Array, dt: Any) -> tuple[Array, Array]:
    """Gradient (n,) and Hessian (n, n) of :func:`noise_charge` by the state, σ linear in it."""
    weighted, n = P.dot(sigma), d_sigma.shape[2]
    gradient = sum(
        (d_sigma[:, a].T.dot(weighted[:, a]) for a in range(sigma.shape[1])), start=np.zeros(n)
    )
    hessian = sum(
        (d_sigma[:, a].T.dot(P).dot(d_sigma[:, a]) for a in range(sigma.shape[1])),
        start=np.zeros((n, n)),
    )
    return 2.0 * dt * gradient, 2.0 * dt * hessian

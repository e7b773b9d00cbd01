"""Mean and covariance of the linearised process (paper §6.2, SPEC §3.2).

    Σ_{k+1} = A_k Σ_k A_kᵀ + dt σ_k σ_kᵀ,   Σ_0 = 0,   A_k = I + dt ∂b/∂x

which is exact for the discretised linear system and positive semidefinite by construction.

The penalty w ∫ tr Σ dt = w Σ_{k=1}^{N−1} dt tr Σ_k needs no Σ in the sub-problem. With the
adjoint weights

    Λ_{N−1} = dt I,   Λ_k = dt I + A_kᵀ Λ_{k+1} A_k     (dt of the interval that ends there)

it equals w Σ_k dt tr(Λ_{k+1} σ_k σ_kᵀ). With σ linearised, σ_k + σ_k′ d, as the linear SDE of
LOCP has it, this is a convex quadratic in the deviation d of each node: one backward sweep,
no variable added, and nothing approximated. (The paper replaces σσᵀ by C(z_k)C(z)ᵀ to keep Σ
affine; the value and the gradient at the iterate are those of the quadratic up to a factor 2
in the gradient, which we keep right. The quadratic converges for weights where the affine
model oscillates.)
"""

from __future__ import annotations

import dataclasses

import numpy as np

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Variance:
    """w ∫ tr Σ dt of the linear SDE: value + gradient·d + ½ d·hessian·d, node by node.

    Attributes:
        value: the integral times w at the iterate.
        gradient: with respect to the states at nodes 0..K−1, (K, n).
        hessian: positive semidefinite, (K, n, n).
    """

    value: float
    gradient: Array
    hessian: Array


def covariance(A: Array, sigma: Array, dt: Array) -> Array:
    """Σ at every node.

    Args:
        A: discrete state matrices, (K, n, n).
        sigma: diffusion at nodes 0..K−1, (K, n, d).
        dt: interval lengths, (K,) [s].

    Returns:
        (K + 1, n, n); the first is zero (the start is known).
    """
    K, n = A.shape[:2]
    noise = dt[:, None, None] * (sigma @ sigma.swapaxes(1, 2))
    S = np.zeros((K + 1, n, n))
    for k in range(K):
        S[k + 1] = A[k].dot(S[k]).dot(A[k].T) + noise[k]
    return S


def trace_integral(S: Array, dt: Array) -> float:
    """∫ tr Σ dt = Σ_{k=1}^{N−1} dt tr Σ_k (right end points, as for the obstacle cost)."""
    return float(np.einsum("k,kii", dt, S[1:]))


def adjoint_weights(A: Array, dt: Array) -> Array:
    """Λ_1..Λ_K, (K, n, n): what noise injected on arrival at node k+1 adds to ∫ tr Σ."""
    K, n = A.shape[:2]
    eye = np.eye(n)
    L = np.empty((K, n, n))
    L[K - 1] = dt[K - 1] * eye
    for k in range(K - 2, -1, -1):
        L[k] = dt[k] * eye + A[k + 1].T.dot(L[k + 1]).dot(A[k + 1])
    return L


def variance_penalty(
    weight: float, sigma: Array, d_sigma: Array, Lambda: Array, dt: Array
) -> Variance:
    """Return w ∫ tr Σ dt as a convex quadratic in the deviations, A held (it belongs to LOCP).

    Args:
        weight: w ≥ 0.
        sigma: (K, n, d).
        d_sigma: ∂σ/∂x, (K, n, d, n).
        Lambda: from :func:`adjoint_weights`, (K, n, n).
        dt: (K,).
    """
    K, n, d = sigma.shape
    weighted = (weight * dt)[:, None, None] * Lambda  # (K, n, n)
    against = weighted @ sigma
    flat = d_sigma.reshape(K, n, d * n)
    curved = (weighted @ flat).reshape(K, n * d, n)
    tall = d_sigma.reshape(K, n * d, n)
    return Variance(
        value=float(np.vdot(against, sigma)),
        gradient=2.0 * np.matmul(against.reshape(K, 1, n * d), tall)[:, 0],
        hessian=2.0 * np.matmul(tall.swapaxes(1, 2), curved),
    )


def trust_region_weight(hessian: Array, dt: Array) -> Array:
    """Hessian of ∫ E‖x − x_k‖² dt = ∫ ‖μᵉ‖² + tr Σᵉ dt at nodes 1..K, (K, n, n).

    Both paths see the same Brownian motion, so to first order the error's diffusion is
    σ′ (x − x_k): ∫ tr Σᵉ is the quadratic part of the variance penalty with weight one
    (SPEC §3.4).

    Args:
        hessian: of the variance penalty with weight one at nodes 0..K−1, (K, n, n).
        dt: (K,).
    """
    W = 2.0 * dt[:, None, None] * np.eye(hessian.shape[1])
    W[:-1] += hessian[1:]
    return W

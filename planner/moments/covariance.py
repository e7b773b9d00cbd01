"""Mean and covariance of the linearised process (paper §6.2).

    Σ_{k+1} = A_k Σ_k A_kᵀ + dt (σ_k σ_kᵀ + Σ_d σ′_kd Σ_k σ′_kdᵀ),   A_k = I + dt ∂b/∂x

from the Σ_0 of the problem's start, zero where it is known: exact for the discretised linear
system, and positive semidefinite by construction. σ′_d is the derivative of column d of σ; its
term vanishes where σ depends on certain states alone, the paper's class (§6.1).

The penalty w ∫ tr Σ dt = w Σ_{k=1}^{N−1} dt tr Σ_k needs no Σ in the sub-problem. With the
adjoint weights

    Λ_{N−1} = dt I,   Λ_k = dt I + A_kᵀ Λ_{k+1} A_k     (dt of the interval that ends there)

it equals w Σ_k dt tr(Λ_{k+1} σ_k σ_kᵀ) + w tr(A_0ᵀ Λ_1 A_0 Σ_0), in the paper's class; the
second part is the same at every deviation. With σ linearised, σ_k + σ_k′ d, as the linear SDE of
LOCP has it, this is a convex quadratic in the deviation d of each node: one backward sweep,
no variable added, and nothing approximated. (The paper replaces σσᵀ by C(z_k)C(z)ᵀ to keep Σ
affine; the value and the gradient at the iterate are those of the quadratic up to a factor 2
in the gradient, which we keep right. The quadratic converges for weights where the affine
model oscillates.)
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.moments.propagation import congruence, covariance_step
from slipcar.planner.problem.linearization import Linearization
from slipcar.planner.problem.model import Model

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Variance:
    """w ∫ tr Σ dt of the linear SDE: value + gradient·d + ½ d·hessian·d, node by node.

    Attributes:
        value: what the noise adds to it at the iterate; all of it where the start is known.
        gradient: with respect to the states at nodes 0..K−1, (K, n).
        hessian: positive semidefinite, (K, n, n).
        weights: w dt Λ_{k+1} of node k, held in steps as A is, (K, n, n).
        start: what the start's covariance adds to it, held in steps as A is.
    """

    value: float
    gradient: Array
    hessian: Array
    weights: Array
    start: float = 0.0

    def at(self, sigma: Array) -> float:
        """What another diffusion (K, n, d) adds to it, by the same weights."""
        return float(np.vdot(self.weights @ sigma, sigma))

    @property
    def total(self) -> float:
        """All of w ∫ tr Σ dt."""
        return self.value + self.start


def covariance(
    A: Array,
    sigma: Array,
    dt: Array,
    *,
    start: Array | None = None,
    d_sigma: Array | None = None,
) -> Array:
    """Σ at every node.

    Args:
        A: discrete state matrices, (K, n, n); those of the closed loop under feedback.
        sigma: diffusion at nodes 0..K−1, (K, n, d).
        dt: interval lengths, (K,) [s].
        start: Σ_0, (n, n); None is zero.
        d_sigma: ∂σ/∂x, (K, n, d, n), where σ may depend on uncertain states; None is zero.

    Returns:
        (K + 1, n, n); the first is Σ_0.
    """
    K, n = A.shape[:2]
    S = np.zeros((K + 1, n, n))
    if start is not None:
        S[0] = start
    moves = d_sigma is not None and d_sigma.any()
    for k in range(K):
        slope = d_sigma[k] if moves else None  # type: ignore[index]
        S[k + 1] = covariance_step(A[k], S[k], sigma[k], slope, dt[k])
    return S


def covariance_of(model: Model, lin: Linearization) -> Array:
    """Σ at every node along a linearisation, in open loop: (N, n, n)."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # of plans that failed
        d_sigma = np.asarray(model.diffusion_jacobian(model.times[:-1], lin.x[:-1]))
        start = model.start_covariance
        return covariance(lin.A, lin.sigma, model.dt, start=start, d_sigma=d_sigma)


def trace_integral(S: Array, dt: Array) -> float:
    """∫ tr Σ dt = Σ_{k=1}^{N−1} dt tr Σ_k (right end points, as for the obstacle cost)."""
    return float(np.einsum("k,kii", dt, S[1:]))


def adjoint_weights(A: Array, dt: Array, metric: Array | None = None) -> Array:
    """Λ_1..Λ_K, (K, n, n): what noise injected on arrival at node k+1 adds to ∫ tr Σ.

    A `metric` (n,) weighs the variances in the trace; None is ones.
    """
    K, n = A.shape[:2]
    M, L = np.eye(n) if metric is None else np.diag(metric), np.empty((K, n, n))
    L[K - 1] = dt[K - 1] * M
    for k in range(K - 2, -1, -1):
        L[k] = dt[k] * M + congruence(A[k + 1], L[k + 1])
    return L


def start_share(A: Array, Lambda: Array, start: Array) -> float:
    """What the start's covariance (n, n) adds to ∫ tr Σ dt; A and Λ along the path, (K, n, n)."""
    return float(np.vdot(A[0].T @ Lambda[0] @ A[0], start)) if start.any() else 0.0


def variance_penalty(
    weight: float, sigma: Array, d_sigma: Array, Lambda: Array, dt: Array, start: float = 0.0
) -> Variance:
    """Return w ∫ tr Σ dt as a convex quadratic in the deviations, A held (it belongs to LOCP).

    Args:
        weight: w ≥ 0.
        sigma: (K, n, d).
        d_sigma: ∂σ/∂x, (K, n, d, n).
        Lambda: from :func:`adjoint_weights`, (K, n, n).
        dt: (K,).
        start: from :func:`start_share`.
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
        weights=weighted,
        start=weight * start,
    )


def trust_region_weight(hessian: Array, dt: Array) -> Array:
    """Hessian of ∫ E‖x − x_k‖² dt = ∫ ‖μᵉ‖² + tr Σᵉ dt at nodes 1..K, (K, n, n).

    Both paths begin alike and see the same Brownian motion, so to first order the error's
    diffusion is σ′ (x − x_k): ∫ tr Σᵉ is the quadratic part of the variance penalty with weight
    one.

    Args:
        hessian: of the variance penalty with weight one at nodes 0..K−1, (K, n, n).
        dt: (K,).
    """
    W = 2.0 * dt[:, None, None] * np.eye(hessian.shape[1])
    W[:-1] += hessian[1:]
    return W

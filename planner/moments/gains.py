"""Time-varying LQR around a plan: gains that turn deviations from the mean into controls."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from slipcar.planner.moments.covariance import covariance
from slipcar.planner.moments.propagation import gain, weight_step
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: Weights on deviations from the mean for a five-state car, the default when the plan has
#: five states; otherwise the identity.
_TRACKING = (10.0, 10.0, 1.0, 1.0, 1.0)


def lqr_gains(A: Array, B: Array, dt: Array, Q: Array, R: Array, Qf: Array) -> Array:
    """Gains of min Σ dt (δxᵀQδx + δuᵀRδu) + δx_NᵀQf δx_N along δx⁺ = A δx + B δu.

    The backward Riccati recursion in Joseph's form, which keeps the cost to go symmetric
    positive semidefinite.

    Args:
        A: (K, n, n).
        B: (K, n, m).
        dt: interval lengths, (K,) [s].
        Q: (n, n), positive semidefinite; charged at nodes 1..K−1.
        R: (m, m), positive definite.
        Qf: (n, n), positive semidefinite.

    Returns:
        K with δu = K δx, (K, m, n).
    """
    K = np.empty((len(A), B.shape[2], A.shape[1]))
    P = Qf
    for k in range(len(A) - 1, -1, -1):
        K[k] = gain(A[k], B[k], P, dt[k] * R)
        P = weight_step(A[k], B[k], P, K[k], dt[k] * R, None, dt[k]) + (dt[k] * Q if k else 0.0)
    return K


def closed_loop_covariance(
    model: Model, times: Array, mean: Array, A: Array, B: Array, gains: Array, *, start: Array
) -> Array:
    """Σ along a plan that is followed with its gains; see :mod:`.moments`.

    Args:
        model: whose noise it is.
        times: nodes, (N,) [s].
        mean: (N, n).
        A: ∂x⁺/∂x along it, (N−1, n, n).
        B: ∂x⁺/∂u, (N−1, n, m).
        gains: K, (N−1, m, n).
        start: Σ at the first node, (n, n).

    Returns:
        (N, n, n).
    """
    at = times[:-1], mean[:-1]
    sigma, d_sigma = np.asarray(model.diffusion(*at)), np.asarray(model.diffusion_jacobian(*at))
    return covariance(A + B @ gains, sigma, np.diff(times), start=start, d_sigma=d_sigma)


def feedback_effort(R: Array, dt: Array, gains: Array, S: Array) -> float:
    """Σ dt tr(K Σ Kᵀ R), the effort of the corrections; gains (K, m, n), Σ (N, n, n)."""
    return float(np.vdot(dt[:, None, None] * (R @ gains), gains @ S[:-1]))


def wrap(error: Array, angles: Iterable[int]) -> Array:
    """Deviations (..., n) with their angles in [−π, π], in place: headings are known modulo 2π."""
    for i in angles:
        error[..., i] -= 2.0 * np.pi * np.round(error[..., i] / (2.0 * np.pi))
    return error


def weight_matrix(name: str, value: Any, n: int, *, definite: bool = False) -> Array:
    """A scalar, a diagonal (n,) or a matrix (n, n) as a symmetric matrix.

    Raises:
        ValueError: for another shape, a non-finite entry or a matrix that is not positive
            semidefinite (with `definite`: not positive definite).
    """
    try:
        given = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers, not {value!r}") from error
    if given.ndim == 0:
        given = given * np.eye(n)
    elif given.shape == (n,):
        given = np.diag(given)
    if given.shape != (n, n):
        raise ValueError(f"{name} must be a scalar, ({n},) or ({n}, {n}), not {given.shape}")
    symmetric = 0.5 * (given + given.T)  # all that a quadratic form sees
    if np.isfinite(given).all():
        values = np.linalg.eigvalsh(symmetric)
        if values[0] > 0.0 or (not definite and values[0] >= -1e-12 * max(1.0, values[-1])):
            return symmetric
    kind = "definite" if definite else "semidefinite"
    raise ValueError(f"{name} must be finite and positive {kind}, not {value!r}")


def default_tracking(n: int) -> Array:
    """Default Q on deviations, (n, n)."""
    return np.diag(_TRACKING) if n == len(_TRACKING) else np.eye(n)

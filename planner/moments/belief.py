"""Covariance, gains and adjoint weights along an iterate.

With rows' derivatives by variance η and J the quadratic in deviations that follows from them,

    Σ_{k+1} = (A + BK)_k Σ_k (A + BK)_kᵀ + dt (σ_k σ_kᵀ + Σ_d σ′_kd Σ_k σ′_kdᵀ)
    P_k = D_k + K_kᵀ dt R K_k + (A + BK)_kᵀ P_{k+1} (A + BK)_k + dt Σ_d σ′_kdᵀ P_{k+1} σ′_kd
    D_k = dt w I + ½ dt H_xx + Σ_o η_ko C_ko C_koᵀ,   D_N with GᵀWG
    K_k = −(dt R + BᵀP_{k+1}B)⁻¹ BᵀP_{k+1}A            (K = 0 in open loop)

(column d of σ linearised, σ_d + σ′_d δx: under feedback the states it depends on are noisy too)
the expected cost is that of the mean plus Σ_k dt tr(P_{k+1} σ_k σ_kᵀ), and P is its derivative by
the noise that arrives at a node. (The Σ_0 of an uncertain start adds tr(P_0 Σ_0), with P_0 by the
same recursion and D_0 = 0: no part of a step, in which A, B and K are held.) Rows are Gaussian with
the expectation c(μ) + ½ tr(∂²c Σ) and the deviation s = (C Σ Cᵀ)^½: a path past a disc keeps more
distance than its mean does.

Held while a step is computed, P makes the noise a cost of the deterministic states σ depends on:
the sensitivity of every later Σ is in it. That η and K would follow is of second order at a
solution, where K is optimal. What is neglected is how ∂b/∂x, σ′, C and ½ tr(∂²c Σ) follow.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.moments import covariance as moments
from slipcar.planner.moments.losses import Loss, deviations, loss
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.functions import Functions
from slipcar.planner.newton.model import Iterate
from slipcar.planner.problem.linearization import nearest_semidefinite
from slipcar.planner.problem.model import Model

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Belief:
    """What is held while a step is computed.

    Attributes:
        covariance: Σ, (N, n, n).
        gains: K, (K, m, n); zeros in open loop.
        held: rows' derivatives by variance that P was computed with, (K, p).
        offset: ½ tr(∂²c Σ), what rows' expectations have beyond their values at the mean, (K, p).
        s: rows' standard deviations, (K, p).
        P: at nodes 1..K, (K, n, n).
        noise: Σ dt tr(P σσᵀ) as a quadratic in the states.
        lower: control bounds less what the feedback needs, (K, m).
        upper: (K, m).
    """

    covariance: Array
    gains: Array
    held: Array
    offset: Array
    s: Array
    P: Array
    noise: moments.Variance
    lower: Array
    upper: Array


def row_weight(model: Model, stakes: Stakes) -> Array:
    """Weight of each row at each node, (K, p): penalties are charged per second."""
    return stakes.weight * np.where(stakes.tail, 1.0, model.dt[:, None])


def loss_at(model: Model, stakes: Stakes, c: Array, s: Array) -> Loss:
    """Losses of all rows at nodes 1..K, from their expectations and deviations."""
    return loss(c, s, row_weight(model, stakes), stakes.tail)


def propagate(
    model: Model,
    functions: Functions,
    at: Iterate,
    stakes: Stakes,
    gains: Array,
    held: Array | None,
    damping: float,
) -> Belief:
    """What follows at an iterate from the gains (K, m, n) and row weights (K, p) before.

    The weights of the rows change by the factor that they ask for to the power of `damping`: tails
    are exponential, and the whole change would overshoot.
    """
    lin = at.lin
    S = _covariance(model, at, gains)
    bend = _row_hessians(model, functions, at)
    offset, s = _expectations(bend, S), deviations(lin.C, S[1:])
    wanted = loss_at(model, stakes, lin.c + offset, s).by_variance
    if held is None or damping == 1.0:
        held = wanted
    else:
        least = 1e-9 * float(np.max(wanted, initial=0.0)) + 1e-30
        mixed = np.maximum(held, least) ** (1.0 - damping) * np.maximum(wanted, least) ** damping
        held = np.where(stakes.tail, mixed, wanted)
    P, gains = _weights(model, at, stakes, held)
    if stakes.feedback:
        S = _covariance(model, at, gains)
        offset, s = _expectations(bend, S), deviations(lin.C, S[1:])
    noise = moments.variance_penalty(1.0, lin.sigma, at.d_sigma, P, model.dt)
    spread = np.sqrt(np.maximum(np.einsum("kmi,kij,kmj->km", gains, S[:-1], gains), 0.0))
    room = 0.45 * (model.upper - model.lower)
    margin = np.minimum(stakes.saturation * spread, room)
    return Belief(S, gains, held, offset, s, P, noise, model.lower + margin, model.upper - margin)


def feedback_effort(model: Model, gains: Array, S: Array) -> float:
    """Σ dt tr(K Σ Kᵀ R)."""
    return float(np.einsum("k,kmi,kij,klj,lm", model.dt, gains, S[:-1], gains, model.R))


def _row_hessians(model: Model, functions: Functions, at: Iterate) -> Array:
    """∂²c/∂x² of every row at nodes 1..K, (p, K, n, n)."""
    (K, p), n = at.lin.c.shape, at.lin.x.shape[1]
    bend = np.zeros((p, K, n, n))
    for o in range(p):
        only = np.zeros((K, p))
        only[:, o] = 1.0
        found = functions.node_hessian(t=model.times[1:], x=at.lin.x[1:], weight=only)
        bend[o] = found["xx"].reshape(K, n, n)
    return bend


def _expectations(bend: Array, S: Array) -> Array:
    """½ tr(∂²c Σ) from Hessians (p, K, n, n) and Σ (N, n, n): (K, p)."""
    return 0.5 * np.einsum("pkij,kij->kp", bend, S[1:])


def _covariance(model: Model, at: Iterate, gains: Array) -> Array:
    lin = at.lin
    closed, start = lin.A + lin.B @ gains, model.start_covariance
    return moments.covariance(closed, lin.sigma, model.dt, start=start, d_sigma=at.d_sigma)


def _weights(model: Model, at: Iterate, stakes: Stakes, held: Array) -> tuple[Array, Array]:
    """P (K, n, n) and the gains (K, m, n) by one backward sweep."""
    lin, dt = at.lin, model.dt
    K, n = lin.defect.shape
    D = np.einsum("kp,kpi,kpj->kij", held, lin.C, lin.C, optimize=True)
    D += (dt * stakes.variance_weight)[:, None, None] * np.eye(n)
    if at.H_xx.any():
        D += 0.5 * dt[:, None, None] * nearest_semidefinite(at.H_xx)
    D[-1] += lin.G.T @ (stakes.terminal[:, None] * lin.G)
    gains = np.zeros((K, lin.u.shape[1], n))
    P = np.empty((K, n, n))
    P[-1] = D[-1]
    by_column = at.d_sigma.swapaxes(1, 2)  # (K, d, n, n)
    for k in range(K - 1, -1, -1):
        A, B = lin.A[k], lin.B[k]
        closed = A
        if stakes.feedback:
            PB = P[k] @ B
            gains[k] = -np.linalg.solve(dt[k] * model.R + B.T @ PB, PB.T @ A)
            closed = A + B @ gains[k]
        if k:
            P[k - 1] = D[k - 1] + closed.T @ P[k] @ closed
            P[k - 1] += dt[k] * (by_column[k].swapaxes(1, 2) @ P[k] @ by_column[k]).sum(axis=0)
            if stakes.feedback:
                P[k - 1] += dt[k] * gains[k].T @ model.R @ gains[k]
    return P, gains

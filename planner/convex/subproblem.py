"""From an iterate to the convex sub-problem LOCP_{k+1} (paper §3.1).

With deviations d_k = μ_k − μ̄_k and e_k = u_k − ū_k, K = N − 1 intervals and d_0 = 0:

    minimise  Σ_{k=0}^{K-1} ½ e_kᵀ R_k e_k + r_kᵀ e_k
            + Σ_{k=1}^{K}   ½ d_kᵀ Q_k d_k + q_kᵀ d_k + ½ Σ_i h_i max(0, a_kiᵀ d_k + b_ki)²
            + ρ Σ_j max(0, |G d_K + g|_j − τ)
    s.t.      d_{k+1} = A_k d_k + B_k e_k + f_k,    lower_k ≤ e_k ≤ upper_k,
              ‖e_k − center_k‖₂ ≤ radius

* f_k is the defect of the iterate: zero once it satisfies the non-linear dynamics.
* The hinge rows are the convex-composite model of L = w max(0, c)²: c is linearised, the
  square of the positive part is kept. The literal scheme linearises L whole: no rows, only q.
* The smooth running costs H(t, x) and ℓ(t, x)ᵀu enter q, r and, with the Hessian of H made
  positive semidefinite, Q.
* The variance penalty w ∫ tr Σ enters Q and q (:mod:`slipcar.planner.moments.covariance`).
* The trust region enters Q with its multiplier (:mod:`.trust_region`).
* The terminal condition is an exact penalty: satisfied exactly whenever its multiplier stays
  below ρ, and every sub-problem is feasible. The remainder is the virtual control.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.moments.covariance import Variance
from slipcar.planner.problem.control_set import project_controls
from slipcar.planner.problem.linearization import Linearization
from slipcar.planner.problem.model import Model

Array = np.ndarray


@dataclasses.dataclass(frozen=True)
class Subproblem:
    """The convex sub-problem as arrays; the module's docstring names them.

    Attributes:
        A: (K, n, n).
        B: (K, n, m).
        f: (K, n).
        Q: node k+1 in row k, (K, n, n), positive semidefinite.
        q: (K, n).
        R: (K, m, m), positive definite.
        r: (K, m).
        a: hinge rows, (K, p, n).
        b: (K, p).
        h: hinge weights, (K, p), ≥ 0.
        G: (q, n).
        g: (q,).
        rho: ρ > 0.
        tolerance: τ ≥ 0; 0 asks for equality.
        lower: (K, m), −inf where unbounded.
        upper: (K, m).
        center: centres −ū_k of the balls of controls, (K, m).
        radius: theirs, inf where there are none.
    """

    A: Array
    B: Array
    f: Array
    Q: Array
    q: Array
    R: Array
    r: Array
    a: Array
    b: Array
    h: Array
    G: Array
    g: Array
    rho: float
    tolerance: float
    lower: Array
    upper: Array
    center: Array
    radius: float

    def hinge_arguments(self, d: Array) -> Array:
        """Linearised c at nodes 1..K, (K, p)."""
        return np.matmul(self.a, d[..., None])[..., 0] + self.b

    def objective(self, d: Array, e: Array) -> float:
        """Value at deviations d (K, n) of nodes 1..K and e (K, m)."""
        return self.cost(d, e) + self.rho * self.virtual_control(d)

    def cost(self, d: Array, e: Array) -> float:
        """The same without the terminal penalty."""
        hinge = np.maximum(self.hinge_arguments(d), 0.0)
        value = np.vdot(e, 0.5 * np.matmul(self.R, e[..., None])[..., 0] + self.r)
        value += np.vdot(d, 0.5 * np.matmul(self.Q, d[..., None])[..., 0] + self.q)
        return float(value + 0.5 * np.vdot(self.h, hinge * hinge))

    def response(self, e: Array) -> Array:
        """Deviations of nodes 1..K under control deviations e (K, m): (K, n)."""
        d = np.empty_like(self.f)
        state = np.zeros(self.f.shape[1])
        for k in range(len(d)):
            state = d[k] = self.A[k] @ state + self.B[k] @ e[k] + self.f[k]
        return d

    def virtual_control(self, d: Array) -> float:
        """What the terminal condition lacks, Σ_j max(0, |G d_K + g|_j − τ)."""
        return float(np.maximum(np.abs(self.G @ d[-1] + self.g) - self.tolerance, 0.0).sum())

    @property
    def bounded(self) -> bool:
        """Whether any control bound is finite."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    def admissible(self, e: Array) -> Array:
        """The nearest deviations within bounds and balls, (K, m)."""
        if self.radius == np.inf:
            return np.clip(e, self.lower, self.upper) if self.bounded else e
        low, high = self.lower - self.center, self.upper - self.center
        return project_controls(e - self.center, low, high, self.radius) + self.center


def convexify(
    model: Model,
    at: Linearization,
    *,
    variance: Variance | None,
    composite: bool = True,
    trust_multiplier: float = 0.0,
    trust_weight: Array | None = None,
    rho: float = 1.0,
    tolerance: float = 0.0,
) -> Subproblem:
    """The sub-problem at an iterate.

    Args:
        model: the problem.
        at: its linearisation.
        variance: w ∫ tr Σ there as a quadratic, or None for w = 0.
        composite: keep φ = max(0, ·)² and linearise its argument; otherwise linearise L.
        trust_multiplier: weight of ∫ E‖x − x_k‖² (−p¹ of the paper), ≥ 0.
        trust_weight: Hessian blocks of that integral, (K, n, n); needed if the weight is > 0.
        rho: weight of the exact terminal penalty.
        tolerance: half-width of the terminal box, 0 for equality.
    """
    K, n = at.defect.shape
    two_dt = 2.0 * model.dt
    R = two_dt[:, None, None] * model.R
    r = np.matmul(R, at.u[..., None])[..., 0]
    q, Q = np.zeros((K, n)), np.zeros((K, n, n))
    if variance is not None:
        # σ at the last node drives nothing; node 0 is fixed.
        q[:-1] += variance.gradient[1:]
        Q[:-1] += variance.hessian[1:]
    if at.q_running is not None:
        q += at.q_running
    if at.Q_running is not None:
        Q += at.Q_running
    if at.r_running is not None:
        r += at.r_running
    if trust_multiplier > 0.0 and trust_weight is not None:
        Q += trust_multiplier * trust_weight
    a, b, h = at.C, at.c, two_dt[:, None] * model.weight
    if not composite:
        q += np.matmul((h * np.maximum(b, 0.0))[:, None], a)[:, 0]
        a, b, h = a[:, :0], b[:, :0], h[:, :0]
    lower, upper = model.lower - at.u, model.upper - at.u
    return Subproblem(
        at.A, at.B, at.defect, Q, q, R, r, a, b, h, at.G, at.g, rho, tolerance,
        lower, upper, center=-at.u, radius=model.radius,
    )  # fmt: skip

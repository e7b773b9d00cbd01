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
  positive semidefinite, Q; the variance penalty w ∫ tr Σ enters Q and q
  (:mod:`slipcar.planner.moments.covariance`), the trust region Q (:mod:`.trust_region`).
* The terminal condition is an exact penalty: satisfied exactly whenever its multiplier stays
  below ρ, and every sub-problem is feasible. The remainder is the virtual control.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from slipcar.planner.moments import covariance as moments
from slipcar.planner.problem.control_set import project_controls
from slipcar.planner.problem.linearization import Linearization
from slipcar.planner.problem.model import Model

Array = np.ndarray


class Pieces(NamedTuple):
    """Which piece every kink of a sub-problem is on."""

    hinge: Array  # hinges that push, (K, p) bool
    terminal: Array  # (q,): 0 inside the box, ±1 held at its side, ±2 multiplier at ±ρ
    lower: Array  # controls held at their bounds, (K, m) bool
    upper: Array
    on: Array  # controls held on spheres, (K,) bool
    turn: Array  # directions t in which spheres are touched, (K, m); zero where off
    press: Array  # multipliers μ ≥ 0 of spheres, (K,)
    hold: bool = False  # whether any control is held

    def same_as(self, other: Pieces) -> bool:
        """Whether all are on the same pieces, and spheres touched alike."""
        masks = zip(self[:5], other[:5], strict=True)
        return all(a is b or bool((a == b).all()) for a, b in masks) and bool(
            self.turn is other.turn
            or (
                np.abs(self.turn - other.turn).max() <= 1e-9
                and np.abs(self.press - other.press).max() <= 1e-6 * (1.0 + self.press.max())
            )
        )


@dataclasses.dataclass(frozen=True)
class Subproblem:
    """The convex sub-problem as arrays; the module's docstring names them.

    Attributes:
        A, B, f: dynamics, (K, n, n), (K, n, m), (K, n).
        Q, q: costs of node k + 1 in row k, (K, n, n) positive semidefinite, (K, n).
        R, r: costs of controls, (K, m, m) positive definite, (K, m).
        a, b, h: hinge rows, (K, p, n), (K, p), and their weights ≥ 0, (K, p).
        G, g: terminal condition, (q, n), (q,).
        rho, tolerance: ρ > 0; τ ≥ 0, of which 0 asks for equality.
        lower, upper: bounds, (K, m), infinite where there are none.
        center, radius: of the balls of controls, −ū_k, (K, m); inf where there are none.
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
        hinge = np.maximum(self.hinge_arguments(d), 0.0)
        value = np.vdot(e, 0.5 * np.matmul(self.R, e[..., None])[..., 0] + self.r)
        value += np.vdot(d, 0.5 * np.matmul(self.Q, d[..., None])[..., 0] + self.q)
        value += 0.5 * np.vdot(self.h, hinge * hinge)
        return float(value) + self.rho * self.virtual_control(d)

    def slope(self, adjoint: Array, e: Array | None = None) -> Array:
        """Gradient by the controls at e (None is 0), R e + r + Bᵀλ for λ_1..λ_K (K, n): (K, m)."""
        slope = self.r + np.matmul(adjoint[:, None], self.B)[:, 0]
        return slope if e is None else slope + np.matmul(self.R, e[..., None])[..., 0]

    def adjoint_residual(self, d: Array, adjoint: Array, terminal: Array) -> float:
        """How far λ_1..λ_K (K, n) and ν are off the adjoint equation at d, beside the largest λ."""
        push = self.h * np.maximum(self.hinge_arguments(d), 0.0)
        force = np.matmul(self.Q, d[..., None])[..., 0] + self.q - adjoint
        force += np.matmul(push[:, None], self.a)[:, 0]
        force[:-1] += np.matmul(adjoint[1:, None], self.A[1:])[:, 0]
        force[-1] += self.G.T @ terminal
        return float(np.abs(force).max()) / (1.0 + float(np.abs(adjoint).max()))

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

    @property
    def limited(self) -> bool:
        """Whether controls have any limits."""
        return self.radius < np.inf or self.bounded

    def strictly_inside(self, e: Array) -> bool:
        """Whether no control is at its limits."""
        box, ball = ((self.lower < e) & (e < self.upper)).all(), self.radius == np.inf
        return bool(box and (ball or (np.linalg.norm(e - self.center, axis=1) < self.radius).all()))

    def admissible(self, e: Array) -> Array:
        """The nearest deviations within bounds and balls, (K, m)."""
        if self.radius == np.inf:
            return np.clip(e, self.lower, self.upper) if self.bounded else e
        return self._nearest(e - self.center) + self.center

    def _nearest(self, u: Array) -> Array:
        """The same for controls u themselves."""
        if not self.bounded:
            size = np.linalg.norm(u, axis=1, keepdims=True)
            return u * (self.radius / np.maximum(size, self.radius))
        return project_controls(u, self.lower - self.center, self.upper - self.center, self.radius)

    def wanted(self, e: Array, slope: Array) -> Array:
        """Where −D⁻¹ slope leads from e, (K, m): D is R's diagonal, or one number where balls are.

        Its projection is e exactly where e is optimal.
        """
        D = np.einsum("kii->ki", self.R)
        return e - slope / (D.max(axis=1, keepdims=True) if self.radius < np.inf else D)

    def free(self, hinge: Array, terminal: Array) -> Pieces:
        """These pieces with no control held."""
        off, zeros = np.zeros(self.r.shape, dtype=bool), np.zeros(self.r.shape)
        return Pieces(hinge, terminal, off, off, off[:, 0], zeros, zeros[:, 0])

    def pieces(self, hinge: Array, terminal: Array, e: Array, slope: Array) -> Pieces:
        """These pieces, and where on the boundary of U the projection of :meth:`wanted` lies."""
        u, wanted = e - self.center, self.wanted(e, slope) - self.center
        low, high = self.lower - self.center, self.upper - self.center
        nearest = self._nearest(wanted) if self.radius < np.inf else np.clip(wanted, low, high)
        # What is at one side and wants to the other is released.
        lower, upper = (nearest <= low) & (u < high), (nearest >= high) & (u > low)
        pieces = self.free(hinge, terminal)._replace(lower=lower, upper=upper)
        if self.radius == np.inf:
            return pieces._replace(hold=bool(lower.any() or upper.any()))
        # On a sphere what is free of the box is shrunk by 1 + μ/(r D) to come there.
        free, size = ~(lower | upper), np.linalg.norm(u, axis=1)
        shrunk, whole = (np.linalg.norm(np.where(free, v, 0.0), axis=1) for v in (nearest, wanted))
        outwards = np.einsum("ki,ki->k", u, wanted) > 0.0
        on = (whole > shrunk) & (shrunk > 1e-6 * self.radius) & outwards
        D = np.einsum("kii->ki", self.R).max(axis=1)
        press = self.radius * D * (whole / np.where(on, shrunk, 1.0) - 1.0)
        turn = np.where(on[:, None], u / np.where(on, size, 1.0)[:, None], 0.0)
        hold = bool((lower | upper | on[:, None]).any())
        return pieces._replace(on=on, turn=turn, press=np.where(on, press, 0.0), hold=hold)

    def held_controls(self, pieces: Pieces, H: Array, r: Array) -> tuple[Array, Array]:
        """M and e⁰ of :mod:`slipcar.planner.lq.banded`, for the cost ½ eᵀHe + rᵀe of controls.

        A sphere holds tᵀu = radius and adds the curvature ½ (μ/radius) uᵀ(I − t tᵀ)u.
        """
        eye = np.eye(H.shape[1])
        box = ~(pieces.lower | pieces.upper)
        P = box[..., None] * eye  # onto what is free
        fixed = np.where(pieces.lower, self.lower, np.where(pieces.upper, self.upper, 0.0))
        if pieces.on.any():
            t, normal = pieces.turn, np.where(box, pieces.turn, 0.0)
            length = np.where(pieces.on, np.einsum("ki,ki->k", normal, normal), 1.0)[:, None]
            short = pieces.on * self.radius + np.einsum("ki,ki->k", t, self.center - fixed)
            fixed = fixed + normal / length * short[:, None]
            P = P - normal[:, :, None] * (normal / length)[:, None, :]
            across = eye - t[:, :, None] * t[:, None, :]
            curvature = (pieces.press / self.radius)[:, None, None] * across
            H, r = H + curvature, r - np.matmul(curvature, self.center[..., None])[..., 0]
        # What is held is given a curvature of H's size, whatever its unit, and taken out again.
        size = np.einsum("kii->k", H)[:, None, None] / H.shape[1]
        M = np.linalg.inv(P @ H @ P + size * (eye - P)) - (eye - P) / size
        pull = r + np.matmul(H, fixed[..., None])[..., 0]
        return M, fixed - np.matmul(M, pull[..., None])[..., 0]


def variance_of(
    model: Model, at: Linearization, weight: float, Lambda: Array | None = None
) -> moments.Variance | None:
    """Return w ∫ tr Σ dt as a quadratic, its Λ (K, n, n) held if given; None for w = 0."""
    if weight == 0.0:
        return None
    d_sigma = np.asarray(model.diffusion_jacobian(model.times[:-1], at.x[:-1]))
    if Lambda is None:
        Lambda = moments.adjoint_weights(at.A, model.dt, model.metric)
    start = moments.start_share(at.A, Lambda, model.start_covariance)
    return moments.variance_penalty(weight, at.sigma, d_sigma, Lambda, model.dt, start)


def convexify(
    model: Model,
    at: Linearization,
    *,
    variance: moments.Variance | None,
    composite: bool = True,
    trust_multiplier: float = 0.0,
    trust_weight: Array | None = None,
    rho: float = 1.0,
    tolerance: float = 0.0,
) -> Subproblem:
    """The sub-problem at an iterate, with its variance of :func:`variance_of`.

    `composite` keeps φ = max(0, ·)² and linearises its argument; otherwise L is linearised. A trust
    region has the multiplier −p¹ ≥ 0 and the Hessian blocks of its integral, (K, n, n).
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

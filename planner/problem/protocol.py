"""What `plan` solves: the protocol that a problem satisfies.

    minimise  E ∫₀ᵀ [ uᵀRu + H(t,x) + ℓ(t,x)ᵀu + Σ_i w_i max(0, c_i(t,x))² ] dt
    s.t.      dx = b(t,x,u) dt + σ(t,x) dB,   x(0) = start,   E[g(x(T))] = 0,
              lower ≤ u ≤ upper,   ‖u‖₂ ≤ radius

b is affine in u; x(0) may be uncertain (`start_covariance`). Where `variance_weight` is to charge
the noise, σ may depend only on states that stay certain (paper §6.1).
Costs of the state are charged at nodes 1..N−1, each with the dt of the interval that ends there,
those of the control with the dt of its interval; both are taken at the mean, and the noise is
charged by `variance_weight` in :func:`slipcar.planner.plan`.
`slipcar.envs.Scenario` satisfies the protocol; the two packages do not know each other.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

Array = np.ndarray


@runtime_checkable
class Problem(Protocol):
    """A stochastic optimal control problem, as functions batched over leading axes.

    The members below are required. These are used when they are there:

    * `drift_jacobian(t, x, u)` -> ∂b/∂x (..., n, n), ∂b/∂u (..., n, m). Functions are traced and
      differentiated exactly, so it is needed only where `drift` cannot be traced (it calls a
      network, a spline, a solver) and differences are too slow or too coarse. The same holds for
      `diffusion_jacobian(t, x)` -> (..., n, d, n), `terminal_jacobian(x)` -> (..., q, n),
      `penalty_jacobian(t, x)` and `constraint_jacobian(t, x)` -> (..., p, n).
    * `penalty(t, x)` -> c (..., p) with `penalty_weight` (p,): the cost Σ w max(0, c)².
    * `state_cost(t, x)` -> H (...,): any twice differentiable running cost. The sub-problem
      has its gradient and its Hessian, projected to positive semidefinite: nothing changes where
      H is convex. `state_cost_derivatives(t, x)` -> gradient (..., n), Hessian (..., n, n).
    * `control_cost(t, x)` -> ℓ (..., m): the running cost ℓᵀu, affine in u (L of the paper),
      linearised as the paper does. `control_cost_jacobian(t, x)` -> (..., m, n).
    * `control_bounds`: None, (m,) for |u| ≤ bound, or (2, m) for lower and upper.
    * `control_radius`: None, or r > 0 for ‖u‖₂ ≤ r; box and ball may be combined.
    * `constraint(t, x)` -> h (..., p): violated where positive, for `risk` and `risk_price`. It
      costs nothing otherwise.
    * `terminal_weight` (q,) ≥ 0: W of E gᵀWg, what plans with feedback charge instead of asking
      for g(μ) = 0.
    * `initial_guess()` -> states (N, n), controls (N−1, m); otherwise the uncontrolled path
      (or the start at all times, if that path grows without bound).
    * `start_covariance` (n, n): of x(0), symmetric positive semidefinite, with the mean `start`;
      zero otherwise.
    * `angles`: state components of period 2π, so that feedback wraps their errors.
    * `state_names` (n) and `control_names` (m), texts with their units, `plane` (i, j), the two
      states that span the plane it happens in, and `draw(axes)`, which draws what is there: for
      `Plan.plot`, `Plan.to_frame` and `Plan.to_xarray`.
    * `decode_observation(obs)` -> (t, x) and `encode_control(u)` -> action, for controllers
      that act in an environment.

    Attributes:
        start: x(0), (n,).
        times: nodes of the time grid, (N,), increasing, N ≥ 2 [s].
        control_weight: R, (m, m), symmetric positive definite (assumption A₄).
    """

    @property
    def start(self) -> Array: ...  # noqa: D102
    @property
    def times(self) -> Array: ...  # noqa: D102
    @property
    def control_weight(self) -> Array: ...  # noqa: D102

    def drift(self, t: Array, x: Array, u: Array) -> Array:
        """b(t, x, u): times (...,), states (..., n), controls (..., m) -> (..., n)."""
        ...

    def diffusion(self, t: Array, x: Array) -> Array:
        """σ(t, x): (..., n, d) for d Brownian motions."""
        ...

    def terminal(self, x: Array) -> Array:
        """g(x): states (..., n) -> (..., q); E[g(x(T))] = 0."""
        ...

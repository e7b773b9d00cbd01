"""The conditions of an extremal as equations F(x, u, λ, ν) = 0, and Newton's step on them.

    x_k + dt b(x_k, u_k) − x_{k+1} = 0        ∇ℓ_k + A_kᵀ λ_{k+1} − λ_k = 0
    u_k − Π_U(u_k − D⁻¹ ∂L/∂u_k) = 0          g − Π_box(g + ν/s) = 0

with L the Lagrangian and Π the projections onto the admissible controls and the terminal box: a
multiplier of the right sign wherever one of them is on its boundary, and nothing else.

Linearised but for their kinks, they are those of a sub-problem whose Q, S and R are the blocks of
the Lagrangian's Hessian (:mod:`.second_order`). On which piece every kink is, is settled as in
:mod:`slipcar.planner.convex.solvers`: given the pieces, a step (d, e, δλ, δν) solves an LQ problem
(:mod:`slipcar.planner.lq.banded`).

The variance penalty's Λ_k = dt I + A_kᵀ Λ_{k+1} A_k depends on all later nodes, so its change in
the adjoint equation couples every node with those after it, which no band can hold. It is small,
and put in by solving the banded system again with the change that the last step caused on its
right-hand side, until the two agree.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from slipcar.planner.convex.subproblem import Pieces
from slipcar.planner.extremal.maximum_principle import FirstOrder, Scales, first_order
from slipcar.planner.extremal.second_order import SecondOrder, second_order
from slipcar.planner.lq.banded import BandedLq, PrimalDual
from slipcar.planner.problem.model import Model

Array = np.ndarray
#: The step with so much added to the gradient at nodes 1..K, (K, n); None if it overflows.
System = Callable[[Array], PrimalDual | None]

#: Active sets tried for one Newton step, and solves for the change of Λ, at most.
_PIECE_SOLVES, _COUPLING_SOLVES = 8, 12
#: How Λ moves with a step is solved for to this part of the residual's square.
_COUPLING_PART = 0.1


@dataclasses.dataclass(frozen=True)
class ShootingPoint:
    """A primal-dual point; 2-norm and largest of its residuals, each relative to its scale."""

    gradients: FirstOrder
    adjoint: Array  # λ_1..λ_K, (K, n)
    terminal: Array  # ν, (q,)
    rest: Array  # gradient of the Lagrangian with respect to x_1..x_K, (K, n)
    slope: Array  # with respect to u, (K, m)
    norm: float
    largest: float


@dataclasses.dataclass(frozen=True)
class Conditions:
    """The equations to be solved, for w ≥ 0 and the half-width of the terminal box."""

    model: Model
    variance_weight: float
    tolerance: float
    scales: Scales

    def at(self, x: Array, u: Array, adjoint: Array, terminal: Array) -> ShootingPoint:
        """Residuals at a point."""
        scales = self.scales
        gradients = first_order(self.model, x, u, self.variance_weight)
        lin, sub, slope = gradients.lin, gradients.sub, gradients.sub.slope(adjoint)
        rest = gradients.state_gradient - adjoint
        rest[:-1] += np.matmul(adjoint[1:, None], lin.A[1:])[:, 0]
        rest[-1] += terminal @ lin.G
        control = sub.admissible(sub.wanted(np.zeros_like(u), slope))
        end = lin.g - np.clip(self._pressed(lin.g, terminal), -self.tolerance, self.tolerance)
        gap, rest_off = lin.defect / scales.state, rest / scales.adjoint
        end_off, off = end / scales.end, control / scales.control
        norm = float(
            np.linalg.norm(np.concatenate([p.ravel() for p in (gap, rest_off, end_off, off)]))
        )
        worst = (
            np.abs(gap).sum(axis=0),
            np.abs(rest_off),
            np.abs(end_off),
            np.linalg.norm(off, axis=1),
        )
        largest = max(float(np.max(w, initial=0.0)) for w in worst) if np.isfinite(norm) else np.inf
        return ShootingPoint(gradients, adjoint, terminal, rest, slope, norm, largest)

    def moved(self, here: ShootingPoint, step: PrimalDual, length: float) -> ShootingPoint:
        """The point a part of the step away."""
        x, u = here.gradients.lin.x.copy(), here.gradients.lin.u + length * step.e
        x[1:] += length * step.d
        adjoint = here.adjoint + length * step.adjoint
        return self.at(x, u, adjoint, here.terminal + length * step.terminal)

    def newton(self, here: ShootingPoint) -> PrimalDual | None:
        """The Newton step; None if its matrix is singular."""
        gradients, weight = here.gradients, self.variance_weight
        hessians = second_order(self.model, gradients, here.adjoint, here.terminal, weight)
        pieces = self._pieces(here)
        settled: tuple[System, PrimalDual] | None = None
        for _ in range(_PIECE_SOLVES):
            system = self._system(here, hessians, pieces)
            step = None if system is None else system(np.zeros_like(here.adjoint))
            if system is None or step is None:
                break  # with so many controls held, the end is out of reach
            settled = system, step
            reached = self._pieces(here, hessians, step)
            if reached.same_as(pieces):
                break
            pieces = reached
        if settled is None or gradients.weights is None:
            return None if settled is None else settled[1]
        return self._coupled(here, hessians, *settled)

    def _pressed(self, g: Array, terminal: Array) -> Array:
        """Where ν/s leads from g; its projection onto the terminal box is g at one, (q,)."""
        cost = float(np.max(self.scales.adjoint * self.scales.state))
        return g + terminal * self.scales.end**2 / cost

    def _pieces(
        self,
        here: ShootingPoint,
        hessians: SecondOrder | None = None,
        step: PrimalDual | None = None,
    ) -> Pieces:
        """The pieces at a point, or those a step leads to by the linearised conditions."""
        sub, slope, terminal = here.gradients.sub, here.slope, here.terminal
        c, g, e = sub.b, sub.g, np.zeros_like(slope)
        if hessians is not None and step is not None:
            c, e = sub.hinge_arguments(step.d), step.e
            g, terminal = g + sub.G @ step.d[-1], terminal + step.terminal
            slope = slope + np.matmul(step.adjoint[:, None], sub.B)[:, 0]
            slope += np.matmul(hessians.uu, e[..., None])[..., 0]
            slope[1:] += np.matmul(hessians.ux[1:], step.d[:-1, :, None])[..., 0]
        side = np.ones(len(g))
        if self.tolerance > 0.0:
            pressed = self._pressed(g, terminal)
            side = np.where(np.abs(pressed) > self.tolerance, np.sign(pressed), 0.0)
        return sub.pieces(c > 0.0, side, e, slope)

    def _system(self, here: ShootingPoint, hessians: SecondOrder, pieces: Pieces) -> System | None:
        """The linearised conditions on given pieces, factorised; None if singular."""
        sub, at = here.gradients.sub, here.gradients
        M, e0 = sub.held_controls(pieces, hessians.uu, here.slope)
        drift = sub.f + np.matmul(sub.B, e0[..., None])[..., 0]
        h, held = sub.h * pieces.hinge, pieces.terminal != 0
        q = here.rest + np.matmul((h * sub.b - at.push)[:, None], sub.a)[:, 0]
        side = np.where(held, self.tolerance * pieces.terminal - sub.g, -here.terminal)
        K, n = sub.f.shape
        lq = BandedLq(K, n, len(sub.g))
        lq.load(sub.A, sub.B, M, hessians.ux)
        lq.end(sub.G, held, np.where(held, 0.0, 1.0))
        if not lq.factor(hessians.xx + sub.a.swapaxes(1, 2) @ (h[..., None] * sub.a)):
            return None
        return lambda push: lq.solve(e0, drift, q + push, side)

    def _coupled(
        self, here: ShootingPoint, hessians: SecondOrder, system: System, step: PrimalDual | None
    ) -> PrimalDual | None:
        """The step with what the change of Λ along it adds, as exact as the residual is small.

        Plain repetition converges only while the variance weighs little; combining the guesses so
        that their errors cancel (Anderson 1965, for linear maps the same as GMRES) always does.
        """
        model, x = self.model, here.gradients.lin.x
        d_sigma = np.asarray(model.diffusion_jacobian(model.times[:-1], x[:-1]))
        enough = _COUPLING_PART * min(here.largest, 1.0) ** 2 * self.scales.adjoint.min()
        push = np.zeros_like(here.adjoint)
        pushes: list[Array] = []
        errors: list[Array] = []
        while step is not None and len(pushes) < _COUPLING_SOLVES:
            change = _gradient_change(model.dt, here.gradients, hessians, d_sigma, step)
            error = self.variance_weight * change - push
            if not np.max(np.abs(error)) > enough:
                break
            pushes.append(push.ravel())
            errors.append(error.ravel())
            gamma = np.linalg.lstsq(np.diff(errors, axis=0).T, errors[-1], rcond=None)[0]
            alpha = np.diff(gamma, prepend=0.0, append=1.0)
            push = (alpha @ (np.array(pushes) + errors)).reshape(push.shape)
            step = system(push)
        return step


def _gradient_change(
    dt: Array, at: FirstOrder, hessians: SecondOrder, d_sigma: Array, step: PrimalDual
) -> Array:
    """Change of the gradient of ∫ tr Σ at nodes 1..K because Λ moves with the step, (K, n)."""
    Lambda, A, d = at.weights, at.lin.A, step.d
    assert Lambda is not None
    dA = np.matmul(hessians.A_u, step.e[:, None, :, None])[..., 0]
    dA[1:] += np.matmul(hessians.A_x[1:], d[:-1, None, :, None])[..., 0]
    one_sided = dA[1:].swapaxes(1, 2) @ Lambda[1:] @ A[1:]
    driven = one_sided + one_sided.swapaxes(1, 2)
    change = np.zeros_like(A)
    for k in range(len(A) - 2, -1, -1):
        change[k] = driven[k] + A[k + 1].T.dot(change[k + 1]).dot(A[k + 1])
    against = 2.0 * dt[:, None, None] * (change @ at.lin.sigma)
    gradient = np.zeros_like(d)
    gradient[:-1] = np.einsum("kac,kaci->ki", against, d_sigma)[1:]
    return gradient

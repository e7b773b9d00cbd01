"""The conditions of an extremal as equations F(x, u, λ, ν) = 0, and Newton's step on them.

    x_k + dt b(x_k, u_k) − x_{k+1} = 0        ∇ℓ_k + A_kᵀ λ_{k+1} − λ_k = 0
    u_k − Π_U(u_k − D⁻¹ ∂L/∂u_k) = 0          g − Π_box(g + ν/s) = 0

with L the Lagrangian and Π the projections onto the admissible controls and the terminal box: a
multiplier of the right sign wherever one of them is on its boundary, and nothing else.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.convex.subproblem import Pieces
from slipcar.planner.extremal.maximum_principle import FirstOrder, Scales, first_order
from slipcar.planner.extremal.newton_step import System, coupled_step, newton_system
from slipcar.planner.extremal.second_order import SecondOrder, second_order
from slipcar.planner.lq.banded import PrimalDual
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: Active sets tried for one Newton step.
_PIECE_SOLVES = 8
#: How Λ moves with a step is solved for to this part of the residual's square.
_COUPLING_PART = 0.1


@dataclasses.dataclass(frozen=True)
class ShootingPoint:
    """A primal-dual point with its residuals.

    Attributes:
        gradients: first derivatives there.
        adjoint: λ_1..λ_K, (K, n).
        terminal: ν, (q,).
        slope: gradient of the Lagrangian with respect to u, (K, m).
        norm: 2-norm of all residuals, each relative to its scale.
        largest: largest of them.
    """

    gradients: FirstOrder
    adjoint: Array
    terminal: Array
    slope: Array
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
        lin, sub, slope = gradients.lin, gradients.sub, gradients.slope(adjoint)
        rest = gradients.state_gradient - adjoint
        rest[:-1] += np.matmul(adjoint[1:, None], lin.A[1:])[:, 0]
        rest[-1] += terminal @ lin.G
        control = sub.admissible(sub.wanted(np.zeros_like(u), slope))
        end = lin.g - np.clip(self._pressed(lin.g, terminal), -self.tolerance, self.tolerance)
        parts = np.concatenate(
            [
                lin.defect.ravel() / scales.state,
                end / scales.state,
                rest.ravel() / scales.adjoint,
                control.ravel() / scales.control,
            ]
        )
        norm = float(np.linalg.norm(parts))
        largest = float(np.max(np.abs(parts))) if np.isfinite(norm) else np.inf
        return ShootingPoint(gradients, adjoint, terminal, slope, norm, largest)

    def _pressed(self, g: Array, terminal: Array) -> Array:
        """Where ν/s leads from g; its projection onto the terminal box is g at one, (q,)."""
        return g + terminal * (self.scales.state / self.scales.adjoint)

    def moved(self, here: ShootingPoint, step: PrimalDual, length: float) -> ShootingPoint:
        """The point a part of the step away."""
        x, u = here.gradients.lin.x.copy(), here.gradients.lin.u + length * step.e
        x[1:] += length * step.d
        adjoint = here.adjoint + length * step.adjoint
        return self.at(x, u, adjoint, here.terminal + length * step.terminal)

    def newton(self, here: ShootingPoint) -> PrimalDual | None:
        """The Newton step; None if its matrix is singular."""
        model, weight, gradients = self.model, self.variance_weight, here.gradients
        hessians = second_order(model, gradients, here.adjoint, here.terminal, weight)
        pieces = self._pieces(here)
        settled: tuple[System, PrimalDual] | None = None
        for _ in range(_PIECE_SOLVES):
            system = newton_system(
                gradients, hessians, here.adjoint, here.terminal, pieces, self.tolerance
            )
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
        # As exact as the residual is small: quadratic convergence, and no more work.
        small = min(here.largest, 1.0)
        enough = _COUPLING_PART * small * small * self.scales.adjoint
        return coupled_step(model, gradients, hessians, *settled, weight, enough)

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
        return Pieces(c > 0.0, side, sub.held(e, slope))

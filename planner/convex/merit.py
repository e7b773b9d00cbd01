"""What steps are judged by, from the multipliers λ, ν of the sub-problem at hand.

    Φ = cost + λᵀf + ½ max|λ| ‖f‖₁ + νᵀg + ½ max|ν| ‖g‖₁,
    cost = effort + penalty + running cost + w ∫ tr Σ dt

with f the defects of the non-linear dynamics, g the terminal residual (beyond its tolerance) and
λ, ν their multipliers from the sub-problem. Pricing them by multipliers, with their signs, is
what keeps good steps from being rejected near the solution (Maratos): the defect that a step
leaves is of second order, and so is its gain. While something is lacking (ν at its limit ρ) the
last two terms are ρ ‖g‖₁. The noise is charged by the weights Λ that the sub-problem holds: with
others its fixed point would not be a minimum of Φ.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slipcar.planner.convex.solvers.interface import Solution
from slipcar.planner.convex.subproblem import variance_of
from slipcar.planner.moments.covariance import Variance
from slipcar.planner.problem.linearization import Linearization, linearize
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: Steps to where the model is not finite are rejected: no warning is needed on the way.
_quiet = np.errstate(over="ignore", invalid="ignore", divide="ignore")


@dataclasses.dataclass(frozen=True)
class Iterate:
    """A linearisation, and w ∫ tr Σ dt there as a quadratic (None for w = 0)."""

    lin: Linearization
    variance: Variance | None

    @property
    def smooth_cost(self) -> float:
        """Effort, running cost and w ∫ tr Σ dt but for the start's part of it: steps hold that."""
        variance = 0.0 if self.variance is None else self.variance.value
        return self.lin.effort + self.lin.running + variance


@_quiet
def iterate_at(model: Model, variance_weight: float, x: Array, u: Array) -> Iterate:
    """Evaluate everything at states x (N, n) and controls u (N−1, m)."""
    lin = linearize(model, x, u)
    return Iterate(lin, variance_of(model, lin, variance_weight))


class Merit:
    """Φ with the multipliers of a solution from an iterate; τ of its box and ρ of its penalty."""

    def __init__(self, here: Iterate, solution: Solution, tolerance: float, rho: float) -> None:
        self._noise = here.variance
        self.adjoint, self.terminal, self.tolerance = solution.adjoint, solution.terminal, tolerance
        self._largest = float(np.abs(solution.adjoint).max())
        size = float(np.abs(solution.terminal).max(initial=0.0))
        lacking = size > 0.5 * rho
        self._nu = np.zeros_like(solution.terminal) if lacking else solution.terminal
        self._terminal_price = rho if lacking else 0.5 * size

    @_quiet
    def __call__(self, at: Iterate) -> float:
        """Φ at an iterate."""
        lin, beyond = at.lin, self._beyond(at.lin.g)
        defects = np.vdot(self.adjoint, lin.defect) + 0.5 * self._largest * np.abs(lin.defect).sum()
        end = np.vdot(self._nu, beyond) + self._terminal_price * np.abs(beyond).sum()
        return self._cost(lin) + float(defects + end)

    @_quiet
    def lagrangian(self, at: Iterate) -> float:
        """The augmented Lagrangian.

        Near a solution defects are of second order in the step, as is its gain: the absolute
        values in Φ would hide how the cost really curves, the squares here do not.
        """
        lin, beyond = at.lin, self._beyond(at.lin.g)
        price = 50.0 * self._largest / (1.0 + float(np.abs(lin.x).max()))
        squares = price * (np.vdot(lin.defect, lin.defect) + np.vdot(beyond, beyond))
        prices = np.vdot(self.adjoint, lin.defect) + np.vdot(self.terminal, beyond)
        return self._cost(lin) + float(prices + squares)

    def _cost(self, lin: Linearization) -> float:
        noise = 0.0 if self._noise is None else self._noise.at(lin.sigma)
        return lin.effort + lin.penalty + lin.running + noise

    def _beyond(self, g: Array) -> Array:
        return g - np.minimum(np.maximum(g, -self.tolerance), self.tolerance)

"""What the paper's text says and what was released with it, each as something that can be run.

docs/reproduction.md lists where §6 of the paper, the code released with it
(StanfordASL/stochasticSCP) and this package differ. The pieces that are not options of `plan` are
here: the potential as printed, the covariance steps of text and release, the start and the trust
region of the release.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from slipcar.envs import cost
from slipcar.envs.scenario import Scenario
from slipcar.planner import Plan
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import model_of

Array = np.ndarray

#: Members of a scenario that the problem with the printed potential must not show.
_HIDDEN = ("penalty", "penalty_weight", "penalty_jacobian", "guesses", "parameters", "reposed")


class PrintedPotential:
    """The problem with the obstacle potential as the paper prints it (§6.3).

        c_o(x) = ‖r − r_o‖² − (δ_o+ε)²  if ‖r − r_o‖ < δ_o+ε, else 0;     L = λ Σ_o c_o

    It is negative inside: the deeper in an obstacle, the cheaper. The released code squares it.
    Satisfies `slipcar.planner.Problem`; everything else is the scenario's.

    Args:
        scenario: the world.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "scenario" or name in _HIDDEN:
            raise AttributeError(name)
        return getattr(self.scenario, name)

    def state_cost(self, t: Any, x: Array) -> Array:
        """λ Σ_o c_o ≤ 0, (..., 5) -> (...,)."""
        s = self.scenario
        inside = np.maximum(cost.obstacle_constraints(x, s.obstacles, s.clearance), 0.0)
        return -s.obstacle_weight * inside.sum(axis=-1)

    def state_cost_derivatives(self, t: Any, x: Array) -> tuple[Array, Array]:
        """Gradient (..., 5) and Hessian (..., 5, 5)."""
        s = self.scenario
        inside = cost.obstacle_constraints(x, s.obstacles, s.clearance) > 0.0
        slopes = cost.obstacle_constraints_jacobian(x, s.obstacles)
        gradient = -s.obstacle_weight * (inside[..., None] * slopes).sum(axis=-2)
        hessian = np.zeros((*x.shape, x.shape[-1]))
        hessian[..., 0, 0] = hessian[..., 1, 1] = 2.0 * s.obstacle_weight * inside.sum(axis=-1)
        return gradient, hessian


def printed_cost(scenario: Scenario, x: Array) -> float:
    """What a path of states (N, 5) costs with the printed potential, ∫ L dt ≤ 0."""
    return float(scenario.dt * PrintedPotential(scenario).state_cost(None, x[1:]).sum())


def text_covariance(scenario: Scenario, mean: Array) -> Array:
    """Σ at every node by the paper's step (6.6), where it has converged (z_k = z): (N, 5, 5).

    Σ⁺ = Σ + dt (AΣ + ΣAᵀ + C(z_k)C(z)ᵀ), forward Euler.
    """
    sigma = scenario.diffusion(None, mean[:-1])
    return _added_up(scenario, mean, sigma @ sigma.swapaxes(1, 2))


def released_covariance(scenario: Scenario, mean: Array, previous: Array | None = None) -> Array:
    """Σ at every node by the step of the released code, (N, 5, 5).

        Σ⁺ = Σ + dt (MΣ + ΣMᵀ + B Bᵀ + S(μ) S(μ_k)ᵀ),   S(x) = Σ_i ∂σ/∂x_i x_i,   B = σ − S(μ_k)

    (SCP/scp_problem.jl, `add_dynamics_constraints`; M, σ and its derivatives at μ_k.) Of the
    product (B + S)(B + S)ᵀ, which is σσᵀ, the cross terms B Sᵀ + S Bᵀ are missing. As σ is of
    second degree in (v, ω), S = 2σ and B = −σ at convergence: 1 + 4 = five times σσᵀ.

    Args:
        scenario: the world.
        mean: μ, (N, 5).
        previous: μ_k, (N, 5); None is μ itself, convergence.
    """
    at = mean if previous is None else previous
    slopes = scenario.diffusion_jacobian(None, at[:-1])  # (K, 5, d, 5)
    S, S_at = ((slopes @ x[:-1, None, :, None])[..., 0] for x in (mean, at))
    B = scenario.diffusion(None, at[:-1]) - S_at
    return _added_up(scenario, at, B @ B.swapaxes(1, 2) + S @ S_at.swapaxes(1, 2))


def _added_up(scenario: Scenario, at: Array, noise: Array) -> Array:
    M, _ = scenario.drift_jacobian(None, at[:-1], np.zeros((len(at) - 1, 2)))
    covariance = np.zeros((len(at), 5, 5))
    for k, (A, added) in enumerate(zip(M, noise, strict=True)):
        now = covariance[k]
        covariance[k + 1] = now + scenario.dt * (A @ now + now @ A.T + added)
    return covariance


def released_start(scenario: Scenario) -> tuple[Array, Array]:
    """The guess of the released code: all five states on the line, θ = v = ω = 0 here, u = 0."""
    fraction = np.linspace(0.0, 1.0, scenario.nodes)[:, None]
    x = scenario.start + fraction * (scenario.goal - scenario.start)
    return x, np.zeros((scenario.nodes - 1, 2))


def out_of_reach(scenario: Scenario, x: Array, u: Array) -> Array:
    """What no control can mend of E g = 0 in the sub-problem linearised at a guess: (5,).

    The least |g| that the linearised dynamics allow without bounds on the control, component by
    component of the residual of a least-squares problem.

    Args:
        scenario: the world.
        x: states of the guess, (N, 5).
        u: its controls, (N−1, 2).
    """
    lin = linearize(model_of(scenario), x, u)
    effect, gap = np.zeros((5, 0)), np.zeros(5)
    for A, B, defect in zip(lin.A, lin.B, lin.defect, strict=True):
        effect, gap = np.hstack([A @ effect, B]), A @ gap + defect
    missing = lin.g + gap
    e = np.linalg.lstsq(effect, -missing, rcond=1e-10)[0]
    return np.abs(effect @ e + missing)


def released_trust_region(plan: Plan) -> float:
    """The largest of what the released code bounds by Δ₀²/T = 500, over nodes and iterations.

    tr Σ + tr Σ_k + ‖μ − μ_k‖² at every node, along a plan's history.
    """
    scenario = plan.problem
    assert isinstance(scenario, Scenario)
    means = [plan.guess, *(iterate.mean for iterate in plan.history)]
    traces = [np.trace(text_covariance(scenario, mean), axis1=1, axis2=2) for mean in means]
    return max(
        float((traces[i] + traces[i - 1] + ((means[i] - means[i - 1]) ** 2).sum(axis=1)).max())
        for i in range(1, len(means))
    )


def stopping_values(plan: Plan, *, squared: bool = True) -> Array:
    """∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt for every iteration, (iterations,).

    The first has no step before its own: it counts as infinite. Without `squared` the norms are
    not squared, as in the released code.
    """
    dt = np.diff(plan.times)
    guess = np.zeros_like(plan.controls)
    controls = [guess, *(iterate.controls for iterate in plan.history)]
    power = 2 if squared else 1
    steps = np.array(
        [
            float(dt @ np.linalg.norm(after - before, axis=1) ** power)
            for before, after in itertools.pairwise(controls)
        ]
    )
    return steps + np.concatenate([[np.inf], steps[:-1]])


def iterations_needed(plan: Plan, tolerance: float = 1e-3, *, squared: bool = True) -> int:
    """After how many iterations the stopping value falls to the tolerance; 0 if it never does."""
    below = np.flatnonzero(stopping_values(plan, squared=squared) <= tolerance)
    return int(below[0]) + 1 if len(below) else 0

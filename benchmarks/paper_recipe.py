"""The recipe of the experiment released with the paper, with every sub-problem left to IPOPT.

What docs/reproduction.md calls released: the dynamics are linearised at the last iterate, the
obstacle potential, squared and non-convex, is left to the solver as it is, the end is a box of
±10⁻³ round the goal, and the covariance is not in the cost.

    minimise  Σ dt ‖u_k‖² + Σ dt λ Σ_o max(0, c_o(r_k))²      s.t.  x_0 = x⁰,  |x_N − x^f| ≤ 10⁻³,
              x_{k+1} = f(x̄_k, ū_k) + ∂f (x_k − x̄_k, u_k − ū_k)

The iterate is a parameter of a programme that is built once. What differs from the released
code favours it: it builds the programme anew each time (16 s a plan, as measured once), and carries
a trust region (Δ₀ = 50) that is never active here and the covariance that this needs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from casadi_car import bounds, linearized_step, stacked, stage_cost, unstacked, variables
from casadi_nlp import QUIET, TOLERANCE
from contenders import Answer, Contender, stopwatch

from slipcar.envs import Scenario

#: Half-width of the box round the goal.
TERMINAL_BOX = 1e-3


class PaperRecipe:
    """SCP with IPOPT inside.

    Args:
        scenario: what to plan for.
        step_tolerance: stop when ∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt falls to it, as our
            planners do.
        tolerance: IPOPT's `tol`.
        max_iterations: sub-problems at most.
    """

    def __init__(
        self,
        scenario: Scenario,
        step_tolerance: float = 1e-3,
        tolerance: float = TOLERANCE,
        max_iterations: int = 100,
    ) -> None:
        began = time.perf_counter()
        N = scenario.nodes
        advance, price = linearized_step(scenario), stage_cost(scenario)
        xs, us, everything = variables(ca.MX, N)
        at_xs, at_us, iterate = variables(ca.MX, N)
        defects = [xs[k + 1] - advance(xs[k], us[k], at_xs[k], at_us[k]) for k in range(N - 1)]
        nlp = {
            "x": everything,
            "p": iterate,
            "f": sum(price(us[k], xs[k + 1]) for k in range(N - 1)),
            "g": ca.vertcat(xs[0] - scenario.start, *defects, xs[-1] - scenario.goal),
        }
        slack = np.zeros(nlp["g"].numel())
        slack[-scenario.goal.size :] = TERMINAL_BOX
        options = {**QUIET["ipopt"], "ipopt.tol": tolerance, "expand": True}
        self._solver = ca.nlpsol("subproblem", "ipopt", nlp, options)
        bound = bounds(scenario)
        self._limits = {"lbx": -bound, "ubx": bound, "lbg": -slack, "ubg": slack}
        self._guess = stacked(*scenario.initial_guess())
        self._dt, self._step_tolerance = scenario.dt, step_tolerance
        self._max_iterations = max_iterations
        self.build_seconds = time.perf_counter() - began

    def solve(self) -> Answer:
        """The whole iteration, from the scenario's guess."""
        at, last = self._guess, np.inf
        controls = unstacked(at)[1]
        for iteration in range(1, self._max_iterations + 1):
            found = self._solver(x0=at, p=at, **self._limits)
            at, before = np.asarray(found["x"]).ravel(), controls
            controls = unstacked(at)[1]
            change = float(self._dt * np.sum((controls - before) ** 2))
            if not self._solver.stats()["success"]:
                return Answer(controls, iteration, False)
            if change + last <= self._step_tolerance:
                return Answer(controls, iteration, True)
            last = change
        return Answer(controls, self._max_iterations, False)


def paper_recipe(scenario: Scenario, **options: Any) -> Contender:
    """The recipe as a contender."""
    recipe = PaperRecipe(scenario, **options)
    return Contender(
        name="the paper's recipe, IPOPT",
        tolerance=f"step {options.get('step_tolerance', 1e-3):.0e}, KKT {TOLERANCE:.0e}",
        solve=stopwatch(recipe.solve, lambda answer: answer),
        solves=f"goal a box of ±{TERMINAL_BOX:g}",
        build_seconds=recipe.build_seconds,
    )


def makers(scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    """By name."""
    return {"the paper's recipe, IPOPT": lambda: paper_recipe(scenario)}

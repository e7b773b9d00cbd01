"""The whole deterministic problem as one non-linear programme in CasADi: the peer to beat.

Built once, solved from the same straight-line guess as the planner; exact Jacobians and
Hessians by CasADi, IPOPT with MUMPS. The obstacle cost is max(0, c)², as in SPEC §2.
"""

from __future__ import annotations

import time

import casadi as ca
import numpy as np

from slipcar.envs import Scenario


class CasadiNlp:
    """Whole-problem NLP for one scenario.

    Args:
        scenario: what to plan for.
        tolerance: IPOPT's `tol`.
    """

    def __init__(self, scenario: Scenario, tolerance: float = 1e-8) -> None:
        began = time.perf_counter()
        N, dt = scenario.nodes, scenario.dt
        X, U = ca.MX.sym("X", 5, N), ca.MX.sym("U", 2, N - 1)
        cost, constraints = 0, [X[:, 0] - scenario.start]
        for k in range(N - 1):
            x, u = X[:, k], U[:, k]
            drift = ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[4], u[0], u[1])
            constraints.append(x + dt * drift - X[:, k + 1])
            cost += dt * ca.sumsqr(u)
            for cx, cy, radius in scenario.obstacles:
                reach = radius + scenario.clearance
                c = reach**2 - (X[0, k + 1] - cx) ** 2 - (X[1, k + 1] - cy) ** 2
                cost += dt * scenario.obstacle_weight * ca.fmax(0, c) ** 2
        constraints.append(X[:, N - 1] - scenario.goal)
        variables = ca.vertcat(ca.vec(X), ca.vec(U))
        nlp = {"x": variables, "f": cost, "g": ca.vertcat(*constraints)}
        quiet = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes"}
        options = {**quiet, "ipopt.tol": tolerance}
        self._solver = ca.nlpsol("plan", "ipopt", nlp, options)
        x, u = scenario.initial_guess()
        self._guess = np.concatenate([x.ravel(), u.ravel()])
        limit = np.full(2, np.inf) if scenario.control_bounds is None else scenario.control_bounds
        bound = np.concatenate([np.full(5 * N, np.inf), np.tile(limit, N - 1)])
        self._limits = {"lbx": -bound, "ubx": bound, "lbg": 0.0, "ubg": 0.0}
        self.build_time = time.perf_counter() - began

    def solve(self) -> tuple[bool, float, int]:
        """Whether it converged, effort plus obstacle cost, iterations."""
        found = self._solver(x0=self._guess, **self._limits)
        stats = self._solver.stats()
        return bool(stats["success"]), float(found["f"]), int(stats["iter_count"])

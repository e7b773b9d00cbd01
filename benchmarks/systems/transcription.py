"""Any problem of slipcar's as one non-linear programme for IPOPT: the same Euler steps and costs.

    minimise  Σ_k dt (uᵀRu + ℓᵀu + H⁺ + Σ w max(0, c⁺)²)
    s.t.      x⁺ = x + dt b(t, x, u),   g(x_K) = 0,   bounds of u

where ⁺ is at the end of the interval, all else at its beginning.

Multiple shooting: states are variables, so a guess need not obey the dynamics.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import casadi as ca
import numpy as np

from slipcar.planner.problem.model import checked_trajectory, model_of

from .symbols import symbolic

Array = np.ndarray
Guess = tuple[Array, Array]

#: IPOPT's `tol`, and seconds that it is given.
TOLERANCE, PATIENCE = 1e-9, 60.0


@dataclasses.dataclass(frozen=True)
class Solved:
    """What IPOPT found: states (N, n), controls (K, m), its word and the time of the call [s]."""

    states: Array
    controls: Array
    cost: float
    iterations: int
    converged: bool
    status: str
    seconds: float


class Programme:
    """A problem, built once; solved from any guess.

    Args:
        problem: of the protocol; its functions must be traceable.
        tolerance: IPOPT's `tol`.
    """

    def __init__(self, problem: Any, tolerance: float = TOLERANCE) -> None:
        model = self.model = model_of(problem)
        functions = symbolic(model)
        n, m, K = model.state_dim, model.control_dim, len(model.dt)
        U, later = ca.MX.sym("U", m, K), ca.MX.sym("X", n, K)
        X = ca.horzcat(ca.DM(model.start), later[:, :-1])
        t, dt = ca.DM(model.times).T, ca.DM(model.dt).T
        effort = ca.sum1(U * (ca.DM(model.R) @ U))
        running = functions.running.map(K)(t[:-1], X, U) + functions.ahead.map(K)(t[1:], later)
        defects = functions.next.map(K)(t[:-1], dt, X, U) - later
        programme = {
            "x": ca.vertcat(ca.vec(U), ca.vec(later)),
            "f": ca.dot(dt, effort + running),
            "g": ca.vertcat(ca.vec(defects), functions.terminal(later[:, -1])),
        }
        options = {
            "expand": True, "print_time": False, "error_on_fail": False, "ipopt.sb": "yes",
            "ipopt.print_level": 0, "ipopt.tol": tolerance, "ipopt.max_wall_time": PATIENCE,
        }  # fmt: skip
        self._solver = ca.nlpsol("plan", "ipopt", programme, options)
        free = np.full(n * K, np.inf)
        self._limits = {
            "lbx": np.concatenate([np.tile(model.lower, K), -free]),
            "ubx": np.concatenate([np.tile(model.upper, K), free]),
            "lbg": 0.0,
            "ubg": 0.0,
        }
        named = (model.start, model.times, model.R, model.lower, model.upper, model.weight)
        self.key = b"|".join(
            [functions.key, repr(tolerance).encode(), *map(np.ndarray.tobytes, named)]
        )

    def solve(self, guess: Guess | None = None) -> Solved:
        """From states (N, n) and controls (K, m), or from where the planner starts."""
        model = self.model
        x, u = model.guess() if guess is None else checked_trajectory(model, *guess)
        began = time.perf_counter()
        found = self._solver(x0=np.concatenate([u.ravel(), x[1:].ravel()]), **self._limits)
        seconds = time.perf_counter() - began
        flat, split = np.asarray(found["x"]).ravel(), u.size
        stats = self._solver.stats()
        return Solved(
            states=np.vstack([model.start, flat[split:].reshape(-1, model.state_dim)]),
            controls=flat[:split].reshape(u.shape),
            cost=float(found["f"]),
            iterations=int(stats["iter_count"]),
            converged=bool(stats["success"]),
            status=str(stats["return_status"]),
            seconds=seconds,
        )

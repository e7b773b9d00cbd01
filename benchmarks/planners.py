"""Milliseconds per plan on the paper's case, ours beside CasADi + IPOPT, in one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.envs import Scenario
from slipcar.planner import Plan, plan
from slipcar.planner.backends import Solver
from slipcar.planner.backends.structured import StructuredSolver


def _time(call: Callable[[], Any], seconds: float) -> tuple[np.ndarray, Any]:
    """Wall-clock seconds of repeated warm calls, and the last result."""
    result = call()
    times: list[float] = []
    while sum(times) < seconds or len(times) < 5:
        began = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - began)
    return np.array(times), result


def rows(seconds: float = 2.0) -> list[dict[str, Any]]:
    """One row a solver: median and quartiles in ms, cost reached, iterations."""
    scenario = Scenario.named("paper")
    table: list[dict[str, Any]] = []

    def add(name: str, times: np.ndarray, cost: float, iterations: int, status: str) -> None:
        low, median, high = 1e3 * np.quantile(times, [0.25, 0.5, 0.75])
        table.append(
            {
                "planner": name,
                "ms (median)": median,
                "quartiles": f"{low:.2f}–{high:.2f}",
                "effort + obstacle": cost,
                "iterations": iterations,
                "status": status,
                "runs": len(times),
            }
        )

    def structured(compiled: bool) -> Callable[[], Solver]:
        return lambda: StructuredSolver(compiled)

    solvers: list[tuple[str, Callable[[], str | Solver], float]] = [
        ("slipcar structured (NumPy/SciPy), w = 0", structured(False), 0.0),
        ("slipcar structured (NumPy/SciPy), w = 1", structured(False), 1.0),
        ("slipcar structured (numba), w = 0", structured(True), 0.0),
        ("slipcar structured (numba), w = 1", structured(True), 1.0),
        ("slipcar osqp, w = 0", lambda: "osqp", 0.0),
        ("slipcar cvxpy, w = 0", lambda: "cvxpy", 0.0),
    ]
    for name, make, weight in solvers:

        def call(make: Callable[[], str | Solver] = make, weight: float = weight) -> Plan:
            return plan(scenario, solver=make(), variance_weight=weight)

        try:
            times, p = _time(call, seconds)
        except ImportError as error:
            print(f"skipped {name}: {error}")
            continue
        add(name, times, p.cost, p.iterations, str(p.status))
    try:
        from casadi_nlp import CasadiNlp
    except ImportError as error:
        print(f"skipped CasADi + IPOPT: {error}")
        return table
    nlp = CasadiNlp(scenario)
    times, (found, cost, iterations) = _time(nlp.solve, seconds)
    add("CasADi + IPOPT, whole NLP", times, cost, iterations, "CONVERGED" if found else "failed")
    return table

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

IPOPT = "CasADi + IPOPT, whole NLP"


#: Called so many times, all contenders in turn, so that a busy machine is shared fairly.
ROUNDS = 40
_SLOW, _SLOW_ROUNDS = 0.1, 5


def _solvers() -> dict[str, Callable[[], Plan]]:
    scenario = Scenario.named("paper")

    def planner(make: Callable[[], str | Solver], weight: float) -> Callable[[], Plan]:
        return lambda: plan(scenario, solver=make(), variance_weight=weight)

    return {
        "slipcar structured (NumPy/SciPy), w = 0": planner(lambda: StructuredSolver(False), 0.0),
        "slipcar structured (NumPy/SciPy), w = 1": planner(lambda: StructuredSolver(False), 1.0),
        "slipcar structured (numba), w = 0": planner(lambda: StructuredSolver(True), 0.0),
        "slipcar structured (numba), w = 1": planner(lambda: StructuredSolver(True), 1.0),
        "slipcar osqp, w = 0": planner(lambda: "osqp", 0.0),
        "slipcar cvxpy, w = 0": planner(lambda: "cvxpy", 0.0),
    }


def _ipopt() -> Callable[[], Plan | tuple[bool, float, int]]:
    from casadi_nlp import CasadiNlp

    return CasadiNlp(Scenario.named("paper")).solve


def rows(rounds: int = ROUNDS) -> list[dict[str, Any]]:
    """One row a solver: median and quartiles in ms, cost reached, iterations."""
    contenders: dict[str, Callable[[], Any]] = dict(_solvers())
    try:
        contenders[IPOPT] = _ipopt()
    except ImportError as error:
        print(f"skipped {IPOPT}: {error}")
    results: dict[str, Any] = {}
    times: dict[str, list[float]] = {}
    for name, call in contenders.items():  # warm up: imports, compilation, workspaces
        try:
            call()
            results[name], times[name] = call(), []
        except ImportError as error:
            print(f"skipped {name}: {error}")
    for turn in range(rounds):
        for name in results:
            if turn >= _SLOW_ROUNDS and np.median(times[name]) > _SLOW:
                continue
            began = time.perf_counter()
            results[name] = contenders[name]()
            times[name].append(time.perf_counter() - began)
    return [_row(name, np.array(times[name]), results[name]) for name in results]


def _row(name: str, times: np.ndarray, result: Plan | tuple[bool, float, int]) -> dict[str, Any]:
    if isinstance(result, Plan):
        status, cost, iterations = str(result.status), result.cost, result.iterations
    else:
        found, cost, iterations = result
        status = "CONVERGED" if found else "failed"
    low, median, high = 1e3 * np.quantile(times, [0.25, 0.5, 0.75])
    return {
        "planner": name,
        "ms (median)": median,
        "quartiles": f"{low:.2f}–{high:.2f}",
        "effort + obstacle": cost,
        "iterations": iterations,
        "status": status,
        "runs": len(times),
    }

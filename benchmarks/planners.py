"""Milliseconds per plan on the paper's case: slipcar beside its peers, all in turns."""

from __future__ import annotations

import contextlib
import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import ours
import peers
from contenders import EXACT, Contender, available, judge
from turns import Timing, take_turns

from slipcar.envs import Scenario

_REFERENCE = Path(__file__).resolve().parent.parent / "tests" / "data" / "paper_case.json"
#: Contenders by module: those of a package that is not installed are skipped.
_MODULES = ("cvxpy_dpp", "casadi_nlp", "paper_recipe")


def reference() -> tuple[np.ndarray, float]:
    """Optimal controls (40, 2) of the paper's case and their cost: IPOPT at 1e-10, stored."""
    case = json.loads(_REFERENCE.read_text(encoding="utf-8"))["clearance_0.13"]
    return np.array(case["control"]), case["effort"] + case["obstacle_cost"]


def makers(
    scenario: Scenario, peers_python: str, stack: contextlib.ExitStack
) -> dict[str, Callable[[], Contender]]:
    """Every contender, by name."""
    found = ours.makers(scenario)
    for module in _MODULES:
        found |= _makers_of(module, scenario)
    return found | peers.makers(scenario, peers_python, stack)


def measure(rounds: int, peers_python: str) -> tuple[list[Timing], dict[str, str]]:
    """Timings of all that are available, and why the others are not."""
    with contextlib.ExitStack() as stack:
        scenario = Scenario.named("paper")
        contenders, skipped = available(makers(scenario, peers_python, stack))
        return take_turns(contenders, rounds, "planners"), skipped


def rows(timings: list[Timing]) -> list[dict[str, Any]]:
    """One row a contender, the fastest first."""
    scenario = Scenario.named("paper")
    controls, _ = reference()
    table = []
    for timing in sorted(timings, key=lambda timing: timing.ms[1]):
        contender, answer = timing.contender, timing.answer
        judged = judge(scenario, answer.controls)
        table.append(
            {
                "planner": contender.name,
                "tolerance": contender.tolerance,
                **timing.columns(),
                "effort + obstacle": judged.cost,
                "misses goal by": judged.miss,
                "max |u − u*|": float(np.abs(answer.controls - controls).max()),
                "iterations": answer.iterations,
                "status": "converged" if answer.found else "not converged",
                "built in [s]": contender.build_seconds,
                "runs": len(timing.seconds),
                "solves": contender.solves,
            }
        )
    return table


def disagreements(timings: list[Timing]) -> list[str]:
    """Who claims to solve the problem and does not reach its cost to four digits."""
    scenario = Scenario.named("paper")
    _, optimum = reference()
    told = []
    for timing in timings:
        judged = judge(scenario, timing.answer.controls)
        if timing.contender.solves == EXACT and abs(judged.cost - optimum) > 1e-4 * optimum:
            told.append(f"{timing.contender.name} reaches {judged.cost:.4f}, not {optimum:.4f}")
    return told


def ratios(timings: list[Timing]) -> list[dict[str, Any]]:
    """How many times as long as our structured solver the whole-problem ones take, in this run."""
    median = {timing.contender.name: timing.ms[1] for timing in timings}
    whole = [name for name in median if name.startswith(("CasADi", "crocoddyl"))]
    if not whole:
        return []
    return [
        {
            "planner": f"{timing.contender.name}, {timing.contender.tolerance}",
            **{name: median[name] / timing.ms[1] for name in whole},
        }
        for timing in timings
        if timing.contender.name.startswith(("slipcar, numba", "slipcar, NumPy"))
    ]


def _makers_of(module: str, scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    try:
        return importlib.import_module(module).makers(scenario)
    except ModuleNotFoundError as error:
        missing = error

    def unavailable() -> Contender:
        raise missing

    return {module.replace("_", " "): unavailable}

"""Milliseconds per plan on the paper's case: slipcar beside its peers, all in turns."""

from __future__ import annotations

import contextlib
import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import many
import numpy as np
import ours
import peers
from contenders import EXACT, Contender, available, judge
from report import Section
from turns import Timing, take_turns

from slipcar.envs import Scenario

ABOUT = """\
The scenario `paper` (§6.3 of the paper: four obstacles, 5 s, N = 41), from the same guess, in
a warm process. `u*` is the optimum that IPOPT finds at a tolerance of 1e-10.

* **slipcar**: `plan(scenario)`, the default: Newton's method as machine code. The problem has been
  planned for before and is remembered, as CasADi's rows keep their programme. **NumPy**: the same
  steps, `compiled=False`. **w** is `variance_weight`; w = 0 is the problem that the others solve,
  w = 1 the default, with w ∫ tr Σ dt in the cost.
* **Problems that it has not met** are checked, traced and their structure recognised in the time
  (CasADi's programme would have to be built, see its column): *a new scenario*, equal to the
  paper's; *another object of an own class*, the same problem in a plain class, without Jacobians or
  `parameters()`; *a new random world*, `Scenario.random(seed)` with one to eight obstacles.
* **slipcar, convex scheme**: `method="convex"`, the paper's: a sequence of exact convex
  sub-problems, by the structured solver (NumPy and SciPy), by OSQP with its matrices updated in
  place, and by cvxpy with Clarabel, written out anew each time or built once with parameters (DPP).
* **CasADi + IPOPT**, **CasADi + fatrop**: the whole problem as one programme, built once, exact
  derivatives. `expand` turns CasADi's graph of matrices into one of scalars; *graph not expanded*
  is what CasADi does unless told to. *Derivatives compiled*: translated to C beforehand.
* **The paper's recipe, IPOPT**: the released experiment's scheme, its sub-problems left to IPOPT,
  built once; its goal is a box.
* **plan_batch**: 1000 start states in one call, the paper's and others round it (position ± 0.1 m,
  heading ± 0.2 rad, uniform, seeded); or 200 random worlds that the planner has not met, others in
  each call. The time is that of the whole call over their number, Python's share included: checks,
  guesses, iterations, `Plan` objects.

A *residual²* tolerance is one on the square of the maximum principle's relative residual, a *step*
tolerance one on ∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt, a *KKT* tolerance the solver's own.
"""

#: Rows that owe nothing to another solver.
_OWN = ("slipcar, w", "slipcar, NumPy", "slipcar, convex scheme, w", "slipcar, plan_batch,")
_WHOLE = ("CasADi", "crocoddyl", "OpenSCvx")
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
    return found | peers.makers(scenario, peers_python, stack) | many.makers(scenario)


def measure(rounds: int, peers_python: str) -> tuple[list[Timing], dict[str, str]]:
    """Timings of all that are available, and why the others are not."""
    with contextlib.ExitStack() as stack:
        scenario = Scenario.named("paper")
        contenders, skipped = available(makers(scenario, peers_python, stack))
        return take_turns(contenders, rounds, "planners"), skipped


def section(rounds: int, peers_python: str) -> Section:
    """All of it, to be printed and kept."""
    timings, skipped = measure(rounds, peers_python)
    return Section(
        part="planners",
        title="One plan, and a thousand",
        about=ABOUT,
        tables={
            "Milliseconds per plan": rows(timings),
            "Milliseconds per plan for problems that it has not met": unmet_rows(timings),
            "Many plans in one call": many.rows(timings),
            "How many times as long as ours the others take": ratios(timings),
        },
        notes=(
            *disagreements(timings),
            *(f"skipped {name}: {why}" for name, why in skipped.items()),
        ),
        raw={
            "rounds": rounds,
            "seconds": {
                f"{t.contender.name}, {t.contender.tolerance}": t.seconds.tolist() for t in timings
            },
        },
    )


def rows(timings: list[Timing]) -> list[dict[str, Any]]:
    """One row a contender that makes one plan of the paper's case a call, the fastest first."""
    scenario = Scenario.named("paper")
    controls, _ = reference()
    table = []
    single = [t for t in timings if t.contender.plans == 1 and not _is_unmet(t)]
    for timing in sorted(single, key=lambda timing: timing.ms[1]):
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


def unmet_rows(timings: list[Timing]) -> list[dict[str, Any]]:
    """One row for each that plans for a problem never met before, with the 95 % quantile."""
    return [
        {
            "planner": timing.contender.name,
            "solves": timing.contender.solves,
            **timing.columns(),
            "95 %": 1e3 * float(np.quantile(timing.seconds, 0.95)) / timing.contender.plans,
            "plans in a call": timing.contender.plans,
            "status": "converged" if timing.answer.found else "not all converged",
            "runs": len(timing.seconds),
        }
        for timing in timings
        if _is_unmet(timing)
    ]


def _is_unmet(timing: Timing) -> bool:
    return timing.contender.name.startswith(ours.UNMET)


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
    """How many times as long as each of our rows the whole-problem solvers take, in this run.

    Both sides have met the problem before: theirs is built, ours is remembered.
    """
    whole = [t for t in timings if t.contender.name.startswith(_WHOLE)]
    mine = [t for t in timings if t.contender.name.startswith(_OWN) and t.contender.threads == 1]
    return [
        {
            "planner": f"{one.contender.name}, {one.contender.tolerance}",
            **{other.contender.name: ratio(other, one) for other in whole},
        }
        for one in sorted(mine, key=lambda timing: timing.ms[1])
        if whole
    ]


def ratio(theirs: Timing, ours: Timing) -> float:
    """Of the medians per plan, over the rounds that both took part in: the early ones."""
    both = min(len(theirs.seconds), len(ours.seconds))
    a, b = (float(np.median(t.seconds[:both])) / t.contender.plans for t in (theirs, ours))
    return a / b


def _makers_of(module: str, scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    try:
        return importlib.import_module(module).makers(scenario)
    except ModuleNotFoundError as error:
        missing = error

    def unavailable() -> Contender:
        raise missing

    return {module.replace("_", " "): unavailable}

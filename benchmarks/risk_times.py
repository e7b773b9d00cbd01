"""Milliseconds for plans that count the noise, and for a replan, on the paper's case.

Of a plan with a risk the time is that of the whole call less its Monte Carlo
(`Risk.simulation_time`), which has a column of its own.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from contenders import Answer, Contender, available
from planners import ratio
from report import Section
from turns import Timing, take_turns

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.planner import RecedingHorizon, Status, plan

#: Price of risk of the rows that have one [cost per unit of probability].
PRICE = 10.0
#: Episodes of a batch of replans, in one call of `predict`: a block of the evaluation.
EPISODES = 1024
#: Rounds of a row with Monte Carlo, or of a batch, for so many of the others.
_RARE = 20

ABOUT = f"""\
The scenario `paper`, one core, contenders in turns. **starts** are guesses: 6 is the default where
the noise has a cost, 1 the own guess alone. **risk** means that a price is searched for and the
plan verified on 100 000 fresh paths: *ms* is the call less the Monte Carlo of both, which is in
*Monte Carlo [s]*. **risk_price={PRICE:g}** has no Monte Carlo. **NumPy** is
`compiled=False`, the same steps. A *replan* is a step of `RecedingHorizon`: the time is that of
`predict`, observations decoded and actions encoded, over all replans of an episode ({EPISODES}
episodes in one call in a batch).
"""

_BASE = "plan(s)"
#: What `plan` is told, by row.
_CASES: dict[str, dict[str, Any]] = {
    "expected=True": {"expected": True},
    "feedback=True": {"feedback": True},
    f"risk_price={PRICE:g}": {"risk_price": PRICE},
    f"risk_price={PRICE:g}, feedback=True": {"risk_price": PRICE, "feedback": True},
    "risk=0.01": {"risk": 0.01},
    "risk=0.002": {"risk": 0.002},
    "risk=0.001, feedback=True": {"risk": 0.001, "feedback": True},
}

Simulated = dict[str, list[float]]


def makers(scenario: Scenario, simulated: Simulated) -> dict[str, Callable[[], Contender]]:
    """Every contender, by name; Monte Carlo's seconds go to `simulated`."""
    found: dict[str, Callable[[], Contender]] = {}

    def add(name: str, options: dict[str, Any]) -> None:
        found[name] = lambda: planner(name, scenario, options, simulated)

    add(_BASE, {"compiled": True})
    add(f"{_BASE}, NumPy", {"compiled": False})
    for name, options in _CASES.items():
        add(name, {**options, "compiled": True})
        add(f"{name}, starts=1", {**options, "compiled": True, "starts": 1})
        if "risk" not in options:  # the search solves at some prices, each as with risk_price
            add(f"{name}, NumPy", {**options, "compiled": False})
    for price, title in ((0.0, "replan"), (PRICE, f"replan, risk_price={PRICE:g}")):
        found[f"{title}, single"] = _replans(f"{title}, single", scenario, price, 1)
        batch = f"{title}, {EPISODES} episodes"
        found[batch] = _replans(batch, scenario, price, EPISODES)
    return found


def planner(
    name: str, scenario: Scenario, options: dict[str, Any], simulated: Simulated
) -> Contender:
    """`plan` with these options, its Monte Carlo apart."""
    if options.get("compiled"):
        importlib.import_module("llvmlite")  # its absence is noticed here

    def solve() -> tuple[float, Answer]:
        found = plan(scenario, **options)
        monte_carlo = 0.0 if found.risk is None else found.risk.simulation_time
        simulated.setdefault(name, []).append(monte_carlo)
        return found.solve_time - monte_carlo, Answer(
            found.controls, found.iterations, found.status is Status.CONVERGED
        )

    return Contender(name=name, tolerance="step 1e-03", solve=solve)


def receding(name: str, scenario: Scenario, price: float, rows: int) -> Contender:
    """One episode after another, or so many at once: seconds inside `predict`."""
    controller = RecedingHorizon(scenario, risk_price=price)
    controller.rows = rows
    steps = scenario.nodes - 1

    def solve() -> tuple[float, Answer]:
        failed = controller.failures
        driven = evaluate(controller, scenario, episodes=rows)
        seconds = driven.inference_time * rows * steps
        return seconds, Answer(controller.plan.controls, 0, controller.failures == failed)

    before = controller.replans
    solve()
    return Contender(
        name=name, tolerance="step 1e-03", solve=solve, plans=controller.replans - before
    )


def _replans(name: str, scenario: Scenario, price: float, rows: int) -> Callable[[], Contender]:
    return lambda: receding(name, scenario, price, rows)


def measure(rounds: int) -> tuple[list[Timing], Simulated, dict[str, str]]:
    """Timings of all that are available, the Monte Carlo of each, and why others are not."""
    simulated: Simulated = {}
    contenders, skipped = available(makers(Scenario.named("paper"), simulated))
    rare = [c for c in contenders if is_rare(c.name)]
    often = [c for c in contenders if not is_rare(c.name)]
    timings = take_turns(often, rounds, "risk-times")
    timings += take_turns(rare, max(rounds // _RARE, 1), "risk-times, Monte Carlo and batches")
    return timings, simulated, skipped


def is_rare(name: str) -> bool:
    """Whether a call of it takes a second or more."""
    return name.startswith("risk=") or "episodes" in name


def section(rounds: int) -> Section:
    """All of it, to be printed and kept."""
    timings, simulated, skipped = measure(rounds)
    return Section(
        part="risk_times",
        title="Plans that count the noise",
        about=ABOUT,
        tables={
            "Milliseconds per plan": rows(timings, simulated),
            "Milliseconds per replan": rows(timings, simulated, replans=True),
        },
        notes=tuple(f"skipped {name}: {why}" for name, why in skipped.items()),
        raw={
            "rounds": rounds,
            "seconds": {t.contender.name: t.seconds.tolist() for t in timings},
            "monte_carlo_seconds": simulated,
        },
    )


def rows(
    timings: Sequence[Timing], simulated: Simulated, *, replans: bool = False
) -> list[dict[str, Any]]:
    """One row a contender, in the order of the rounds, with its ratio to `plan(s)`."""
    base = next((t for t in timings if t.contender.name == _BASE), None)
    table = []
    for timing in timings:
        name = timing.contender.name
        if name.startswith("replan") is not replans:
            continue
        row: dict[str, Any] = {"plan": name, **timing.columns()}
        if base is not None:
            row[f"times {_BASE}"] = ratio(timing, base)
        if replans:
            row["replans in a call"] = timing.contender.plans
            row["status"] = "none failed" if timing.answer.found else "some failed"
        else:
            monte_carlo = float(np.median(simulated[name]))
            row["Monte Carlo [s]"] = monte_carlo or float("nan")
            row["Newton steps"] = timing.answer.iterations
            row["status"] = "converged" if timing.answer.found else "not converged"
        row["runs"] = len(timing.seconds)
        table.append(row)
    return table

"""Risk, feedback and receding horizon on random worlds: promises kept, costs, failures.

A plan that promises P(any collision on the path) ≤ δ is driven over paths that its planner has
never met. It keeps its promise if the Wilson 95 % interval of what is counted there includes δ or
lies under it. Costs are means over the same Brownian paths for all planners of a world.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import risk_figure
from report import Section
from rich.console import Console
from rich.progress import track

from slipcar.envs import Scenario
from slipcar.evaluation import Controller, evaluate
from slipcar.evaluation.statistics import wilson_interval
from slipcar.planner import Feedback, OpenLoop, Plan, plan

#: Worlds of each of the two families, unless told otherwise.
WORLDS = 50
#: Fresh paths that a plan is driven over, and a receding horizon, which plans at each step.
EPISODES, RECEDING_EPISODES = 20_000, 128
#: Of the fresh paths. What `plan` verifies a risk with is drawn in another way from other seeds.
SEED = 1
OPEN_RISK, FEEDBACK_RISK = 0.01, 0.001
#: Guesses of the rows of SCP: as many as `plan` takes where the noise has a cost.
STARTS = 6

SCP, SCP_STARTS = "stochastic SCP", f"stochastic SCP, starts={STARTS}"
LQR = f"stochastic SCP, starts={STARTS}, LQR tracking"
OPEN = f"open loop, risk {OPEN_RISK:.1%}"
FEEDBACK, FEEDBACK_SAFE = "feedback", f"feedback, risk {FEEDBACK_RISK:.1%}"
RECEDING, RECEDING_MARGINS = "receding horizon", "receding horizon with margins"
NAMES = (SCP, SCP_STARTS, LQR, OPEN, FEEDBACK, FEEDBACK_SAFE, RECEDING, RECEDING_MARGINS)

ABOUT = f"""\
`Scenario.random(seed)` and `Scenario.random(seed, turned=True)` for seeds from 0: one to eight
obstacles; turned means start and goal headings drawn anyhow.

* **{SCP}**: `plan(s)`, the paper's method, open loop; **starts={STARTS}**: the best of {STARTS}
  guesses, which all rows below take; **LQR tracking**: `Feedback` of that plan.
* **{OPEN}**: `plan(s, risk={OPEN_RISK:g})`. **{FEEDBACK}**: `plan(s, feedback=True)`.
  **{FEEDBACK_SAFE}**: `plan(s, feedback=True, risk={FEEDBACK_RISK:g})`.
* **{RECEDING}**: `RecedingHorizon(s)`; **with margins**: `risk_price` as the row before found it,
  in the worlds where it did. It promises nothing; its pooled rate is beside that row's.

Plans are driven over {EPISODES:,} fresh paths each, receding horizons over the first
{RECEDING_EPISODES} of them. A promise is *kept* if the Wilson 95 % interval of the rate there
includes δ or lies under it: of rates that are exactly δ, 2.5 % would be missed. A plan that cannot
promise says so: `RISK_UNREACHABLE`, with the least rate that it found. Ratios are medians over
worlds, with the 5 % and 95 % quantiles, over paths that both drove, of plans that converged.
Planning time is that of `plan` without its Monte Carlo, on a problem met for the first time by
the first row alone.
"""


@dataclasses.dataclass(frozen=True)
class Result:
    """What one planner made of one world.

    Attributes:
        seed: of the world.
        turned: its family.
        status: the planner's own word.
        requested: δ, or NaN where none was promised.
        rate: collisions on the fresh paths.
        interval: its Wilson 95 % interval.
        episodes: how many paths.
        effort: mean over them.
        total: mean over them.
        effort_ratio: to SCP with as many starts, over paths that both drove.
        total_ratio: likewise.
        expected: what the plan expects of the costs it charges; NaN if it expects nothing.
        measured: the same costs, measured.
        price: of risk; NaN without one.
        seconds: planning, without Monte Carlo.
        simulated: seconds of Monte Carlo.
        replans: made on the way.
        failures: of them.
        replanning: seconds that a replan took.
    """

    seed: int
    turned: bool
    status: str
    requested: float
    rate: float
    interval: tuple[float, float]
    episodes: int
    effort: float
    total: float
    effort_ratio: float
    total_ratio: float
    expected: float = math.nan
    measured: float = math.nan
    price: float = math.nan
    seconds: float = math.nan
    simulated: float = 0.0
    replans: int = 0
    failures: int = 0
    replanning: float = math.nan

    @property
    def ok(self) -> bool:
        """Whether the planner stands by it."""
        return self.status == "CONVERGED"

    @property
    def kept(self) -> bool:
        """Whether what was counted is compatible with at most what was promised."""
        return self.interval[0] <= self.requested


Found = dict[str, list[Result]]


def measure(
    worlds: int,
    episodes: int = EPISODES,
    receding_episodes: int = RECEDING_EPISODES,
    risk_episodes: int = EPISODES,
    turned: Sequence[bool] = (False, True),
) -> Found:
    """All rows on so many worlds of each family; receding horizons unless their episodes are 0."""
    found: Found = {name: [] for name in NAMES if receding_episodes or "receding" not in name}
    pairs = [(seed, family) for family in turned for seed in range(worlds)]
    list(_plans(Scenario.random(0), 1000))  # imports and compiles
    for seed, family in track(pairs, "risk: worlds", console=Console(stderr=True)):
        scenario = Scenario.random(seed, turned=family)
        done: dict[str, Any] = {}
        price = math.nan
        for name, p, controller in _plans(scenario, risk_episodes):
            done[name] = (p, controller, evaluate(controller, scenario, episodes, SEED))
            if name == FEEDBACK_SAFE and p.risk is not None and p.risk.reached:
                price = p.risk.price
        if receding_episodes:
            for name, p, controller in _receding(scenario, price):
                done[name] = (
                    p,
                    controller,
                    evaluate(controller, scenario, receding_episodes, SEED),
                )
        reference = done[SCP_STARTS][2]
        for name, (p, controller, driven) in done.items():
            found[name].append(_result(seed, family, p, controller, driven, reference))
    return found


def _plans(scenario: Scenario, risk_episodes: int) -> Iterator[tuple[str, Plan, Controller]]:
    """Plans and who plays them, by name."""
    p = plan(scenario)
    yield SCP, p, OpenLoop(p)
    p = plan(scenario, starts=STARTS)
    yield SCP_STARTS, p, OpenLoop(p)
    yield LQR, p, Feedback(p)
    p = plan(scenario, risk=OPEN_RISK, risk_episodes=risk_episodes)
    yield OPEN, p, OpenLoop(p)
    p = plan(scenario, feedback=True)
    yield FEEDBACK, p, Feedback(p)
    p = plan(scenario, feedback=True, risk=FEEDBACK_RISK, risk_episodes=risk_episodes)
    yield FEEDBACK_SAFE, p, Feedback(p)


def _receding(scenario: Scenario, price: float) -> Iterator[tuple[str, Plan, Controller]]:
    """Receding horizons, the one with margins if there is a price."""
    from slipcar.planner import RecedingHorizon

    controller = RecedingHorizon(scenario)
    yield RECEDING, controller.plan, controller
    if math.isfinite(price):
        controller = RecedingHorizon(scenario, risk_price=price)
        yield RECEDING_MARGINS, controller.plan, controller


def _result(
    seed: int, turned: bool, p: Plan, controller: Controller, driven: Any, reference: Any
) -> Result:
    mine, theirs = driven.metrics, reference.metrics.first(driven.episodes)
    expected = measured = math.nan
    if p.expected is not None:
        expected = p.expected.total
        # In open loop the mean arrives exactly, and the spread there is not charged.
        measured = driven.total if p.gains is not None else driven.effort + driven.obstacle
    replans = int(getattr(controller, "replans", 0))
    return Result(
        seed=seed,
        turned=turned,
        status=str(p.status),
        requested=math.nan if p.risk is None else p.risk.requested,
        rate=driven.collision_rate,
        interval=driven.collision_interval,
        episodes=driven.episodes,
        effort=driven.effort,
        total=driven.total,
        effort_ratio=float(mine.effort.mean() / theirs.effort.mean()),
        total_ratio=float(mine.total.mean() / theirs.total.mean()),
        expected=expected,
        measured=measured,
        price=math.nan if p.risk is None else p.risk.price,
        seconds=p.solve_time - (0.0 if p.risk is None else p.risk.simulation_time),
        simulated=0.0 if p.risk is None else p.risk.simulation_time,
        replans=replans,
        failures=int(getattr(controller, "failures", 0)) if replans else 0,
        replanning=controller.time_per_replan if replans else math.nan,  # type: ignore[attr-defined]
    )


def section(worlds: int, folder: Path) -> Section:
    """All of it, to be printed and kept; the figure goes to the folder."""
    found = measure(worlds)
    risk_figure.draw(
        [[r.rate for r in found[SCP_STARTS]]] * 3,
        {name: found[name] for name in (OPEN, FEEDBACK, FEEDBACK_SAFE)},
        {OPEN: OPEN_RISK, FEEDBACK_SAFE: FEEDBACK_RISK},
        folder,
    )
    return Section(
        part="risk",
        title="Risk on random worlds",
        about=ABOUT,
        tables={
            "Is the promised risk kept": promises(found),
            "Collisions and cost": costs(found),
            "Planning time and failures": times(found),
        },
        figures=("risk",),
        notes=tuple(notes(found)),
        raw={name: [dataclasses.asdict(r) for r in results] for name, results in found.items()},
    )


def promises(found: Found) -> list[dict[str, Any]]:
    """One row for each planner that promises, and family of worlds."""
    table = []
    for name in (OPEN, FEEDBACK_SAFE):
        for family, results in families(found[name]):
            promised = [r for r in results if r.ok]
            shares = [r.rate / r.requested for r in promised]
            refused = [r.rate for r in results if r.status == "RISK_UNREACHABLE"]
            table.append(
                {
                    "planner": name,
                    "worlds": f"{len(results)} {family}",
                    "promised": len(promised),
                    "kept": f"{sum(r.kept for r in promised)} of {len(promised)}",
                    "rate ≤ δ": f"{sum(s <= 1.0 for s in shares)} of {len(promised)}",
                    "rate / δ": spread(shares),
                    "worst": max(shares, default=math.nan),
                    "refused": len(refused),
                    "least rate there [%]": f"{spread([100.0 * r for r in refused])}",
                    "failed": len(results) - len(promised) - len(refused),
                }
            )
    return table


def costs(found: Found) -> list[dict[str, Any]]:
    """One row for each planner, over worlds where it and SCP converged."""
    table = []
    for name, every in found.items():
        results = [
            r
            for r in every
            if r.ok and _of(found[SCP_STARTS], r).ok and not math.isnan(r.total_ratio)
        ]
        if not results:
            continue
        hits = sum(round(r.rate * r.episodes) for r in results)
        paths = sum(r.episodes for r in results)
        low, high = wilson_interval(hits, paths)
        ratios = [r.expected / r.measured for r in results if not math.isnan(r.expected)]
        table.append(
            {
                "planner": name,
                "worlds": len(results),
                "collisions, all paths": f"{hits / paths:.3%} [{low:.3%}, {high:.3%}]",
                "worst world": f"{max(r.rate for r in results):.2%}",
                "effort / SCP": spread([r.effort_ratio for r in results]),
                "total / SCP": spread([r.total_ratio for r in results]),
                "total / tracked": spread(
                    [r.total_ratio / _of(found[LQR], r).total_ratio for r in results]
                )
                if len({r.episodes for r in (*results, *found[LQR])}) == 1
                else "",
                "expected / measured": spread(ratios),
            }
        )
    return table


def times(found: Found) -> list[dict[str, Any]]:
    """One row for each planner: milliseconds, Monte Carlo, and how plans and replans ended."""
    table = []
    for name, results in found.items():
        statuses = collections.Counter(r.status for r in results)
        replans = sum(r.replans for r in results)
        row: dict[str, Any] = {"planner": name, "worlds": len(results)}
        # The tracked plan is the one of the row before.
        row["planning [ms]"] = spread([1e3 * r.seconds for r in results]) if name != LQR else ""
        simulated = [r.simulated for r in results if r.simulated]
        row["Monte Carlo [s]"] = spread(simulated)
        row["ms per replan"] = spread([1e3 * r.replanning for r in results if r.replans])
        row["statuses"] = ", ".join(f"{count} {status}" for status, count in statuses.most_common())
        failures = sum(r.failures for r in results)
        row["replans failed"] = f"{failures} of {replans:,}" if replans else ""
        table.append(row)
    return table


def notes(found: Found, shown: int = 15) -> list[str]:
    """Worlds that speak against a planner."""
    lines = []
    for name, results in found.items():
        lists = {
            "did not keep its promise": [
                r for r in results if r.ok and r.interval[0] > r.requested
            ],
            "refused": [r for r in results if r.status == "RISK_UNREACHABLE"],
            "failed": [r for r in results if r.status not in ("CONVERGED", "RISK_UNREACHABLE")],
        }
        for what, worlds in lists.items():
            if worlds:
                some = [f"{r.seed}{' turned' if r.turned else ''}" for r in worlds[:shown]]
                more = ", ..." if len(worlds) > shown else ""
                lines.append(f"{name} {what}: {len(worlds)} worlds ({', '.join(some)}{more})")
    return lines


def families(results: Sequence[Result]) -> list[tuple[str, list[Result]]]:
    """The results of either family, by name."""
    return [
        (name, [r for r in results if r.turned is turned])
        for name, turned in (("straight", False), ("turned", True))
    ]


def spread(values: Sequence[float]) -> str:
    """Median, and the 5 % and 95 % quantiles."""
    if not values:
        return ""
    low, median, high = np.quantile(values, [0.05, 0.5, 0.95])
    return f"{median:.3g} ({low:.3g}–{high:.3g})"


def _of(results: Sequence[Result], other: Result) -> Result:
    """The result in the same world."""
    return next(r for r in results if (r.seed, r.turned) == (other.seed, other.turned))

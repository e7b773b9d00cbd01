"""Many random worlds with turned headings: who converges, and to what cost.

From the same guess, and from several: the planner with `starts` against the best of three guesses
given to IPOPT (the scenario's own, an arc to the left, one to the right). By default the planner
leaves the obstacles out until its first steps have settled; one row does not. Both solve the same
programme, the deterministic problem (variance weight 0). Every cost is the judge's, who drives
the controls through the dynamics.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from contenders import judge
from report import Section
from rich.console import Console
from rich.progress import track
from worlds_ipopt import Ipopt

from slipcar.envs import Scenario, routes
from slipcar.planner import Plan, plan

ABOUT = """\
`Scenario.random(seed, turned=True)` for seeds from 0: one to eight obstacles, start and goal turned
anyhow. The deterministic problem (w = 0), tolerance 1e-6 for all. **slipcar** is
`plan(scenario)`, one guess, obstacles left out until the first steps have settled;
**free_first=False** has them in from the first step, as IPOPT has; **starts=8** tries eight
guesses. IPOPT gets the same guess, and in *best of 3* also an arc to either side. Converged means
that the solver says so; the miss of the goal is measured where its controls lead. A share of worlds
with *cost ≤ 1.02* counts what did not converge as infinitely costly. IPOPT's answers are kept on
disk, and its times with them: they may stem from an earlier run, and building the programme is not
in them. The time of **slipcar** contains checking and tracing the new problem, the rows after it
find that done. Turns are not taken here: compare convergence and cost rather than times.
"""

#: Worlds unless told otherwise, and guesses of the planner that is given several.
SEEDS, STARTS = 1000, 8
#: Tolerances of both, the terminal residual that counts as reached, and how much costlier than
#: the other's answer passes for as good.
TOLERANCE, RESIDUAL, AS_GOOD = 1e-6, 1e-6, 1.02
#: Bulge of the arcs that IPOPT is given, in parts of the distance.
BULGE = 0.5

SAME, DIRECT, SEVERAL = "slipcar", "slipcar, free_first=False", f"slipcar, starts={STARTS}"
IPOPT, IPOPT_BEST = "CasADi + IPOPT", "CasADi + IPOPT, best of 3"
#: What `plan` is told, by row.
_OURS: dict[str, dict[str, Any]] = {
    SAME: {},
    DIRECT: {"free_first": False},
    SEVERAL: {"starts": STARTS},
}
_CACHE = "worlds-ipopt.npz"


@dataclasses.dataclass(frozen=True)
class Result:
    """What one planner made of one world.

    Attributes:
        seed: of the world.
        status: the planner's own word.
        converged: whether it says so.
        cost: effort + obstacle cost along the path that the controls lead to.
        miss: largest component of |x_N − x^f| there.
        iterations: its own count, over all guesses.
        seconds: wall clock; for IPOPT without building the programme.
    """

    seed: int
    status: str
    converged: bool
    cost: float
    miss: float
    iterations: int
    seconds: float

    @property
    def worth(self) -> float:
        """Cost, infinite for what did not converge."""
        return self.cost if self.converged else np.inf


Found = dict[str, list[Result]]


def measure(seeds: int, folder: Path) -> Found:
    """Plan for the worlds 0 to seeds − 1; IPOPT's answers are remembered in the folder."""
    found: Found = {name: [] for name in (*_OURS, IPOPT, IPOPT_BEST)}
    peer = Ipopt(folder / _CACHE, TOLERANCE)
    console = Console(stderr=True)
    worlds = [Scenario.random(seed, turned=True) for seed in range(seeds)]
    for scenario in worlds[:1]:  # imports and compiles
        for options in _OURS.values():
            _ours(0, scenario, options)
    try:
        for seed, scenario in enumerate(track(worlds, "worlds: IPOPT", console=console)):
            answers = _peers(peer, seed, scenario)
            found[IPOPT].append(answers[0])
            found[IPOPT_BEST].append(best(answers))
    finally:
        peer.save()
    for seed, scenario in enumerate(track(worlds, "worlds: slipcar", console=console)):
        for name, options in _OURS.items():
            found[name].append(_ours(seed, scenario, options))
    return found


def section(seeds: int, folder: Path) -> Section:
    """All of it, to be printed and kept; the figure goes to the folder."""
    found = measure(seeds, folder)
    draw(found, folder)
    return Section(
        part="worlds",
        title="Random worlds",
        about=ABOUT,
        tables={"Who converges, and to what cost": rows(found)},
        figures=("worlds",),
        notes=tuple(notes(found)),
        raw=raw(found),
    )


def best(answers: Sequence[Result]) -> Result:
    """The cheapest that converged, with the work of all."""
    chosen = min(answers, key=lambda answer: (answer.worth, answer.miss))
    return dataclasses.replace(
        chosen,
        iterations=sum(answer.iterations for answer in answers),
        seconds=sum(answer.seconds for answer in answers),
    )


def shares(ours: Sequence[Result], theirs: Sequence[Result]) -> tuple[float, float]:
    """Parts of the worlds where ours is as good as theirs, and where it is better by as much."""
    a, b = (np.array([result.worth for result in results]) for results in (ours, theirs))
    reached = np.isfinite(a)
    return float(np.mean(reached & (a <= AS_GOOD * b))), float(np.mean(AS_GOOD * a < b))


def rows(found: Found) -> list[dict[str, Any]]:
    """One row for each planner."""
    table = []
    for name, results in found.items():
        solved = [r.converged and r.miss <= RESIDUAL for r in results]
        row: dict[str, Any] = {
            "planner": name,
            "worlds": len(results),
            "converged": _percent(np.mean([r.converged for r in results])),
            f"and miss ≤ {RESIDUAL:.0e}": _percent(np.mean(solved)),
        }
        for title, peer in (("IPOPT", IPOPT), ("IPOPT's best of 3", IPOPT_BEST)):
            as_good, better = shares(results, found[peer])
            row[f"cost ≤ {AS_GOOD} {title}"] = _percent(as_good)
            row[f"{title} > {AS_GOOD} cost"] = _percent(better)
        iterations = [r.iterations for r in results]
        ms = [1e3 * r.seconds for r in results]
        row["iterations"] = "{:.0f}, 95 %: {:.0f}".format(*np.quantile(iterations, [0.5, 0.95]))
        row["ms"] = "{:.3g}, 95 %: {:.3g}".format(*np.quantile(ms, [0.5, 0.95]))
        table.append(row)
    return table


def failing(found: Found) -> dict[str, list[int]]:
    """Seeds of the worlds that speak against somebody, by what they say."""

    def where(condition: Callable[[Result, Result], bool], ours: str, theirs: str) -> list[int]:
        pairs = zip(found[ours], found[theirs], strict=True)
        return [a.seed for a, b in pairs if condition(a, b)]

    lists = {}
    for name in _OURS:
        peer = IPOPT_BEST if name == SEVERAL else IPOPT
        lists[f"{name} does not converge to {RESIDUAL:.0e}"] = where(
            lambda a, b: not (a.converged and a.miss <= RESIDUAL), name, peer
        )
        lists[f"{peer} does not converge, {name} does"] = where(
            lambda a, b: a.converged and not b.converged, name, peer
        )
        lists[f"{name} costs more than {AS_GOOD} × {peer}"] = where(
            lambda a, b: a.converged and a.cost > AS_GOOD * b.worth, name, peer
        )
        lists[f"{peer} costs more than {AS_GOOD} × {name}"] = where(
            lambda a, b: b.converged and b.cost > AS_GOOD * a.worth, name, peer
        )
    return lists


def notes(found: Found, shown: int = 15) -> list[str]:
    """The seeds, the first few of each list."""
    lines = []
    for what, seeds in failing(found).items():
        some = ", ".join(map(str, seeds[:shown])) + (", ..." if len(seeds) > shown else "")
        lines.append(f"{what}: {len(seeds)} worlds" + (f" (seeds {some})" if seeds else ""))
    return lines


def raw(found: Found) -> dict[str, Any]:
    """Every result, for the JSON file."""
    results = {name: [dataclasses.asdict(r) for r in rs] for name, rs in found.items()}
    return {"results": results, "failing": failing(found)}


def draw(found: Found, folder: Path) -> list[Path]:
    """Sorted cost ratios: worlds.png and worlds.pdf."""
    from slipcar.evaluation.figures.scene import GREY, PALETTE, new_figure, save_figure, style

    pairs = [(SAME, IPOPT), (DIRECT, IPOPT), (SEVERAL, IPOPT_BEST)]
    with style():
        figure = new_figure(5.2, 3.4)
        axes = figure.subplots()
        for (ours, theirs), colour in zip(pairs, PALETTE, strict=False):
            a, b = (np.array([r.worth for r in found[name]]) for name in (ours, theirs))
            with np.errstate(invalid="ignore"):
                ratio = np.sort(np.where(np.isfinite(a), a / b, np.inf))
            share = 100.0 * (np.arange(len(ratio)) + 1.0) / len(ratio)
            kind = "best of 3" if theirs == IPOPT_BEST else "same guess"
            axes.plot(share, ratio, color=colour, label=f"{ours} / IPOPT, {kind}")
        axes.axhline(1.0, color=GREY, linewidth=0.7)
        axes.set_yscale("log")
        axes.set_ylim(0.03, 12.0)
        ticks = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set_xlim(0.0, 100.0)
        axes.set_xlabel("worlds, by ratio [%]")
        axes.set_ylabel("ratio of costs")
        axes.legend(loc="upper left")
        return save_figure(figure, folder, "worlds")


def _peers(peer: Ipopt, seed: int, scenario: Scenario) -> list[Result]:
    """IPOPT from its three guesses, the scenario's own first."""
    guesses = {
        "own": scenario.initial_guess(),
        "left": routes.arc(scenario, BULGE),
        "right": routes.arc(scenario, -BULGE),
    }
    results = []
    for timed in peer.solve(scenario, guesses).values():
        answer, judged = timed.answer, judge(scenario, timed.answer.controls)
        results.append(
            Result(
                seed=seed,
                status="converged" if answer.found else "not converged",
                converged=answer.found,
                cost=judged.cost,
                miss=judged.miss,
                iterations=answer.iterations,
                seconds=timed.seconds,
            )
        )
    return results


def _ours(seed: int, scenario: Scenario, options: dict[str, Any]) -> Result:
    began = time.perf_counter()
    p = plan(scenario, tolerance=TOLERANCE, variance_weight=0.0, **options)
    seconds = time.perf_counter() - began
    judged = judge(scenario, p.controls)
    return Result(
        seed=seed,
        status=str(p.status),
        converged=p.status.ok,
        cost=judged.cost,
        miss=judged.miss,
        iterations=_work(p),
        seconds=seconds,
    )


def _work(p: Plan) -> int:
    """Iterations from all guesses."""
    tried = p.alternatives
    return sum(one.iterations for one in tried) if tried else p.iterations


def _percent(share: float | np.floating[Any]) -> str:
    return f"{100.0 * float(share):.1f} %"

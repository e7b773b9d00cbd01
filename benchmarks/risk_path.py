"""Promises on the path: what they cost over promises at nodes, and whether they are kept.

python benchmarks/risk_path.py [--episodes 20000] [--worlds 10]
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import statistics
import time
from typing import Any

import numpy as np
import pandas as pd
from report import Section

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.planner import OpenLoop, Plan, plan
from slipcar.planner.moments.monte_carlo import BLOCK, Law
from slipcar.planner.newton.paths import CompiledPaths
from slipcar.planner.newton.posing import pose
from slipcar.planner.problem.model import model_of

RISKS, WORLDS = (0.01, 0.001), 10
#: Fresh paths that judge, their seed and their substeps; of the evaluation that is asked too.
EPISODES, SEED, SUBSTEPS, EVALUATED = 100_000, 0xC0DE, 64, 20_000

ABOUT = f"""\
The scenario `paper` and `Scenario.random(seed)` for the seeds 0 to {WORLDS - 1}, in open loop and
with feedback. *Judged* is the rate at which the SDE itself collides at any instant, on
{EPISODES:,} paths that no planner has met: Euler's method in {SUBSTEPS} substeps of every control
interval, Brownian bridges between them. A promise is *broken* where that rate is above δ by more
than two of its standard errors; where δ is out of reach (`RISK_UNREACHABLE`) there is no promise.
*Effort* and *total* are expected, with what feedback spends;
*over* is how much more the promise on the path expects to spend than the promise at nodes,
effort and corrections together. *Seconds* are of the whole call, Monte Carlo included, on the
threads that the machine has; *planning* is what is not Monte Carlo [ms].
"""


@dataclasses.dataclass(frozen=True)
class Row:
    """One plan: the world, what was promised, and what came of it."""

    world: str
    feedback: bool
    delta: float
    at: str
    plan: Plan
    judged: float
    episodes: int
    seconds: float

    @property
    def error(self) -> float:
        """Standard error of a rate of δ."""
        return float(np.sqrt(self.delta / self.episodes))

    @property
    def reached(self) -> bool:
        """Whether a plan was found that is said to keep δ."""
        return self.plan.risk is not None and self.plan.risk.reached

    @property
    def kept(self) -> bool:
        """Whether the SDE keeps the promise, within the error of the count."""
        return self.judged <= self.delta + 2.0 * self.error

    @property
    def spent(self) -> float:
        """Effort and corrections that are expected."""
        assert self.plan.expected is not None
        return self.plan.expected.effort + self.plan.expected.feedback

    def columns(self) -> dict[str, Any]:
        """Its row of the table."""
        risk, expected = self.plan.risk, self.plan.expected
        assert risk is not None
        assert expected is not None
        return {
            "world": self.world, "law": "feedback" if self.feedback else "open loop",
            "δ": f"{self.delta:.1%}", "promised": self.at, "status": str(self.plan.status),
            "verified": f"{risk.verified:.3%}", "judged": f"{self.judged:.3%}",
            "effort": f"{self.spent:.4f}", "total": f"{expected.total:.4f}",
            "substeps": risk.substeps, "seconds": f"{self.seconds:.2f}",
            "planning": f"{1e3 * (self.plan.solve_time - risk.simulation_time):.0f}",
        }  # fmt: skip


def judge(p: Plan, scenario: Scenario, episodes: int = EPISODES) -> float:
    """Rate on the path, by Euler's method in :data:`SUBSTEPS`."""
    still = np.zeros((*p.controls.shape, p.mean.shape[1]))
    gains = still if p.gains is None else p.gains
    posed = pose(model_of(scenario), constraints=True)
    paths = CompiledPaths(posed, Law(p.mean, p.controls, gains))
    blocks = range(-(-episodes // BLOCK))
    kept = [paths.path(SEED, block, SUBSTEPS, False)[0].path for block in blocks]
    return float(1.0 - np.mean(kept))


def measure(worlds: int = WORLDS, episodes: int = EPISODES) -> list[Row]:
    """Every plan, judged."""
    scenes = {"paper": Scenario.named("paper")}
    scenes |= {f"random {seed}": Scenario.random(seed) for seed in range(worlds)}
    plan(scenes["paper"], risk=0.05, risk_at="path")  # compiled once
    rows = []
    for (name, scene), feedback, delta, at in itertools.product(
        scenes.items(), (False, True), RISKS, ("nodes", "path")
    ):
        began = time.perf_counter()
        p = plan(scene, risk=delta, risk_at=at, feedback=feedback)
        seconds = time.perf_counter() - began
        rate = judge(p, scene, episodes)
        rows.append(Row(name, feedback, delta, at, p, rate, episodes, seconds))
        print(rows[-1].columns(), flush=True)
    return rows


def summary(rows: list[Row]) -> list[dict[str, Any]]:
    """What promises cost and how many are kept, by law and δ."""
    table = []
    for feedback, delta in itertools.product((False, True), RISKS):
        mine = [r for r in rows if (r.feedback, r.delta) == (feedback, delta)]
        nodes, path = ([r for r in mine if r.at == at] for at in ("nodes", "path"))
        kept = {at: [r.kept for r in mine if r.at == at and r.reached] for at in ("nodes", "path")}
        over = [
            b.spent / a.spent - 1.0
            for a, b in zip(nodes, path, strict=True)
            if a.reached and b.reached
        ]
        table.append({
            "law": "feedback" if feedback else "open loop", "δ": f"{delta:.1%}",
            "kept, promised at nodes": f"{sum(kept['nodes'])} of {len(kept['nodes'])}",
            "worst": f"{max(r.judged / delta for r in nodes if r.reached):.1f} δ",
            "kept, promised on the path": f"{sum(kept['path'])} of {len(kept['path'])}",
            "worst ": f"{max((r.judged / delta for r in path if r.reached), default=0.0):.2f} δ",
            "out of reach": sum(not r.reached for r in path),
            "over, median": f"{statistics.median(over):+.1%}" if over else "",
            "over, range": f"{min(over):+.1%} to {max(over):+.1%}" if over else "",
            "seconds, median": f"{statistics.median(r.seconds for r in path):.2f}",
        })  # fmt: skip
    return table


def section() -> Section:
    """All of it, to be printed and kept."""
    rows = measure()
    first = next(r for r in rows if r.at == "path" and not r.feedback)
    scene = Scenario.named("paper")
    found = evaluate(OpenLoop(first.plan), scene, EVALUATED, SEED, substeps=SUBSTEPS)
    note = (
        f"`evaluate(..., substeps={SUBSTEPS})`, the environment's simulation with the evaluation's "
        f"bridges, says {found.between_rate:.3%} of {EVALUATED:,} paths of the first plan that is "
        f"promised on the path; judged here {first.judged:.3%}."
    )
    return Section(
        part="risk_path",
        title="Promises on the path",
        about=ABOUT,
        tables={
            "Kept, and at what cost": summary(rows),
            "Every plan": [row.columns() for row in rows],
        },
        notes=(note,),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--episodes", type=int, default=EPISODES, help="paths that judge a plan")
    parser.add_argument(
        "--worlds", type=int, default=WORLDS, help="random ones, beside the paper's"
    )
    options = parser.parse_args()
    rows = summary(measure(options.worlds, options.episodes))
    print(pd.DataFrame(rows).to_markdown(index=False, disable_numparse=True))


if __name__ == "__main__":
    main()

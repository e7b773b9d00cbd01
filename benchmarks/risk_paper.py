"""What counting the noise reaches on the paper's case, on paths that no planner has met."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from report import Section

from slipcar.envs import Scenario
from slipcar.evaluation import Controller, evaluate
from slipcar.evaluation.metrics import Result
from slipcar.planner import Feedback, OpenLoop, Plan, RecedingHorizon, plan

#: Fresh paths of plans, and of receding horizons, which plan at each step.
EPISODES, RECEDING_EPISODES = 100_000, 10_000
#: Of the fresh paths; what `plan` verifies a risk with is drawn in another way.
SEED = 1

ABOUT = f"""\
The scenario `paper`. Every plan is driven over {EPISODES:,} paths that its planner has not met
(`evaluate`, seed {SEED}), receding horizons over the first {RECEDING_EPISODES:,} of them.
*Effort* is measured: it contains what the feedback spends. *Expected* is the planner's own
prediction of the costs that it charges, *measured* the same costs on the paths: effort + obstacle
in open loop, where the mean arrives exactly, and the total with feedback. *Predicted* is Boole's
bound on Gaussian states, *verified* what `p.risk` says of 100 000 paths of its own.
"""


@dataclasses.dataclass(frozen=True)
class Row:
    """One controller.

    Attributes:
        name: how it is called.
        plan: it plays, or begins with.
        driven: what it did.
    """

    name: str
    plan: Plan
    driven: Result

    def columns(self) -> dict[str, Any]:
        """Its row of the table."""
        p, r = self.plan, self.driven
        low, high = r.collision_interval
        expected = p.expected
        closed = p.gains is not None
        return {
            "call": self.name,
            "status": str(p.status),
            "collisions": f"{r.collision_rate:.3%} [{low:.3%}, {high:.3%}]",
            "effort": f"{r.effort:.4f}",
            "total": f"{r.total:.3f} ± {1.96 * r.total_se:.3f}",
            "expected": "" if expected is None else f"{expected.total:.3f}",
            "measured": ""
            if expected is None
            else f"{r.total if closed else r.effort + r.obstacle:.3f}",
            "requested": "" if p.risk is None else f"{p.risk.requested:.1%}",
            "predicted": "" if expected is None else f"{expected.risk:.3%}",
            "verified": "" if p.risk is None else f"{p.risk.verified:.3%}",
            "price": math.nan if p.risk is None else p.risk.price,
            "episodes": r.episodes,
        }


def measure(episodes: int = EPISODES, receding_episodes: int = RECEDING_EPISODES) -> list[Row]:
    """Every row on its paths; receding horizons unless their episodes are 0."""
    s = Scenario.named("paper")
    scp = plan(s)
    steered = plan(s, feedback=True)
    chance = {delta: plan(s, risk=delta) for delta in (0.01, 0.002)}
    safe = plan(s, feedback=True, risk=0.001)
    expected = plan(s, expected=True)
    controllers: list[tuple[str, Plan, Controller, int]] = [
        ("plan(s)", scp, OpenLoop(scp), episodes),
        ("Feedback(plan(s)), LQR tracking", scp, Feedback(scp), episodes),
        ("plan(s, expected=True)", expected, OpenLoop(expected), episodes),
        *((f"plan(s, risk={delta:g})", p, OpenLoop(p), episodes) for delta, p in chance.items()),
        ("plan(s, feedback=True)", steered, Feedback(steered), episodes),
        ("plan(s, feedback=True, risk=0.001)", safe, Feedback(safe), episodes),
    ]
    if receding_episodes:
        price = 0.0 if safe.risk is None else safe.risk.price
        for name, options in (
            ("RecedingHorizon(s)", {}),
            (f"RecedingHorizon(s, risk_price={price:.4g})", {"risk_price": price}),
        ):
            controller = RecedingHorizon(s, **options)
            controllers.append((name, controller.plan, controller, receding_episodes))
    return [
        Row(name, p, evaluate(controller, s, count, SEED))
        for name, p, controller, count in controllers
    ]


def section() -> Section:
    """All of it, to be printed and kept."""
    rows = measure()
    return Section(
        part="risk_paper",
        title="Risk on the paper's case",
        about=ABOUT,
        tables={"Promised, expected and measured": [row.columns() for row in rows]},
        raw={row.name: row.driven.summary() for row in rows},
    )

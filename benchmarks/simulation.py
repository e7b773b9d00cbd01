"""Seconds per 10⁵ evaluated episodes."""

from __future__ import annotations

import time
from typing import Any

from report import Section

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.planner import OpenLoop, plan

ABOUT = """\
One process: `evaluate` of an open-loop plan with all its metrics.
"""


def section() -> Section:
    """All of it, to be printed and kept."""
    return Section(
        part="simulation",
        title="Evaluation",
        about=ABOUT,
        tables={
            "Seconds for 100 000 episodes": evaluation_rows(),
        },
    )


def evaluation_rows() -> list[dict[str, Any]]:
    """Seconds for 10⁵ open-loop episodes with all metrics, one process."""
    scenario = Scenario.named("paper")
    controller = OpenLoop(plan(scenario))
    evaluate(controller, scenario, episodes=1024)
    began = time.perf_counter()
    result = evaluate(controller, scenario, episodes=100_000)
    return [
        {
            "what": "evaluate(open loop, 100 000 episodes)",
            "seconds": time.perf_counter() - began,
            "collisions": result.collision_rate,
        }
    ]

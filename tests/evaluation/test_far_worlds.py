"""A world is the same anywhere: costs do not change when start, goal and obstacles are moved."""

import numpy as np
import pytest

from slipcar.evaluation import evaluate
from slipcar.planner import Feedback, OpenLoop, RecedingHorizon, plan

CONTROLLERS = {
    "open loop": lambda world: OpenLoop(plan(world)),
    "feedback": lambda world: Feedback(plan(world)),
    "receding horizon": RecedingHorizon,
}


@pytest.mark.parametrize("name", CONTROLLERS)
def test_ten_kilometres_away_everything_costs_the_same(paper, name):
    offset = np.array([10_000.0, 20_000.0, 0.0, 0.0, 0.0])
    far = paper.replace(
        start=paper.start + offset,
        goal=paper.goal + offset,
        obstacles=paper.obstacles + offset[:3],
    )
    here, there = (evaluate(CONTROLLERS[name](world), world, 256) for world in (paper, far))
    assert there.total == pytest.approx(here.total, abs=1e-3)
    assert there.collision_rate == here.collision_rate

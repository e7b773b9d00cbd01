"""The driver that ignores obstacles and the planner that ignores noise."""

import numpy as np
import pytest

from slipcar.baselines import deterministic_scp, score, straight
from slipcar.envs import Scenario
from slipcar.envs.observation import observe
from slipcar.planner import OpenLoop, Status, plan

PAPER = Scenario.named("paper")


def without_noise(scenario):
    return scenario.replace(slip=(0.0, 0.0))


def test_straight_is_the_cheapest_way_to_the_goal():
    driver, careful = straight(PAPER), deterministic_scp(PAPER)
    assert driver.plan.status is careful.status is Status.CONVERGED
    assert driver.closed_loop is False
    assert driver.plan.obstacle_cost == 0.0
    assert driver.plan.effort < careful.effort
    found = score(driver, without_noise(PAPER), 1, seed=0)
    assert found.effort == pytest.approx(driver.plan.effort, rel=1e-6)
    assert found.goal < 1e-6


def test_straight_runs_into_what_is_in_the_way():
    ahead = without_noise(Scenario(start=(0, 0, 0, 0, 0), goal=(3, 0, 0, 0, 0)))
    beside, across = (ahead.replace(obstacles=((1.5, y, 0.2),)) for y in (0.4, 0.1))
    assert score(straight(beside), beside, 1, seed=0).collision_rate == 0.0
    assert score(straight(across), across, 1, seed=0).collision_rate == 1.0
    assert score(OpenLoop(deterministic_scp(across)), across, 1, seed=0).collision_rate == 0.0


def test_straight_is_worse_than_the_planner_on_the_papers_world():
    blind, seeing = straight("paper"), OpenLoop(deterministic_scp("paper"))
    a, b = (score(driver, PAPER, 2000, seed=12) for driver in (blind, seeing))
    assert a.collision_rate > 2.0 * b.collision_rate > 0.0
    assert a.total > b.total


def test_straight_reads_observations_of_the_real_scenario():
    driver = straight(PAPER)
    x = np.random.default_rng(0).normal(size=(41, 5))
    wanted = np.clip(driver.plan.controls / PAPER.action_scale, -1.0, 1.0)
    for kind in ("features", "state"):
        action, _ = driver.predict(observe(PAPER, kind, PAPER.times, x))
        np.testing.assert_allclose(action[:-1], wanted, rtol=1e-6)


def test_deterministic_scp_is_the_plan_without_variance_weight():
    ours, theirs = (
        deterministic_scp(PAPER, tolerance=1e-6),
        plan(PAPER, variance_weight=0.0, tolerance=1e-6),
    )
    np.testing.assert_array_equal(ours.controls, theirs.controls)
    assert not np.allclose(ours.controls, plan(PAPER, tolerance=1e-6).controls, atol=1e-3)
    noiseless = plan(without_noise(PAPER), tolerance=1e-6)  # w = 1, but no noise to weigh
    np.testing.assert_allclose(ours.controls, noiseless.controls, atol=1e-6)


def test_bad_arguments():
    with pytest.raises(ValueError, match=r"variance_weight 0 by definition, not 2\.0"):
        deterministic_scp(PAPER, variance_weight=2.0)
    with pytest.raises(ValueError, match="unknown scenario 'moon'"):
        straight("moon")
    with pytest.raises(ValueError, match="unknown scenario 'moon'"):
        deterministic_scp("moon")

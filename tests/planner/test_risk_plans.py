"""`plan(s, risk=δ)`: is the promise kept on paths that planning never saw, and at what cost?"""

import dataclasses

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.planner import Feedback, OpenLoop, Plan, Status, plan
from slipcar.planner.search.risk import wilson_interval

#: Paths that verify in these tests; the default is more.
FEW = 20_000


def wide(rate, episodes):
    """Four standard deviations of a rate."""
    return 4.0 * np.sqrt(rate * (1.0 - rate) / episodes)


def judged(p, scenario, *, episodes=FEW, seed=77):
    """By the evaluation: its environment, its noise."""
    controller = OpenLoop(p) if p.gains is None else Feedback(p)
    return evaluate(controller, scenario, episodes=episodes, seed=seed)


@pytest.fixture(scope="module")
def paper_risks(paper):
    """Open-loop plans, by the risk asked for."""
    return {d: plan(paper, risk=d, risk_episodes=FEW) for d in (0.05, 0.01)}


def consistent(p, delta, episodes=FEW):
    """What `Plan.risk` says of itself."""
    risk = p.risk
    assert risk.requested == delta
    assert risk.episodes == episodes
    assert risk.interval == wilson_interval(round(risk.verified * episodes), episodes)
    assert risk.interval[0] <= risk.verified <= risk.interval[1]
    assert risk.predicted == pytest.approx(p.expected.risk)
    assert 0.0 <= risk.predicted <= 1.0
    assert risk.price >= 0.0
    assert risk.price in [row.price for row in risk.tried]
    assert 0.0 < risk.simulation_time < p.solve_time
    assert p.options["risk"] == delta
    if risk.reached:
        assert p.status is Status.CONVERGED
        assert risk.verified <= delta
    else:
        assert p.status is Status.RISK_UNREACHABLE


# ------------------------------------------------------------------------------ the paper's case


@pytest.mark.parametrize("delta", [0.05, 0.01])
def test_an_open_loop_plan_keeps_its_promise_on_fresh_paths(paper, paper_risks, delta):
    p = paper_risks[delta]
    consistent(p, delta)
    assert p.risk.reached
    assert p.gains is None
    found = judged(p, paper)
    assert found.collision_rate <= delta + wide(delta, FEW)
    # The two measure one thing on different paths.
    spread = wide(p.risk.verified, FEW) * np.sqrt(2.0)
    assert abs(found.collision_rate - p.risk.verified) < spread
    assert found.effort == pytest.approx(p.effort, rel=1e-6)  # open loop: the same on every path
    # Boole's bound, up to what nonlinearity and the first order do.
    assert p.risk.predicted >= 0.9 * p.risk.verified


def test_one_percent_costs_no_more_than_issue_4_allows(paper_risks):
    assert paper_risks[0.01].effort <= 4.70


def test_effort_grows_as_the_risk_falls(paper, paper_risks):
    rows = [(p.risk.price, p.expected.total, p.risk.verified) for p in paper_risks.values()]
    prices, costs, rates = zip(*rows, strict=True)
    assert prices[0] < prices[1]
    assert costs[0] < costs[1]
    assert rates[0] > rates[1]
    frontier = [plan(paper, risk_price=price) for price in (0.0, 1.0, 10.0, 100.0)]
    assert all(p.status.ok for p in frontier)
    assert all(p.risk is None for p in frontier)
    assert (np.diff([p.expected.total for p in frontier]) > 0.0).all()
    assert (np.diff([p.expected.risk for p in frontier]) < 0.0).all()


@pytest.mark.parametrize("options", [{"expected": True}, {"risk_price": 10.0}])
def test_expected_costs_are_those_of_simulated_paths(paper, options):
    """Open loop: effort to rounding, penalties and risk as far as linear dynamics go."""
    p = plan(paper, **options)
    found = judged(p, paper, episodes=40_000)
    assert p.status.ok
    assert p.expected.effort == pytest.approx(found.effort, rel=1e-6)
    assert p.expected.feedback == 0.0
    assert p.expected.goal == 0.0
    # A disc's potential is not affine in the state: too much, but a small part of the whole.
    assert 0.9 * found.obstacle < p.expected.penalty < 2.0 * found.obstacle
    total = found.effort + found.obstacle
    assert p.expected.total == pytest.approx(total, rel=0.02)
    # Boole's bound: above, but not by much.
    assert 0.9 * found.collision_rate < p.expected.risk < 4.0 * found.collision_rate
    assert p.expected.total == pytest.approx(p.expected.effort + p.expected.penalty)


def test_a_price_of_zero_is_an_expected_cost(paper):
    a, b = plan(paper, risk_price=0.0), plan(paper, expected=True)
    np.testing.assert_array_equal(a.controls, b.controls)
    assert a.expected == b.expected


def test_expected_costs_are_lower_than_those_of_the_plan_of_the_mean(paper):
    """Also with simulated paths, of which the planner knows nothing."""
    mean, steered = plan(paper, variance_weight=0.0), plan(paper, expected=True)
    costs = [judged(p, paper, episodes=20_000) for p in (mean, steered)]
    totals = [row.effort + row.obstacle for row in costs]
    assert totals[1] < totals[0]
    assert costs[1].collision_rate < 0.7 * costs[0].collision_rate


def test_the_same_call_gives_the_same_bits(paper, paper_risks):
    again = plan(paper, risk=0.05, risk_episodes=FEW)
    known = paper_risks[0.05]
    np.testing.assert_array_equal(again.controls, known.controls)
    np.testing.assert_array_equal(again.mean, known.mean)
    assert again.expected == known.expected
    known = dataclasses.replace(known.risk, simulation_time=0.0)
    assert dataclasses.replace(again.risk, simulation_time=0.0) == known


def test_numpy_finds_what_compiled_code_finds(paper):
    fast = plan(paper, risk_price=3.0)
    slow = plan(paper, risk_price=3.0, compiled=False)
    assert slow.status.ok
    np.testing.assert_allclose(fast.controls, slow.controls, atol=1e-6)
    assert fast.expected.total == pytest.approx(slow.expected.total, rel=1e-7)


def test_a_saved_plan_of_a_risk_comes_back_whole(paper_risks, tmp_path):
    for p in paper_risks.values():
        back = Plan.load(p.save(tmp_path / "plan.npz"))
        assert back.risk == p.risk
        assert back.expected == p.expected
        assert back.status is p.status
        np.testing.assert_array_equal(back.controls, p.controls)
        np.testing.assert_array_equal(back.covariance, p.covariance)
        assert back.options["risk"] == p.options["risk"]
        assert str(back.risk) == str(p.risk)


def test_a_plan_of_an_expected_cost_has_no_certificate_of_the_mean(paper_risks):
    with pytest.raises(ValueError, match="certificate is of plans of the mean"):
        _ = paper_risks[0.01].certificate


def test_a_plan_warm_starts_the_next(paper, paper_risks):
    p = plan(paper, risk_price=paper_risks[0.01].risk.price, guess=paper_risks[0.01])
    assert p.status.ok
    np.testing.assert_allclose(p.controls, paper_risks[0.01].controls, atol=0.1)


# ------------------------------------------------------------------------------ other worlds


@pytest.mark.parametrize("seed", [0, 2, 5, 9])
def test_random_worlds_keep_the_risk_or_say_that_they_cannot(seed):
    world = Scenario.random(seed, turned=seed % 2 == 1)
    delta, feedback = 0.05, seed % 2 == 0
    p = plan(world, risk=delta, feedback=feedback, risk_episodes=FEW)
    consistent(p, delta)
    found = judged(p, world, episodes=10_000)
    assert abs(found.collision_rate - p.risk.verified) < wide(found.collision_rate + 1e-3, 5_000)
    if p.risk.reached:
        assert found.collision_rate <= delta + wide(delta, 10_000)
    else:
        assert found.collision_rate > delta - wide(delta, 10_000)


def test_without_obstacles_safety_is_free(paper):
    world = paper.replace(obstacles=np.zeros((0, 3)))
    p = plan(world, risk=0.01, risk_episodes=2000)
    consistent(p, 0.01, 2000)
    assert p.risk.reached
    assert p.risk.price == 0.0
    assert p.risk.predicted == p.risk.verified == 0.0
    assert len(p.risk.tried) == 1
    np.testing.assert_allclose(p.controls, plan(world, variance_weight=0.0).controls, atol=1e-3)


def test_without_noise_safety_is_free(paper):
    p = plan(paper.replace(slip=(0.0, 0.0)), risk=0.05, risk_episodes=1000)
    assert p.risk.reached
    assert (p.risk.price, p.risk.verified) == (0.0, 0.0)
    assert not p.covariance.any()
    assert p.effort == pytest.approx(4.398, abs=0.05)  # that of the mean


def test_a_risk_out_of_reach_is_said_with_the_least_found(paper):
    """A goal at the edge of a disc: about half of all ends lie within, whatever the way there."""
    x, y = paper.goal[:2]
    edge = [x + 0.3 + 1e-6, y, 0.3]
    world = paper.replace(obstacles=np.vstack([paper.obstacles, edge]))
    p = plan(world, risk=0.05, risk_episodes=2000)
    assert p.status is Status.RISK_UNREACHABLE
    consistent(p, 0.05, 2000)
    assert not p.risk.reached
    assert 0.25 < p.risk.verified < 0.75
    assert f"{p.risk.verified:.4g}" in p.message
    assert "0.05" in p.message
    # It is the least that was found.
    solved = [row.rate for row in p.risk.tried if row.rate is not None]
    at = next(row.rate for row in p.risk.tried if row.price == p.risk.price and row.rate)
    assert at == min(solved)


def test_a_wall_without_a_gap_cannot_be_kept_clear_of(paper):
    wall = [(x, 1.5, 0.6) for x in np.arange(-6.0, 9.0, 0.8)]
    p = plan(paper.replace(obstacles=wall), risk=0.05, risk_episodes=500, max_iterations=30)
    assert not p.status.ok
    assert p.status is not Status.STOPPED
    if p.risk is not None:
        assert p.risk.verified > 0.05
        assert not p.risk.reached

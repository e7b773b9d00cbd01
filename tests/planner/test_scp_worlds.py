"""Convergence over many worlds, symmetries, refinement of the time grid."""

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status, plan


def test_two_hundred_random_worlds(rollout):
    counts = []
    for seed in range(200):
        scenario = Scenario.random(seed)
        assert 1 <= len(scenario.obstacles) <= 8
        p = plan(scenario)
        counts.append(p.status is Status.CONVERGED and p.history[-1].virtual_control < 1e-9)
        if p.status is Status.CONVERGED:
            # Nothing is called converged that its own controls do not do.
            assert np.max(np.abs(rollout(scenario, p.controls) - p.mean)) < 1e-3
            assert np.max(np.abs(p.mean[-1] - scenario.goal)) < 1e-6
            assert np.all(np.abs(p.controls) <= scenario.control_bounds)
    assert np.mean(counts) >= 0.97


def turned(scenario, angle, shift):
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s], [s, c]])

    def pose(x):
        return np.concatenate([R @ x[:2] + shift, [x[2] + angle], x[3:]])

    obstacles = np.column_stack([scenario.obstacles[:, :2] @ R.T + shift, scenario.obstacles[:, 2]])
    moved = scenario.replace(
        start=pose(scenario.start), goal=pose(scenario.goal), obstacles=obstacles
    )
    return moved, lambda path: np.array([pose(x) for x in path])


@pytest.mark.parametrize("angle", [0.5, 2.0, 3.0, 10.0, -1.0, -2.5])
def test_a_turned_and_shifted_world_has_the_same_plan(paper, angle):
    world, move = turned(paper, angle, np.array([3.0, -7.0]))
    p, q = plan(paper, tolerance=1e-10), plan(world, tolerance=1e-10)
    np.testing.assert_allclose(q.controls, p.controls, atol=1e-6)
    np.testing.assert_allclose(q.mean, move(p.mean), atol=1e-6)
    assert q.variance == pytest.approx(p.variance, rel=1e-6)


@pytest.mark.parametrize("angle", [0.5, 2.5, 3.0, -4.0, 10.0])
@pytest.mark.parametrize("seed", [0, 4, 11])
def test_the_iteration_itself_knows_no_direction(seed, angle):
    # The guess turned along with the world: the same steps, whatever branch the angles are on.
    scenario = Scenario.random(seed)
    world, move = turned(scenario, angle, np.array([-20.0, 5.0]))
    x, u = scenario.initial_guess()
    p = plan(scenario, guess=(x, u), tolerance=1e-8, cold_start="never")
    q = plan(world, guess=(move(x), u), tolerance=1e-8, cold_start="never")
    assert q.status is p.status
    np.testing.assert_allclose(q.controls, p.controls, atol=1e-6)
    np.testing.assert_allclose(q.mean, move(p.mean), atol=1e-6)


@pytest.mark.parametrize("seed", [None, 2, 7])
def test_a_mirrored_world_has_the_mirrored_plan(paper, seed):
    scenario = paper if seed is None else Scenario.random(seed)
    flip = np.array([1.0, -1.0, -1.0, 1.0, -1.0])
    mirrored = scenario.replace(
        start=flip * scenario.start,
        goal=flip * scenario.goal,
        obstacles=scenario.obstacles * np.array([1.0, -1.0, 1.0]),
    )
    p, q = plan(scenario, tolerance=1e-8), plan(mirrored, tolerance=1e-8)
    np.testing.assert_allclose(q.controls, p.controls * np.array([1.0, -1.0]), atol=1e-6)
    np.testing.assert_allclose(q.mean, p.mean * flip, atol=1e-6)


def test_doubling_slip_and_quartering_the_weight_changes_nothing(paper):
    # tr Σ is quadratic in σ.
    p = plan(paper, variance_weight=8.0, tolerance=1e-10)
    q = plan(paper.replace(slip=2.0 * paper.slip), variance_weight=2.0, tolerance=1e-10)
    np.testing.assert_allclose(q.controls, p.controls, atol=1e-8)
    assert q.variance == pytest.approx(4.0 * p.variance, rel=1e-8)


def test_refining_the_time_grid_converges_at_first_order():
    # Forward Euler: halving dt halves the distance to the limit. (From rest to rest the problem
    # looks the same backwards in time and the first-order error cancels; so it starts rolling.)
    scenario = Scenario.named("open").replace(start=(0.0, 0.0, 0.0, 0.8, 0.0))
    efforts = [
        plan(scenario.replace(nodes=nodes), variance_weight=0.0, tolerance=1e-8).effort
        for nodes in (21, 41, 81, 161, 321)
    ]
    change = np.diff(efforts)
    ratios = change[:-1] / change[1:]
    assert np.all((ratios > 1.9) & (ratios < 2.2))
    assert abs(change[-1]) < 1e-2 * efforts[-1]


def test_refining_the_time_grid_with_obstacles(paper):
    costs = [
        plan(paper.replace(nodes=nodes), variance_weight=0.0, tolerance=1e-8).cost
        for nodes in (41, 161, 641)
    ]
    assert abs(costs[2] - costs[1]) < 0.4 * abs(costs[1] - costs[0])

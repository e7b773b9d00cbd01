"""What text and release say, rewritten: checked against algebra, differences and brute force."""

import numpy as np
import pytest

from slipcar.evaluation import sample_paths
from slipcar.evaluation.reproduction.runs import path_moments, played, trace_integral
from slipcar.evaluation.reproduction.variants import (
    PrintedPotential,
    iterations_needed,
    out_of_reach,
    printed_cost,
    released_covariance,
    released_start,
    released_trust_region,
    stopping_values,
    text_covariance,
)
from slipcar.planner import plan


@pytest.fixture(scope="module")
def ours():
    from slipcar.envs import Scenario

    return plan(Scenario.named("paper"), method="convex")


def with_noise(scenario, mean, noise):
    """Σ by forward Euler for a given σσᵀ at every node, written out for the car."""
    S = [np.zeros((5, 5))]
    for x, added in zip(mean, noise, strict=False):
        A = np.zeros((5, 5))
        A[0, 2], A[1, 2] = -x[3] * np.sin(x[2]), x[3] * np.cos(x[2])
        A[0, 3], A[1, 3], A[2, 4] = np.cos(x[2]), np.sin(x[2]), 1.0
        S.append(S[-1] + scenario.dt * (A @ S[-1] + S[-1] @ A.T + added))
    return np.array(S)


def test_covariance_steps_are_those_of_their_sources(paper):
    rng = np.random.default_rng(0)
    at, mean = rng.normal(size=(2, paper.nodes, 5))
    gains = np.diag([0.1, 0.1, 0.01, 0.0, 0.0])

    def product(x, y):
        return x[:-1, 3] * y[:-1, 4]

    # S(x) = Σ ∂σ/∂x_i x_i at μ_k is (ω_k v + v_k ω) times the gains, and B = σ − S(μ_k) = −σ.
    own, other = product(at, at), product(mean, at) + product(at, mean)
    noise = (own**2 + other * 2.0 * own)[:, None, None] * gains**2
    np.testing.assert_allclose(
        released_covariance(paper, mean, at), with_noise(paper, at, noise), rtol=1e-10, atol=1e-12
    )
    exact = (product(mean, mean) ** 2)[:, None, None] * gains**2
    np.testing.assert_allclose(
        text_covariance(paper, mean), with_noise(paper, mean, exact), rtol=1e-10, atol=1e-12
    )
    # The cross terms B Sᵀ + S Bᵀ make the difference: with them the product is σσᵀ again.
    np.testing.assert_allclose(
        released_covariance(paper, mean), 5.0 * text_covariance(paper, mean), rtol=1e-9, atol=1e-12
    )


def test_the_texts_step_nears_the_exact_one_as_the_grid_is_refined(paper):
    gaps = []
    for nodes in (41, 81, 161):
        s = paper.replace(nodes=nodes)
        found = plan(s)
        text = trace_integral(text_covariance(s, found.mean), s.dt)
        gaps.append(abs(text / found.variance - 1.0))
    assert gaps[0] < 0.002
    np.testing.assert_allclose(np.log2(np.divide(gaps[:-1], gaps[1:])), 1.0, atol=0.3)


def test_moments_of_paths_are_those_of_the_recorded_ones(paper, ours):
    moments = path_moments(ours, paper, 1500, seed=4)
    states, _ = sample_paths(played(ours, paper), paper, 1500, seed=4)
    np.testing.assert_allclose(moments.mean, states.mean(axis=0), atol=1e-12)
    for k in (1, 20, 40):
        np.testing.assert_allclose(
            moments.covariance[k], np.cov(states[:, k].T, bias=True), atol=1e-12
        )
    np.testing.assert_array_equal(moments.spread, np.ptp(states[..., 3:], axis=0).max(axis=0))
    off = states[:, -1, :2] - ours.mean[-1, :2]
    L = np.linalg.cholesky(ours.covariance[-1, :2, :2])
    radius = np.linalg.norm(np.linalg.solve(L, off.T), axis=0)
    assert moments.inside == np.mean(radius <= 2.4477468306808166)  # of χ with two degrees
    assert 0.93 < moments.inside < 0.97
    measured, error = moments.variance
    assert abs(measured - ours.variance) < 4.0 * error
    # One path has no spread, and its error is unknown.
    single = path_moments(ours, paper, 1)
    assert single.variance[0] == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(single.variance[1])


def test_the_printed_potential_pays_for_depth(paper):
    problem = PrintedPotential(paper)
    x, y, radius = paper.obstacles[1]
    reach = radius + paper.clearance
    depth = np.array([-0.1, 0.0, 0.5, 1.0])  # outside, on the ring, half way, at the centre
    states = np.zeros((4, 5))
    states[:, 0], states[:, 1] = x + reach * (1.0 - depth), y
    cost = problem.state_cost(None, states)
    expected = paper.obstacle_weight * np.minimum((reach * (1.0 - depth)) ** 2 - reach**2, 0.0)
    np.testing.assert_allclose(cost, expected, atol=1e-10)
    assert (np.diff(cost[1:]) < 0.0).all()
    rng = np.random.default_rng(0)
    states = rng.uniform(0.0, 2.5, size=(200, 5))
    gradient, hessian = problem.state_cost_derivatives(None, states)
    h = 1e-6
    away = np.abs(paper.penalty(None, states)).min(axis=1) > 0.01  # off the rims, where it kinks
    for i in range(5):
        step = h * np.eye(5)[i]
        above, below = (problem.state_cost(None, states + sign * step) for sign in (1.0, -1.0))
        np.testing.assert_allclose(gradient[away, i], ((above - below) / (2 * h))[away], atol=1e-4)
        ahead = problem.state_cost_derivatives(None, states + step)[0]
        np.testing.assert_allclose(
            hessian[away, i], ((ahead - gradient) / h)[away], atol=1e-2, rtol=1e-4
        )


def test_a_plan_with_the_printed_potential_drives_into_obstacles(paper, ours):
    found = plan(PrintedPotential(paper), method="convex")
    assert found.status.ok
    assert paper.signed_distance(found.mean[1:]).min() < -0.1
    assert printed_cost(paper, found.mean) < 50.0 * printed_cost(paper, ours.mean) < 0.0
    # What it minimises is less than our plan costs by the same measure.
    assert found.effort + printed_cost(paper, found.mean) < ours.effort


def driven(scenario, x, u, e):
    """End of the dynamics linearised along (x, u) under control deviations e, by stepping them."""
    d = np.zeros(5)
    for k in range(len(u)):
        theta, v = x[k, 2:4]
        rate = np.array([
            -v * np.sin(theta) * d[2] + np.cos(theta) * d[3],
            v * np.cos(theta) * d[2] + np.sin(theta) * d[3],
            d[4], e[k, 0], e[k, 1],
        ])  # fmt: skip
        moved = x[k] + scenario.dt * scenario.drift(None, x[k], u[k])
        d = d + scenario.dt * rate + moved - x[k + 1]
    return x[-1] + d


def test_the_released_start_leaves_the_goal_out_of_reach(paper):
    x, u = released_start(paper)
    assert not x[:, 2:].any()
    np.testing.assert_array_equal(x[[0, -1], :2], [paper.start[:2], paper.goal[:2]])
    lacks = out_of_reach(paper, x, u)
    np.testing.assert_allclose(lacks, [0.0, 3.0, 0.0, 0.0, 0.0], atol=1e-9)
    rng = np.random.default_rng(0)
    ends = [driven(paper, x, u, rng.normal(scale=10.0, size=u.shape)) for _ in range(5)]
    np.testing.assert_allclose([end[1] for end in ends], 0.0, atol=1e-12)  # whatever the control
    assert np.ptp([end[0] for end in ends]) > 1.0
    np.testing.assert_allclose(out_of_reach(paper, *paper.initial_guess()), 0.0, atol=1e-9)


def test_stopping_values_are_the_planners(ours):
    steps = np.array([iterate.step for iterate in ours.history])
    values = stopping_values(ours)
    np.testing.assert_allclose(values[1:], steps[1:] + steps[:-1], rtol=1e-9)
    assert values[0] == np.inf
    assert iterations_needed(ours) == ours.iterations
    tight = plan(ours.problem, method="convex", tolerance=1e-14)
    assert iterations_needed(tight) == ours.iterations < iterations_needed(tight, squared=False)
    assert iterations_needed(ours, 1e-30) == 0


def test_the_released_trust_region_is_far_from_active(paper, ours):
    first = ours.history[0].mean
    apart = ((first - ours.guess) ** 2).sum(axis=1)
    assert apart.max() < released_trust_region(ours) < apart.max() + 1.0

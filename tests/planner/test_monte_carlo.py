"""Counted violations against closed forms, and the numbers that describe a risk."""

import json
import math
import types

import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal, norm

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.evaluation import statistics as evaluation_statistics
from slipcar.evaluation.noise import block_noise
from slipcar.planner import Feedback, OpenLoop, plan
from slipcar.planner.moments.monte_carlo import violations
from slipcar.planner.search.risk import PricedRate, Risk, check_risk, wilson_interval

EPISODES = 100_000


def linear(pull=0.0, noise=1.0, start=0.0, times=(0.0, 1.0), bound=1.0, at=None):
    """dx = (−pull·x + u) dt + noise dB in one dimension, to stay below `bound` (at time `at`)."""

    def constraint(t, x):
        h = x - bound
        return h if at is None else np.where(np.isclose(t, at)[..., None], h, -1.0)

    return types.SimpleNamespace(
        start=np.array([start]),
        times=np.asarray(times, dtype=float),
        control_weight=np.eye(1),
        drift=lambda t, x, u: u - pull * x,
        diffusion=lambda t, x: np.full((*x.shape, 1), noise),
        terminal=lambda x: x,
        constraint=constraint,
    )


def still(t, x):
    return np.zeros(1)


def assert_rate(found, probability):
    """A count that chance brings about less often than once in 10⁵ is an error."""
    count, n = int(found.sum()), len(found)
    low, high = binom.ppf([5e-6, 1.0 - 5e-6], n, probability)
    assert low <= count <= high, f"{count} of {n}, expected {n * probability:.1f}"


@pytest.mark.parametrize("dt", [0.25, 4.0])
@pytest.mark.parametrize("bound", [0.0, 1.0, 3.0])
def test_one_step_of_brownian_motion_is_the_normal_tail(bound, dt):
    problem = linear(noise=0.7, start=0.1, times=(2.0, 2.0 + dt), bound=bound)
    found = violations(problem, still, episodes=EPISODES, seed=1)
    assert found.shape == (EPISODES,)
    assert found.dtype == bool
    assert_rate(found, norm.sf((bound - 0.1) / (0.7 * np.sqrt(dt))))


def test_two_nodes_are_a_bivariate_normal():
    times = np.array([0.0, 0.3, 1.0])
    found = violations(linear(times=times, bound=0.8), still, episodes=EPISODES, seed=2)
    covariance = np.minimum.outer(times[1:], times[1:])
    both_below = multivariate_normal.cdf([0.8, 0.8], [0.0, 0.0], covariance)
    assert_rate(found, 1.0 - both_below)


def test_end_of_an_ornstein_uhlenbeck_chain():
    times, pull = np.array([0.0, 0.1, 0.3, 0.4, 0.7, 1.2, 1.5]), 0.8
    mean, variance = 2.0, 0.0
    for dt in np.diff(times):
        mean, variance = (1 - pull * dt) * mean, (1 - pull * dt) ** 2 * variance + 0.25 * dt
    problem = linear(pull, noise=0.5, start=2.0, times=times, bound=1.2, at=1.5)
    found = violations(problem, still, episodes=EPISODES, seed=3)
    assert_rate(found, norm.sf((1.2 - mean) / np.sqrt(variance)))


def test_correlated_noise_of_more_motions_than_states():
    sigma = np.array([[0.3, 0.4, 0.0], [0.0, -0.5, 1.2]])
    problem = linear()
    problem.start = np.zeros(2)
    problem.drift = lambda t, x, u: 0.0 * x + u
    problem.diffusion = lambda t, x: np.broadcast_to(sigma, (*x.shape[:-1], 2, 3))
    problem.constraint = lambda t, x: (x.sum(axis=-1) - 1.0)[..., None]
    found = violations(problem, still, episodes=EPISODES, seed=4)
    assert_rate(found, norm.sf(1.0 / np.linalg.norm(sigma.sum(axis=0))))


def test_the_start_is_not_judged():
    problem = linear(noise=0.0, start=5.0, times=(0.0, 1.0), bound=1.0)
    found = violations(problem, lambda t, x: np.array([-5.0]), episodes=10, seed=0)
    assert not found.any()


def test_a_bound_that_is_touched_is_kept():
    problem = linear(noise=0.0, bound=0.0)
    assert not violations(problem, still, episodes=10, seed=0).any()


def test_a_feedback_changes_the_distribution_as_it_should():
    # u = −x/dt puts the state at pure noise of one step, whatever was before.
    times = np.linspace(0.0, 2.0, 5)
    problem = linear(noise=1.0, times=times, bound=1.5)
    free = violations(problem, still, episodes=EPISODES, seed=5)
    steered = violations(problem, lambda t, x: -x / 0.5, episodes=EPISODES, seed=5)
    assert_rate(steered, 1.0 - norm.cdf(1.5 / np.sqrt(0.5)) ** 4)
    assert steered.sum() < free.sum()


def test_the_control_is_called_at_every_node_but_the_last():
    seen = []

    def control(t, x):
        seen.append(t)
        return np.zeros((len(x), 1))

    times = (0.0, 0.5, 0.75, 2.0)
    violations(linear(times=times), control, episodes=1, seed=0)
    assert seen == [0.0, 0.5, 0.75]


def test_controls_are_projected_when_asked():
    def push(t, x):
        return np.full((len(x), 1), 10.0)

    problem = linear(noise=0.0, bound=1.0)
    assert violations(problem, push, episodes=3, seed=0).all()
    clipped = violations(problem, push, episodes=3, seed=0, project=lambda u: np.clip(u, -0.5, 0.5))
    assert not clipped.any()


def test_a_path_depends_on_the_seed_and_its_index_alone():
    problem = linear(times=np.linspace(0.0, 1.0, 6))
    long = violations(problem, still, episodes=9_000, seed=7)
    for n in (1, 2_048, 2_049, 5_000):
        np.testing.assert_array_equal(violations(problem, still, episodes=n, seed=7), long[:n])
    other = violations(problem, still, episodes=9_000, seed=8)
    assert 0.2 < np.mean(long != other) < 0.6  # two independent draws of p = 0.24 and more
    parts = long[:8_192].reshape(4, -1)
    assert not any((parts[0] == part).all() for part in parts[1:])  # nor do blocks repeat


def test_two_controllers_meet_the_same_noise():
    # Brownian motion with drift c beyond b violates where the one without goes beyond b − c.
    problem, near = linear(bound=1.0), linear(bound=0.6)
    pushed = violations(problem, lambda t, x: np.array([0.4]), episodes=5_000, seed=9)
    np.testing.assert_array_equal(pushed, violations(near, still, episodes=5_000, seed=9))


def test_paths_that_are_lost_count_as_violations():
    # Beyond 1 the state runs off to infinity, where no bound is ever seen to be broken.
    problem = linear(times=(0.0, 1.0, 2.0, 3.0))
    problem.diffusion = lambda t, x: np.where(t < 0.5, 1.0, 0.0)[..., None, None]
    problem.drift = lambda t, x, u: u + np.where(x > 1.0, np.inf, 0.0)
    problem.constraint = lambda t, x: np.full((*x.shape[:-1], 1), -1.0)
    finite = []

    def control(t, x):
        finite.append(np.isfinite(x).all())
        return np.zeros_like(x)

    assert_rate(violations(problem, control, episodes=EPISODES, seed=10), norm.sf(1.0))
    assert all(finite)  # controllers never see such a state


def test_a_constraint_that_is_no_number_counts_as_violated():
    problem = linear()
    problem.constraint = lambda t, x: np.where(x > 1.0, np.nan, -1.0)
    assert_rate(violations(problem, still, episodes=EPISODES, seed=11), norm.sf(1.0))


def test_no_rows_no_violations(paper):
    empty = paper.replace(obstacles=[])
    controls = np.zeros((40, 2))
    driver = types.SimpleNamespace(control=lambda t, x: controls[0])
    assert not violations(empty, driver.control, episodes=5, seed=0).any()


@pytest.mark.parametrize("controller", [OpenLoop, Feedback])
def test_the_car_collides_as_often_as_in_the_evaluation(paper, controller):
    driver = controller(plan(paper))
    n = 40_000
    ours = violations(paper, driver.control, episodes=n, seed=0).mean()
    theirs = evaluate(driver, paper, episodes=n, seed=0)
    p = 0.5 * (ours + theirs.collision_rate)
    assert abs(ours - theirs.collision_rate) < 4.5 * np.sqrt(2.0 * p * (1.0 - p) / n)


@pytest.mark.parametrize("seed", [0, 3])
def test_evaluations_with_the_same_seed_meet_other_noise(seed):
    # Or a plan would be judged by the paths its price was chosen on.
    problem = linear(bound=0.0)
    problem.start = np.zeros(3)
    problem.drift = lambda t, x, u: 0.0 * x
    problem.diffusion = lambda t, x: np.broadcast_to(np.eye(3), (*x.shape, 3))
    for block in (0, 1):
        theirs = next(block_noise(seed, block, Scenario.named("paper")))[:, 0] > 0.0
        for i in range(3):
            problem.constraint = lambda t, x, i=i: x[..., i : i + 1]
            ours = violations(problem, still, episodes=4_096, seed=seed).reshape(4, -1)
            for part in ours:
                assert abs(np.mean(part == theirs[:, i]) - 0.5) < 4.5 * 0.5 / np.sqrt(1_024)


def test_bad_input_is_named(paper):
    problem = linear()
    for episodes in (0, -1, 2.5, True):
        with pytest.raises(ValueError, match="episodes"):
            violations(problem, still, episodes=episodes, seed=0)
    with pytest.raises(ValueError, match="seed"):
        violations(problem, still, episodes=1, seed=-1)
    with pytest.raises(ValueError, match=r"control\(t, x\).*\(3,\)"):
        violations(problem, lambda t, x: np.zeros(3), episodes=1, seed=0)
    problem.constraint = lambda t, x: x[..., 0]
    with pytest.raises(ValueError, match=r"constraint\(t, x\)"):
        violations(problem, still, episodes=1, seed=0)
    del problem.constraint
    with pytest.raises(ValueError, match="no constraint"):
        violations(problem, still, episodes=1, seed=0)


# ---------------------------------------------------------------- what describes a risk


def some_risk(**changes):
    fields = {
        "requested": 0.01,
        "predicted": 0.0134,
        "verified": 0.0092,
        "interval": (0.0086, 0.0098),
        "episodes": 100_000,
        "price": 12.3,
        "reached": True,
        "tried": (PricedRate(9.0, 0.017, 0.0107), PricedRate(1e3, None, None)),
        "simulation_time": 1.25,
    }
    return Risk(**{**fields, **changes})


def test_a_risk_survives_json():
    risk = some_risk(verified=np.float64(0.0092), reached=np.bool_(True))
    text = json.dumps(risk.as_dict(), allow_nan=False)
    assert Risk.from_dict(json.loads(text)) == some_risk()


@pytest.mark.parametrize("change", [{"price": None, "extra": 1}, {"interval": [0.1]}, {"tried": 3}])
def test_data_that_is_no_risk_is_refused(change):
    with pytest.raises(ValueError, match="not the data of a Risk"):
        Risk.from_dict({**some_risk().as_dict(), **change})
    with pytest.raises(ValueError, match="not the data of a Risk"):
        Risk.from_dict({})


def test_a_risk_is_told_in_a_line():
    line = str(some_risk())
    assert "\n" not in line
    for part in ("0.920%", "0.860%", "0.980%", "1.000%", "1.340%", "100,000", "12.3"):
        assert part in line
    assert "not reached" not in line
    assert "not reached" in str(some_risk(reached=False))


@pytest.mark.parametrize("good", [0.01, np.float32(0.5), 1e-9, 1.0 - 1e-9])
def test_probabilities_are_risks(good):
    check_risk(good)


@pytest.mark.parametrize(
    "bad", [0, 1, 0.0, 1.0, -0.1, 1.5, math.nan, math.inf, True, "0.01", None, [0.01], 0.1j]
)
def test_all_else_is_no_risk(bad):
    with pytest.raises(ValueError, match="risk must be") as error:
        check_risk(bad)
    assert repr(bad) in str(error.value)


def test_arrays_are_no_risk():
    for bad in (np.array(0.1), np.array([0.1]), np.array([0.1, 0.2])):
        with pytest.raises(ValueError, match="risk must be"):
            check_risk(bad)


@pytest.mark.parametrize(("k", "n"), [(0, 7), (1, 10), (60, 1000), (10, 10)])
@pytest.mark.parametrize("level", [0.5, 0.95, 0.999])
def test_wilson_interval_solves_its_quadratic(k, n, level):
    z = norm.isf(0.5 * (1.0 - level))
    low, high = wilson_interval(k, n, level)
    assert 0.0 <= low <= k / n <= high <= 1.0
    for p in (low, high):
        assert abs(k / n - p) == pytest.approx(z * np.sqrt(p * (1.0 - p) / n), abs=1e-12)


def test_there_is_one_wilson_interval():
    assert evaluation_statistics.wilson_interval is wilson_interval


@pytest.mark.parametrize("numbers", [(-1, 10), (11, 10), (0, 0), (1, 10, 1.0), (1, 10, math.nan)])
def test_impossible_counts_are_refused(numbers):
    with pytest.raises(ValueError, match=r"trials|level"):
        wilson_interval(*numbers)

"""Collisions between nodes, against bridges that are sampled finely."""

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate, sample_paths
from slipcar.evaluation.between import log_clear

H, RADIUS = 0.125, 0.25


@pytest.fixture
def disc(paper):
    return paper.replace(start=(3, 3, 0, 0, 0), obstacles=((0.0, 0.0, RADIUS),))


def touched(scenario, a, b, speed):
    """Of a car that turns at 1 rad/s: the noise is α² · speed per √s."""
    before = [np.array([value]) for value in (*a, 0.0, speed, 1.0)]
    after = [np.array([value]) for value in b]
    return 1.0 - np.exp(log_clear(scenario, before, after, H)[0])


def sampled(a, b, deviation, steps=1000, paths=20_000):
    """Share of bridges from a to b that enter the disc (Broadie's shift for the time grid).

    `deviation` of the noise is one number, or one for x and one for y.
    """
    rng = np.random.default_rng(0)
    x, hit, dt = np.tile(np.asarray(a, float), (paths, 1)), np.zeros(paths, bool), H / steps
    deviation = np.broadcast_to(deviation, 2)
    for j in range(steps - 1):
        left = H - j * dt
        x = x + (b - x) * dt / left
        x += deviation * np.sqrt(dt * (left - dt) / left) * rng.normal(size=x.shape)
        distance = np.hypot(*x.T)
        across = np.hypot(*(x * deviation).T) / distance  # the noise towards the rim
        hit |= distance < RADIUS + 0.5826 * across * np.sqrt(dt)
    return hit.mean()


@pytest.mark.parametrize(
    ("a", "b", "speed"),
    [
        ((-0.1, 0.3), (0.1, 0.3), 1.0),  # past the top
        ((0.3, 0.0), (0.31, 0.1), 1.5),  # away from it, round the rim
        ((0.3, -0.05), (0.4, 0.1), 2.0),
        ((0.28, 0.0), (0.35, 0.2), 1.0),  # from close by, away
    ],
)
def test_the_probability_is_that_of_sampled_bridges(disc, a, b, speed):
    expected = sampled(a, b, 0.1 * speed)
    error = np.sqrt(expected * (1.0 - expected) / 20_000)
    found = touched(disc, a, b, speed)
    assert found >= expected - 3.0 * error  # if anything, on the safe side
    assert found == pytest.approx(expected, rel=0.2, abs=3.0 * error)


def test_without_noise_the_path_is_the_chord(disc):
    assert touched(disc, (-0.3, 0.2), (0.3, 0.2), 0.0) == 1.0  # nodes outside, chord inside
    assert touched(disc, (-0.3, 0.26), (0.3, 0.26), 0.0) == 0.0


def test_process_noise_counts(disc):
    noisy = disc.replace(process_noise=(0.1, 0.1, 0, 0, 0))
    still = [(-0.1, 0.3), (0.1, 0.3)]
    assert touched(noisy, *still, 0.0) == pytest.approx(touched(disc, *still, 1.0), rel=1e-9)


@pytest.mark.parametrize(
    ("a", "b", "noise"),
    [
        ((-0.1, 0.3), (0.1, 0.3), (0.02, 0.2)),  # towards the rim
        ((0.2, 0.25), (0.28, 0.15), (0.2, 0.03)),  # askew
        ((0.2, 0.25), (0.28, 0.15), (0.05, 0.4)),
        ((0.25, 0.27), (0.44, 0.25), (0.6, 0.06)),  # along the rim most of all
    ],
)
def test_noise_may_depend_on_direction(disc, a, b, noise):
    expected = sampled(a, b, noise)
    error = np.sqrt(expected * (1.0 - expected) / 20_000)
    found = touched(disc.replace(process_noise=(*noise, 0, 0, 0)), a, b, 0.0)
    assert 0.001 < expected < 0.5
    assert found == pytest.approx(expected, rel=0.2, abs=3.0 * error)


def test_noise_that_hardly_depends_on_direction_is_as_good_as_any(disc):
    a, b = (0.3, -0.05), (0.4, 0.1)
    even, uneven = (
        touched(disc.replace(process_noise=(0.2, y, 0, 0, 0)), a, b, 0.0) for y in (0.2, 0.2 + 1e-9)
    )
    assert uneven == pytest.approx(even, rel=1e-6)
    along = disc.replace(process_noise=(0.2, 0.0, 0, 0, 0))
    assert touched(along, (-0.1, 0.3), (0.1, 0.3), 0.0) == 0.0  # it never leaves y = 0.3


def test_it_turns_with_the_world(disc):
    a, b = np.array([-0.1, 0.3]), np.array([0.12, 0.33])
    for angle in (0.7, 2.0, -1.3):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        assert touched(disc, turn @ a, turn @ b, 1.5) == pytest.approx(touched(disc, a, b, 1.5))


def test_known_distances_only_save_work(paper, replay, turning):
    x, _ = sample_paths(replay(paper, turning), paper, 1024)
    for k in range(paper.nodes - 1):
        ends = [[x[:, j, i] for i in range(5)] for j in (k, k + 1)]
        distances = paper.signed_distance(x[:, k]), paper.signed_distance(x[:, k + 1])
        np.testing.assert_array_equal(
            log_clear(paper, *ends, paper.dt), log_clear(paper, *ends, paper.dt, distances)
        )


def test_rates_are_ordered_and_free_worlds_are_free(paper, replay, turning):
    driver = replay(paper, turning)
    result = evaluate(driver, paper, 3000)
    assert 0.0 < result.collision_rate < result.between_rate < 1.0
    assert (result.metrics.touched[result.metrics.collision] == 1.0).all()
    open_field = Scenario.named("open")
    assert evaluate(replay(open_field, turning), open_field, 100).between_rate == 0.0


def test_a_brownian_car_touches_as_often_however_its_path_is_cut(replay):
    # It turns on the spot as it were: v ω is constant, so the position is a Brownian motion round
    # a circle of radius v/ω = 1 cm; substeps cut the same kind of path more finely.
    whirl = Scenario(
        start=(0, 0, 0, 0.1, 10.0),
        goal=(1, 1, 0, 0, 0),
        horizon=1.0,
        nodes=5,
        slip=(0.3, 0.03),
        obstacles=((0.6, 0.0, 0.25),),
    )
    driver = replay(whirl, (0.0, 0.0))
    rates = {m: evaluate(driver, whirl, 20_000, substeps=m) for m in (1, 8, 64)}
    fine = rates[64].between_rate
    assert rates[8].between_rate == pytest.approx(fine, rel=0.1)
    # At nodes alone most of it is missed; between them it is not.
    assert rates[1].collision_rate < 0.75 * fine
    assert rates[1].between_rate == pytest.approx(fine, rel=0.15)

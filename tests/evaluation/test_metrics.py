import numpy as np
import pytest

from slipcar.evaluation import EpisodeMetrics, Result, evaluate


def made(total, clearance):
    n = len(total)
    clearance = np.asarray(clearance, dtype=float)
    return Result(
        metrics=EpisodeMetrics(
            effort=np.asarray(total, dtype=float),
            obstacle=np.full(n, 0.5),
            goal=np.full(n, 0.25),
            collision=clearance < 0.0,
            clearance=clearance,
            touched=np.where(clearance < 0.0, 1.0, 0.125),
            position_error=np.arange(n, dtype=float),
            heading_error=np.full(n, 0.1),
            speed_error=np.zeros(n),
        ),
        seed=0,
        substeps=1,
        closed_loop=True,
        failures=0,
        inference_time=1e-6,
        preparation_time=0.0,
        wall_time=1.0,
    )


def test_aggregates_of_four_episodes():
    r = made([1.0, 2.0, 3.0, 6.0], [0.1, -0.1, 0.2, 0.3])
    assert r.episodes == 4
    assert (r.effort, r.obstacle, r.goal, r.total) == (3.0, 0.5, 0.25, 3.75)
    # Sample variance 14/3, over 4 episodes.
    assert r.total_se == pytest.approx(np.sqrt(14 / 12))
    assert (r.obstacle_se, r.goal_se) == (0.0, 0.0)
    assert r.collision_rate == 0.25
    low, high = r.collision_interval
    assert 0.0 < low < 0.25 < high < 1.0
    assert r.position_rms == pytest.approx(np.sqrt((0 + 1 + 4 + 9) / 4))
    assert r.heading_rms == pytest.approx(0.1)
    assert r.speed_rms == 0.0
    assert r.clearance_quantiles == {0.01: -0.1, 0.05: -0.1, 0.5: 0.1}


def test_the_row_of_a_table_says_the_same():
    r = made([1.0, 2.0, 3.0, 6.0], [0.1, -0.1, 0.2, 0.3])
    row = r.summary()
    assert (row["collision_low"], row["collision_high"]) == r.collision_interval
    assert row["clearance_p05"] == -0.1
    for name in ("total", "total_se", "effort", "goal_se", "position_rms", "inference_time"):
        assert row[name] == getattr(r, name)


def test_without_obstacles_clearance_is_infinite():
    r = made([1.0, 2.0], [np.inf, np.inf])
    assert set(r.clearance_quantiles.values()) == {np.inf}
    assert r.collision_rate == 0.0


def test_parts_add_up_and_attributes_are_taken_over(paper, replay, turning):
    driver = replay(paper, turning)
    driver.preparation_time, driver.failures = 1.5, 2
    r = evaluate(driver, paper, 500, seed=2)
    assert r.total == pytest.approx(r.effort + r.obstacle + r.goal, rel=1e-12)
    assert (r.preparation_time, r.failures, r.closed_loop) == (1.5, 2, False)
    assert r.inference_time > 0.0
    np.testing.assert_array_equal(r.metrics.collision, r.metrics.clearance < 0.0)


def test_what_a_controller_does_not_say(paper, layers):
    r = evaluate(layers(), paper, 10)
    assert r.closed_loop
    assert r.failures == 0
    assert np.isnan(r.preparation_time)

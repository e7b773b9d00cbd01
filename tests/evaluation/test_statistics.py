import numpy as np
import pytest

from slipcar.evaluation.statistics import paired_difference, standard_error, wilson_interval


@pytest.mark.parametrize(("k", "n"), [(0, 10), (1, 10), (60, 1000), (596, 10_000), (10, 10)])
def test_wilson_interval_solves_its_quadratic(k, n):
    # Its ends are the p with |k/n − p| = z √(p (1 − p) / n).
    z = 1.959963984540054
    for p in wilson_interval(k, n):
        assert abs(k / n - p) == pytest.approx(z * np.sqrt(p * (1.0 - p) / n), abs=1e-9)


def test_wilson_interval_covers():
    rng = np.random.default_rng(0)
    p, n = 0.06, 400
    intervals = [wilson_interval(int(k), n) for k in rng.binomial(n, p, 2000)]
    covered = np.mean([low <= p <= high for low, high in intervals])
    assert 0.935 <= covered <= 0.97


def test_standard_error_is_the_spread_of_means():
    rng = np.random.default_rng(1)
    samples = rng.exponential(size=(4000, 50))
    errors = np.array([standard_error(row) for row in samples])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(samples.mean(axis=1).std(), rel=0.04)
    assert standard_error(np.array([1.0, 3.0])) == pytest.approx(1.0)
    assert np.isnan(standard_error(np.array([1.0])))


def test_bootstrap_interval_of_a_difference_covers():
    rng = np.random.default_rng(2)
    covered = []
    for i in range(300):
        noise = rng.exponential(size=300)
        reference, values = noise, 1.3 * noise + 0.1 * rng.normal(size=300)
        _, low, high = paired_difference(values, reference, resamples=400, seed=i)
        covered.append(low <= 0.3 <= high)
    assert 0.90 <= np.mean(covered) <= 0.985


def test_bootstrap_interval_is_that_of_the_normal_limit():
    rng = np.random.default_rng(3)
    difference = rng.normal(0.5, 2.0, size=5000)
    mean, low, high = paired_difference(difference, np.zeros(5000))
    assert mean == pytest.approx(difference.mean())
    half = 1.96 * standard_error(difference)
    assert (mean - low, high - mean) == (pytest.approx(half, rel=0.1), pytest.approx(half, rel=0.1))


def test_pairing_takes_the_common_noise_away():
    rng = np.random.default_rng(4)
    path = rng.normal(0.0, 10.0, size=2000)
    a, b = path + 0.1 + 0.1 * rng.normal(size=2000), path
    _, low, high = paired_difference(a, b)
    assert 0.08 < low < 0.1 < high < 0.12  # unpaired, the interval would be 1.2 wide


def test_differences_of_rates_take_booleans_and_repeat():
    a, b = np.arange(100) < 20, np.arange(100) < 50
    mean, low, high = paired_difference(a, b)
    assert mean == pytest.approx(-0.3)
    assert low < -0.3 < high
    assert paired_difference(a, b) == (mean, low, high)


def test_equal_rows_differ_by_nothing():
    values = np.arange(50.0)
    assert paired_difference(values, values) == (0.0, 0.0, 0.0)


def test_one_episode_has_no_interval():
    mean, low, high = paired_difference(np.array([2.0]), np.array([1.0]))
    assert mean == 1.0
    assert np.isnan([low, high]).all()


def test_rows_of_different_length_are_refused():
    with pytest.raises(ValueError, match=r"\(3,\) and \(4,\)"):
        paired_difference(np.zeros(3), np.zeros(4))

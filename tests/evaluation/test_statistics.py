import numpy as np
import pytest

from slipcar.evaluation.statistics import (
    bca_interval,
    cvar,
    episodes_for,
    half_width,
    leader,
    paired_difference,
    standard_error,
    student_interval,
    welch,
    wilson_interval,
)


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


# ------------------------------------------------------------------ the bootstrap


@pytest.mark.parametrize("seed", [0, 1])
def test_bca_is_that_of_scipy(seed):
    from scipy import stats

    values = np.random.default_rng(seed).lognormal(size=150)
    found = bca_interval(values, resamples=60_000, seed=3)
    theirs = stats.bootstrap(
        (values,), np.mean, n_resamples=30_000, batch=1000, method="BCa", rng=4
    ).confidence_interval
    width = theirs.high - theirs.low
    assert found.low == pytest.approx(theirs.low, abs=0.025 * width)
    assert found.high == pytest.approx(theirs.high, abs=0.025 * width)


def test_bca_covers_a_skewed_mean_where_the_normal_interval_does_not():
    rng = np.random.default_rng(5)
    truth, misses = np.exp(0.5), {"bca": 0, "normal": 0}
    for i in range(250):
        values = rng.lognormal(size=40)
        _, _, high = bca_interval(values, resamples=600, seed=i)
        half = 1.96 * standard_error(values)
        misses["bca"] += truth > high
        misses["normal"] += truth > values.mean() + half
    assert misses["bca"] < misses["normal"]


def test_groups_of_neighbours_stand_for_the_sample(monkeypatch):
    from slipcar.evaluation import statistics

    values = np.random.default_rng(6).lognormal(size=30_000)
    exact = bca_interval(values, resamples=3000, seed=0)
    monkeypatch.setattr(statistics, "UNGROUPED", 1000)
    grouped = bca_interval(values, resamples=3000, seed=1)
    assert grouped.mean == exact.mean
    width = exact.high - exact.low
    assert grouped.low == pytest.approx(exact.low, abs=0.06 * width)
    assert grouped.high == pytest.approx(exact.high, abs=0.06 * width)


def test_a_shift_and_a_factor_go_through_the_interval():
    values = np.random.default_rng(7).exponential(size=500)
    one, other = bca_interval(values), bca_interval(3.0 * values + 2.0)
    np.testing.assert_allclose(other, 3.0 * np.array(one) + 2.0, rtol=1e-9)


# ------------------------------------------------------------------ tails


def test_cvar_of_a_normal_sample():
    from scipy import stats

    values = np.random.default_rng(8).normal(size=100_000)
    mean, error = cvar(values, 0.05)
    expected = stats.norm.pdf(stats.norm.ppf(0.95)) / 0.05
    assert mean == pytest.approx(expected, abs=3.0 * error)
    blocks = [cvar(part, 0.05)[0] for part in values.reshape(100, -1)]
    assert error == pytest.approx(np.std(blocks) / 10.0, rel=0.25)


def test_cvar_of_few_and_of_infinite_values():
    assert cvar(np.array([1.0, 2.0, 3.0, 10.0]), 0.25)[0] == 10.0
    assert cvar(np.arange(1.0, 101.0), 0.05)[0] == pytest.approx(98.0)
    assert cvar(np.array([np.inf, np.inf]), 0.05)[0] == np.inf


# ------------------------------------------------------------------ how many episodes


@pytest.mark.parametrize(("resolution", "rate"), [(0.001, 0.06), (0.01, 0.5), (0.002, 0.0)])
def test_episodes_for_a_resolution_are_just_enough(resolution, rate):
    n = episodes_for(resolution, rate)
    assert half_width(rate, n) <= resolution < half_width(rate, n - 1)


@pytest.mark.parametrize(("resolution", "rate"), [(0.0, 0.1), (0.5, 0.1), (0.1, 1.5)])
def test_bad_resolutions_are_named(resolution, rate):
    with pytest.raises(ValueError, match="must be between"):
        episodes_for(resolution, rate)


def test_a_method_is_less_certain_than_its_trainings():
    mean, low, high = student_interval(5.0, 0.1, freedom=4)
    assert (mean - low, high - mean) == (pytest.approx(0.2776, rel=1e-3),) * 2
    assert student_interval(5.0, 0.1, float("inf")).high == pytest.approx(5.196, rel=1e-4)


def test_freedom_is_that_of_the_part_that_dominates():
    assert welch((0.1, 10_000), (1e-9, 3))[1] == pytest.approx(9999)
    assert welch((1e-9, 10_000), (0.1, 3))[1] == pytest.approx(2)
    error, freedom = welch((0.3, 5), (0.4, 5))
    assert error == pytest.approx(0.5)
    assert freedom == pytest.approx(0.5**4 / ((0.3**4 + 0.4**4) / 4))


def test_heavy_tails_keep_their_variance_in_groups():
    values = np.random.default_rng(9).lognormal(sigma=2.0, size=200_000)
    _, low, high = bca_interval(values)
    half = 1.96 * standard_error(values)
    assert high - low == pytest.approx(2.0 * half, rel=0.1)


# ------------------------------------------------------------------ who is the winner


def led(**samples):
    found = {name: np.asarray(values, dtype=float) for name, values in samples.items()}
    return leader(
        {name: values.mean() for name, values in found.items()},
        lambda name, other: paired_difference(found[name], found[other]),
    )


def test_a_winner_is_below_every_other_beyond_the_interval():
    noise = np.random.default_rng(0).normal(size=400)
    first = led(a=noise + 1.0, b=noise, c=-noise + 5.0)
    assert (first.name, first.tied, first.winner) == ("b", (), "b")


def test_what_the_interval_does_not_separate_is_tied_and_nobody_wins():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 400))
    first = led(a=a, b=b + 0.01, far=a + 3.0)
    other = {"a": "b", "b": "a"}[first.name]
    assert first.tied == (other,)
    assert first.winner is None
    assert led(a=a, b=a).tied == ("b",)


def test_nobody_leads_alone_and_nan_takes_no_part():
    assert led(a=np.ones(5)) is None
    assert led(a=np.ones(5), b=np.full(5, np.nan)) is None
    first = led(a=np.ones(50), b=np.full(50, np.nan), c=np.arange(50) + 3.0)
    assert (first.winner, first.tied) == ("a", ())

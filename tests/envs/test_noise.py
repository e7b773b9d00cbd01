"""From random words to variates: their law, and that only the words matter."""

import numpy as np
import pytest
from gymnasium.utils import seeding
from scipy import stats

from slipcar.envs.noise import Tapes, draw_words, generators, normals, uniforms

WORDS = np.random.default_rng(0).integers(0, 2**64, size=(500, 600), dtype=np.uint64)


def test_normals_are_standard_normal():
    drawn = normals(WORDS)
    assert drawn.shape == (2, 600, 500)
    assert drawn.dtype == np.float32
    assert np.isfinite(drawn).all()
    assert stats.kstest(drawn[..., :100].ravel(), "norm").pvalue > 1e-3
    n = drawn.size
    for power, moment, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        error = np.mean(drawn.astype(float) ** power) - moment
        assert abs(error) < 4.5 * np.sqrt(variance / n)


def test_both_variates_of_a_word_are_independent():
    cosines, sines = normals(WORDS).reshape(2, -1).astype(float)
    for a, b in ((cosines, sines), (cosines**2, sines**2), (np.abs(cosines), sines)):
        assert abs(np.corrcoef(a, b)[0, 1]) < 4.5 / np.sqrt(len(a))


def test_extreme_words_give_finite_variates_in_the_tails():
    low, high = np.uint64(0), np.uint64(2**64 - 1)
    drawn = normals(np.array([[low, high]]))
    assert np.isfinite(drawn).all()
    # √(−2 ln 2⁻³³): what lies beyond has probability 1e-11.
    assert np.abs(drawn).max() == pytest.approx(6.7638, rel=1e-3)


@pytest.mark.parametrize("rows", [1, 7, 100])
def test_normals_of_a_row_depend_on_that_row_alone(rows):
    np.testing.assert_allclose(
        normals(WORDS[:rows, :33]), normals(WORDS[:, :33])[..., :rows], rtol=1e-5, atol=1e-6
    )


def test_uniforms_fill_the_unit_interval():
    drawn = uniforms(WORDS)
    assert drawn.min() >= 0.0
    assert drawn.max() < 1.0
    assert stats.kstest(drawn.ravel()[::7], "uniform").pvalue > 1e-3
    assert uniforms(np.array([0, 2**64 - 1], dtype=np.uint64)).tolist() == [0.0, 1.0 - 2.0**-53]


def test_every_generator_of_numpy_gives_whole_words():
    for kind in (np.random.PCG64, np.random.MT19937, np.random.Philox, np.random.SFC64):
        words = draw_words(np.random.Generator(kind(1)), 4000)
        assert words.dtype == np.uint64
        bits = np.unpackbits(words.view(np.uint8)).reshape(4000, 64).mean(axis=0)
        assert np.abs(bits - 0.5).max() < 4.5 * 0.5 / np.sqrt(4000)


@pytest.mark.parametrize("sizes", [[5] * 40, [5, 3, 60, 1, 1, 200, 7]])
def test_tapes_are_read_in_order_however_far_ahead_they_fetch(sizes):
    """Each generator's words, whoever asks for how many, and in any company."""
    count, rng = 4, np.random.default_rng(2)
    tapes, expected = Tapes(count), [seeding.np_random(10 + i)[0] for i in range(count)]
    for i in range(count):
        tapes.start(i, seeding.np_random(10 + i)[0])
    for size in sizes:
        here = np.flatnonzero(rng.random(count) < 0.6)
        if len(here) == 0:
            continue
        taken = tapes.take(here, size)
        for row, i in zip(taken, here, strict=True):
            np.testing.assert_array_equal(row, draw_words(expected[i], size))


def test_seeding_a_tape_starts_it_anew_and_leaves_the_others_alone():
    tapes, everyone = Tapes(2), np.arange(2)
    for i in range(2):
        tapes.start(i, seeding.np_random(i)[0])
    first, second = tapes.take(everyone, 9).copy(), tapes.take(everyone, 9).copy()
    tapes.start(0, seeding.np_random(0)[0])
    again = tapes.take(everyone, 9)
    np.testing.assert_array_equal(again[0], first[0])
    assert not np.isin(again[1], [first[1], second[1]]).any()


@pytest.mark.parametrize("seed", [[1], (1, 2, 3), "ab", 1.5, [1.5, 2.5], {1, 2}])
def test_bad_seeds(seed):
    with pytest.raises(ValueError, match="seed must be None, an int or 2 of them"):
        generators(seed, 2)

"""Losses of Gaussian and certain rows: against integrals, differences and what convexity says."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from slipcar.planner.moments.losses import EDGE, deviations, hinge_loss, loss

PENALTY, TAIL = np.array([False]), np.array([True])
#: Mean in standard deviations: far below, around the edge and zero, far above.
RATIOS = np.array(
    [-60.0, -12.0, -6.0, -3.0, -1.5, -1.0 - 1e-6, -1.0, -1.0 + 1e-6, -0.3, 0.0, 0.4, 2.0, 9.0]
)
SCALES = np.array([1e-3, 0.05, 1.0, 30.0])


def at(c, s, kind, weight=1.0):
    """The four numbers of one row."""
    c, s = np.broadcast_arrays(np.asarray(c, float), np.asarray(s, float))
    return [part[..., 0] for part in loss(c[..., None], s[..., None], np.array([weight]), kind)]


# ------------------------------------------------------------------------------ values


@pytest.mark.parametrize("s", SCALES)
@pytest.mark.parametrize("t", [-6.0, -3.0, -1.0, -0.2, 0.0, 0.7, 3.0, 20.0])
def test_a_penalty_is_the_integral_of_its_square_against_the_density(s, t):
    c = t * s
    # In units of s, from where max(0, ·) begins.
    value, error = quad(lambda z: (t + z) ** 2 * norm.pdf(z), -t, max(-t, 0.0) + 40.0, epsabs=0)
    assert at([c], [s], PENALTY)[0][0] == pytest.approx(s * s * value, rel=1e-7 + 10 * error)


@pytest.mark.parametrize("s", SCALES)
@pytest.mark.parametrize("t", [-30.0, -6.0, -3.0, -1.2, EDGE])
def test_a_constraint_is_the_probability_of_violation_below_the_edge(s, t):
    assert at([t * s], [s], TAIL)[0][0] == pytest.approx(norm.sf(-t), rel=1e-12)


def test_losses_agree_with_simulated_gaussians():
    rng = np.random.default_rng(1)
    z = rng.standard_normal(1_000_000)
    for c, s in ((-0.3, 0.2), (0.05, 0.4), (-1.0, 0.9)):
        draws = c + s * z
        square = np.maximum(draws, 0.0) ** 2
        assert abs(at(c, s, PENALTY)[0] - square.mean()) < 5e-3 * square.std()
        if c <= EDGE * s:
            assert abs(at(c, s, TAIL)[0] - (draws > 0).mean()) < 5e-3 * (draws > 0).std()


def test_beyond_the_edge_the_tail_is_the_parabola_that_osculates_it():
    s, t = 0.3, np.linspace(EDGE, 6.0, 50)
    over = t - EDGE
    parabola = norm.cdf(EDGE) + norm.pdf(EDGE) * over + 0.5 * norm.pdf(EDGE) * over**2
    value, _, curvature, _ = at(t * s, s, TAIL)
    np.testing.assert_allclose(value, parabola, rtol=1e-12)
    np.testing.assert_allclose(curvature, norm.pdf(EDGE) / s**2, rtol=1e-12)
    # An upper bound of the probability, so nothing is charged too little there.
    assert (value >= norm.cdf(t) - 1e-12).all()


@pytest.mark.parametrize("kind", [PENALTY, TAIL], ids=["penalty", "tail"])
def test_without_noise_nothing_is_left_but_the_row_itself(kind):
    for c in (-0.5, 0.5):
        value, slope, curvature, by_variance = at(c, 1e-9, kind)
        if c < 0:
            assert (value, slope, curvature, by_variance) == (0.0, 0.0, 0.0, 0.0)
        elif kind is PENALTY:
            assert (value, slope, curvature, by_variance) == pytest.approx((c * c, 2 * c, 2.0, 1.0))


# ------------------------------------------------------------------------------ derivatives


@pytest.mark.parametrize("kind", [PENALTY, TAIL], ids=["penalty", "tail"])
@pytest.mark.parametrize("s", SCALES)
def test_derivatives_are_those_of_the_value(kind, s):
    # The far tail's value is 0 to rounding, and so are the derivatives: checked below.
    c = RATIOS[2:] * s
    h = 1e-5 * s
    value, slope, curvature, by_variance = at(c, s, kind)
    up, down = at(c + h, s, kind), at(c - h, s, kind)
    np.testing.assert_allclose((up[0] - down[0]) / (2 * h), slope, rtol=2e-4, atol=1e-12 / s)
    # Of the slope, one-sided where the third derivative jumps.
    np.testing.assert_allclose((up[1] - down[1]) / (2 * h), curvature, rtol=1e-4, atol=1e-7)
    v, dv = s * s, 1e-5 * s * s
    numeric = (at(c, np.sqrt(v + dv), kind)[0] - at(c, np.sqrt(v - dv), kind)[0]) / (2 * dv)
    inside = c < 0.0 if kind is TAIL else np.ones(len(c), bool)
    np.testing.assert_allclose(
        numeric[inside], by_variance[inside], rtol=2e-4, atol=1e-10 * max(1.0, 1.0 / v)
    )
    if kind is TAIL:  # above zero more variance would lower the loss: not believed
        assert (by_variance[~inside] == 0.0).all()
    assert np.isfinite([value, slope, curvature, by_variance]).all()


@pytest.mark.parametrize("kind", [PENALTY, TAIL], ids=["penalty", "tail"])
def test_value_slope_and_curvature_are_continuous_over_the_edge(kind):
    s = 0.7
    below, above = at((EDGE - 1e-9) * s, s, kind), at((EDGE + 1e-9) * s, s, kind)
    np.testing.assert_allclose(below, above, rtol=1e-7)


def test_a_penalty_obeys_the_heat_equation():
    """E f(c + √v Z) satisfies ∂/∂v = ½ ∂²/∂c²; the far tail of Φ does as well."""
    c = np.linspace(-4.0, 3.0, 40)
    _, _, curvature, by_variance = at(c, 0.8, PENALTY)
    np.testing.assert_allclose(by_variance, 0.5 * curvature, rtol=1e-13)
    c = np.linspace(-4.0, EDGE * 0.8, 40)
    _, _, curvature, by_variance = at(c, 0.8, TAIL)
    np.testing.assert_allclose(by_variance, 0.5 * curvature, rtol=1e-13)


@pytest.mark.parametrize("kind", [PENALTY, TAIL], ids=["penalty", "tail"])
def test_losses_are_convex_and_grow_with_row_and_spread(kind):
    c = np.linspace(-3.0, 3.0, 601)
    for s in (0.05, 0.5, 2.0):
        value, slope, curvature, by_variance = at(c, s, kind)
        assert (np.diff(value) >= -1e-15 * value.max()).all()
        assert (np.diff(value, 2) >= -1e-12 * value.max()).all()
        assert (slope >= -1e-15 * slope.max()).all()
        assert (curvature >= 0.0).all()
        assert (by_variance >= 0.0).all()
    wide = np.array([at(c[c < 0.0], s, kind)[0] for s in (0.1, 0.2, 0.4, 0.8)])
    if kind is PENALTY:
        assert (np.diff(wide, axis=0) >= 0.0).all()
    else:  # where Φ itself is meant
        inner = c[c < 0.0] <= EDGE * 0.8
        assert (np.diff(wide[:, inner], axis=0) >= 0.0).all()


def test_weights_multiply_each_row():
    c, s = np.array([[-0.4, 0.3, -0.4]]), np.full((1, 3), 0.3)
    kinds, weight = np.array([False, True, True]), np.array([2.0, 3.0, 0.0])
    one, many = loss(c, s, np.ones(3), kinds), loss(c, s, weight, kinds)
    for name in ("value", "slope", "curvature", "by_variance"):
        np.testing.assert_allclose(getattr(many, name), weight * getattr(one, name))


# ------------------------------------------------------------------------------ certain rows


def test_a_certain_penalty_is_its_square_and_has_a_kink():
    c = np.array([-2.0, -1e-9, 0.0, 1e-9, 0.3, 4.0])
    value, slope, curvature, by_variance = hinge_loss(c)
    positive = c > 0.0
    np.testing.assert_array_equal(value, np.where(positive, c**2, 0.0))
    np.testing.assert_array_equal(slope, np.where(positive, 2.0 * c, 0.0))
    np.testing.assert_array_equal(curvature, np.where(positive, 2.0, 0.0))
    np.testing.assert_array_equal(by_variance, 0.5 * curvature)  # the heat equation


def test_a_gaussian_penalty_becomes_the_certain_one_as_its_spread_vanishes():
    """E max(0, c)² − max(0, c̄)² is at most s²: between none and all of the variance."""
    c = np.array([-0.2, -1e-3, 0.0, 1e-3, 0.5])
    certain = hinge_loss(c)
    for s in (1e-1, 1e-2, 1e-3):
        more = at(c, s, PENALTY)[0] - certain.value
        assert (more >= -1e-15).all()
        assert (more <= s * s * (1.0 + 1e-9)).all()
    np.testing.assert_allclose(at(c, 1e-9, PENALTY)[1], certain.slope, atol=2e-9)


# ------------------------------------------------------------------------------ deviations


def test_deviations_are_those_of_a_linear_row_and_bounded_below():
    rng = np.random.default_rng(2)
    C, F = rng.normal(size=(6, 3, 4)), rng.normal(size=(6, 4, 4))
    S = F @ F.swapaxes(1, 2)
    S[0] = 0.0  # certain, as at the start
    s = deviations(C, S)
    for k in range(1, 6):
        for o in range(3):
            assert s[k, o] ** 2 == pytest.approx(C[k, o] @ S[k] @ C[k, o])
    assert (s[0] > 0.0).all()
    np.testing.assert_allclose(s[0], 0.02 * s.max(axis=0), atol=2e-9)
    assert (deviations(C, np.zeros_like(S)) > 0.0).all()
    assert deviations(np.zeros((6, 0, 4)), S).shape == (6, 0)

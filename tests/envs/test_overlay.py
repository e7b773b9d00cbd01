import numpy as np
import pytest

from slipcar.envs.overlay import MASS, Overlay

PATH = np.array([[0.0, 0.0], [1.0, 0.5], [2.0, -0.5]])


def test_ellipses_are_rims_of_equal_density():
    rng = np.random.default_rng(0)
    half = rng.normal(size=(3, 2, 2))
    S = half @ half.swapaxes(1, 2)
    offset = Overlay(PATH, S).ellipses() - PATH[:, None]
    squared = np.einsum("kji,kil,kjl->kj", offset, np.linalg.inv(S), offset)
    np.testing.assert_allclose(squared, -2.0 * np.log(1.0 - MASS), rtol=1e-9)


def test_ellipses_hold_their_mass():
    """Of points of the Gaussian, so many lie to the left of every side of the polygon."""
    S = np.array([[[0.5, -0.3], [-0.3, 0.4]]])
    rim = Overlay(PATH[1:2], S).ellipses()[0]
    points = np.random.default_rng(1).multivariate_normal(PATH[1], S[0], 40_000)
    side = np.roll(rim, -1, axis=0) - rim
    to = points[:, None] - rim
    inside = (side[:, 0] * to[..., 1] - side[:, 1] * to[..., 0] > 0.0).all(axis=1)
    # The polygon's corners are on the rim: it holds a little less than the ellipse.
    assert MASS - 0.006 < inside.mean() < MASS + 0.003


@pytest.mark.parametrize("S", [np.zeros((2, 2)), np.diag([0.0, 4.0]), np.ones((2, 2))])
def test_singular_covariances_are_segments_or_points(S):
    rim = Overlay(PATH[:1], S[None]).ellipses()[0]
    assert np.isfinite(rim).all()
    reach = np.sqrt(-2.0 * np.log(1.0 - MASS) * np.diag(S))
    np.testing.assert_allclose(np.abs(rim).max(axis=0), reach, rtol=1e-6, atol=1e-12)


def test_an_overlay_keeps_what_it_was_given():
    states = np.hstack([PATH, np.ones((3, 3))])
    overlay = Overlay(states)
    states[:] = 7.0
    np.testing.assert_array_equal(overlay.positions, PATH)
    with pytest.raises(ValueError, match="read-only"):
        overlay.states[0, 0] = 1.0
    with pytest.raises(ValueError, match="without covariances"):
        overlay.ellipses()


@pytest.mark.parametrize(
    ("states", "covariances", "message"),
    [
        (PATH[:, :1], None, r"n >= 2\), not \(3, 1\)"),
        (np.empty((0, 2)), None, r"k >= 1"),
        (PATH[0], None, "states must have shape"),
        ([[0.0, np.nan]], None, r"states\[0, 1\] must be finite"),
        (PATH, np.zeros((2, 2, 2)), r"covariances must have shape \(3, 2, 2\)"),
        (PATH, [np.eye(2), np.eye(2), [[1, 2], [2, 1]]], r"covariances\[2\] must be symmetric"),
        (PATH, [np.eye(2), [[1, 0.5], [0, 1]], np.eye(2)], r"covariances\[1\] must be symmetric"),
    ],
)
def test_bad_overlays_are_named(states, covariances, message):
    with pytest.raises(ValueError, match=message):
        Overlay(states, covariances)

"""The integrator against theory: strong order, exact moments, one Brownian motion at all scales."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipcar.envs import car
from slipcar.envs.integrate import STRONG_ORDER, coarsen, euler_maruyama


def terminal_states(x0, u, horizon, noise, slip):
    """States at the horizon under one constant control, one row for each path."""
    start = np.broadcast_to(x0, (len(noise), 5))
    return euler_maruyama(start, np.broadcast_to(u, (len(noise), 2)), horizon, noise, slip)


# ------------------------------------------------------------------------- one Brownian motion


@given(st.integers(1, 4), st.integers(1, 4), st.integers(0, 1000))
def test_coarsening_keeps_the_brownian_path(factor, coarse_steps, seed):
    fine = np.random.default_rng(seed).normal(size=(2, factor * coarse_steps, 3))
    coarse = coarsen(fine, factor)
    assert coarse.shape == (2, coarse_steps, 3)
    h = 0.01
    B_fine = np.cumsum(np.sqrt(h) * fine, axis=-2)[:, factor - 1 :: factor]
    B_coarse = np.cumsum(np.sqrt(factor * h) * coarse, axis=-2)
    np.testing.assert_allclose(B_coarse, B_fine, atol=1e-12)


def test_coarsening_in_two_goes_is_coarsening_once():
    noise = np.random.default_rng(0).normal(size=(5, 24, 3))
    np.testing.assert_allclose(coarsen(coarsen(noise, 2), 3), coarsen(noise, 6), atol=1e-13)
    np.testing.assert_array_equal(coarsen(noise, 1), noise)


@pytest.mark.parametrize("factor", [0, -1, 5, 25])
def test_coarsening_by_no_divisor_is_refused(factor):
    with pytest.raises(ValueError, match=f"divisor of the 24 steps, not {factor}"):
        coarsen(np.zeros((24, 3)), factor)


def test_one_step_is_the_formula():
    rng = np.random.default_rng(0)
    x, u, noise = rng.normal(size=(6, 5)), rng.normal(size=(6, 2)), rng.normal(size=(6, 1, 3))
    h, slip = 0.3, (0.2, 0.4)
    kick = np.einsum("...ij,...j->...i", car.diffusion(x, slip), noise[:, 0])
    expected = x + h * car.drift(x, u) + np.sqrt(h) * kick
    np.testing.assert_allclose(euler_maruyama(x, u, h, noise, slip), expected, rtol=1e-14)


def test_substeps_are_steps():
    rng = np.random.default_rng(1)
    x, u, noise = rng.normal(size=(6, 5)), rng.normal(size=(6, 2)), rng.normal(size=(6, 4, 3))
    slip = (0.2, 0.4)
    y = x
    for j in range(4):
        y = euler_maruyama(y, u, 0.25, noise[:, j : j + 1], slip)
    np.testing.assert_allclose(euler_maruyama(x, u, 1.0, noise, slip), y, rtol=1e-13)


def test_a_straight_drive_has_no_noise_whatever_the_variates():
    x0, u = np.array([1.0, 2.0, np.pi / 6, 0.5, 0.0]), np.array([0.8, 0.0])
    noise = 100.0 * np.random.default_rng(0).normal(size=(10, 200, 3))
    end = terminal_states(x0, u, 2.0, noise, (0.1, 0.01))
    h = 2.0 / 200
    travelled = 0.5 * 2.0 + 0.8 * h * h * (200 * 199 / 2)  # Σ h v_k, v_k = 0.5 + 0.8 k h
    heading = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    expected = np.concatenate([x0[:2] + travelled * heading, [np.pi / 6, 0.5 + 0.8 * 2.0, 0.0]])
    np.testing.assert_allclose(end, np.broadcast_to(expected, (10, 5)), rtol=1e-12)


# --------------------------------------------------------------------------------- strong order


FACTORS = np.array([16, 32, 64, 128, 256])
FINEST = 2048


def measured_order(errors):
    """Slope of log RMS error against log step."""
    rms = [np.sqrt(np.mean(np.sum(np.square(e), axis=-1))) for e in errors]
    return np.polyfit(np.log(FACTORS), np.log(rms), 1)[0]


def test_strong_order():
    """Distance to the path on a 16 to 256 times finer grid of the same Brownian motion.

    Slip is so large that noise makes most of the error: an order of 1/2 could not hide.
    """
    x0, u = np.array([0.0, 0.0, 0.4, 1.0, 0.5]), np.array([1.5, -3.0])
    noise = np.random.default_rng(0).standard_normal((1000, FINEST, 3))

    def errors(noise):
        reference = terminal_states(x0, u, 1.0, noise, (2.0, 1.0))
        rough = [coarsen(noise, int(factor)) for factor in FACTORS]
        return [terminal_states(x0, u, 1.0, n, (2.0, 1.0)) - reference for n in rough]

    with_noise, without = errors(noise), errors(0.0 * noise[:1])
    for e, e0 in zip(with_noise, without, strict=True):
        assert np.sqrt(np.mean(e**2)) > 2.0 * np.sqrt(np.mean(e0**2))
    assert abs(measured_order(with_noise) - STRONG_ORDER) < 0.1


def test_the_measurement_tells_order_one_half_from_one():
    """dX = X dB, whose Euler–Maruyama scheme has strong order 1/2 (Kloeden and Platen §10.2)."""
    noise = np.random.default_rng(0).standard_normal((4000, FINEST, 1))
    exact = np.exp(noise.sum(axis=-2) / np.sqrt(FINEST) - 0.5)
    rough = [coarsen(noise, int(factor)) for factor in FACTORS]
    errors = [np.prod(1 + n / np.sqrt(n.shape[-2]), axis=-2) - exact for n in rough]
    assert abs(measured_order(errors) - 0.5) < 0.1


# --------------------------------------------------------------------------------- weak moments


def circle_moments(x0, horizon, steps, slip):
    """Mean and covariance of (r_x, r_y, θ) of Euler–Maruyama at constant v and ω: closed form.

    With v, ω constant θ_k = θ_0 + ω k h + s B_k is Gaussian, s = β² v ω, hence
    E e^{iθ_k} = e^{iθ_0} q^k and E e^{i(θ_j+θ_k)} = e^{2iθ_0} p^j q^{k−j} for j ≤ k, with
    q = exp((iω − s²/2) h), p = exp((2iω − 2s²) h); and E θ̃_N e^{iθ_k} = i s² k h E e^{iθ_k},
    θ̃ = θ − E θ. Positions are r_N = r_0 + h v Σ e^{iθ_k} + α² v ω (B¹ + i B²).
    """
    v, omega, h = x0[3], x0[4], horizon / steps
    s, a = slip[1] * v * omega, slip[0] * v * omega
    q, p = np.exp((1j * omega - s * s / 2) * h), np.exp((2j * omega - 2 * s * s) * h)
    k = np.arange(steps)
    e = np.exp(1j * x0[2]) * q**k
    low, apart = np.minimum.outer(k, k), np.abs(np.subtract.outer(k, k))
    forward = q**apart  # E e^{i(θ_max − θ_min)}
    hermitian = (h * v) ** 2 * forward.real.sum() + 2 * a * a * horizon  # E |r_N − r_0|²
    pseudo = (h * v) ** 2 * (np.exp(2j * x0[2]) * p**low * q**apart).sum()  # E (r_N − r_0)²
    r = h * v * e.sum()
    hermitian, pseudo = hermitian - abs(r) ** 2, pseudo - r * r
    with_heading = h * v * (1j * s * s * k * h * e).sum()
    mean = np.array([x0[0] + r.real, x0[1] + r.imag, x0[2] + omega * horizon])
    xx, yy, xy = (hermitian + pseudo.real) / 2, (hermitian - pseudo.real) / 2, pseudo.imag / 2
    covariance = np.array(
        [
            [xx, xy, with_heading.real],
            [xy, yy, with_heading.imag],
            [with_heading.real, with_heading.imag, s * s * horizon],
        ]
    )
    return mean, covariance


@pytest.mark.parametrize("slip", [(0.1, 0.01), (0.2, 0.5), (0.0, 0.8)])
def test_mean_and_covariance_on_a_circle(slip):
    x0, horizon, steps, paths = np.array([0.5, -1.0, 0.3, 1.2, 0.9]), 2.0, 8, 150_000
    noise = np.random.default_rng(7).standard_normal((paths, steps, 3))
    end = terminal_states(x0, np.zeros(2), horizon, noise, slip)
    mean, covariance = circle_moments(x0, horizon, steps, slip)
    centred = end[:, :3] - mean
    # Five standard errors each, estimated from the same paths.
    assert (np.abs(centred.mean(axis=0)) < 5 * end[:, :3].std(axis=0) / np.sqrt(paths)).all()
    products = centred[:, :, None] * centred[:, None, :]
    error = np.abs(products.mean(axis=0) - covariance)
    assert (error < 5 * products.std(axis=0) / np.sqrt(paths) + 1e-12).all()
    np.testing.assert_array_equal(end[:, 3:], np.broadcast_to(x0[3:], (paths, 2)))


def test_heading_variance_converges_to_the_integral_with_weak_order_one():
    """From rest with v = a t, ω = c t: Var θ(T) = β⁴ ∫ (v ω)² dt = β⁴ a² c² T⁵ / 5."""
    u, horizon, slip, paths = np.array([1.0, 1.5]), 2.0, (0.1, 0.3), 40_000
    limit = slip[1] ** 2 * u[0] ** 2 * u[1] ** 2 * horizon**5 / 5
    for steps in (10, 20, 40):
        noise = np.random.default_rng(steps).standard_normal((paths, steps, 3))
        sample = np.var(terminal_states(np.zeros(5), u, horizon, noise, slip)[:, 2])
        left = np.arange(steps) * horizon / steps
        exact = slip[1] ** 2 * horizon / steps * np.sum((u[0] * u[1] * left**2) ** 2)
        assert abs(sample / exact - 1) < 5 * np.sqrt(2 / paths)  # Gaussian: Var s² = 2σ⁴/n
        bias = (limit - exact) / limit
        np.testing.assert_allclose(bias * steps, 2.5, rtol=0.2)  # T⁵/5 · 5/(2 n) + O(1/n²)

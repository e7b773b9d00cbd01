"""Drift and diffusion against their formulas, their Jacobians against independent derivatives."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipcar.envs import car

SHAPES = [(), (1,), (7,), (4, 3), (2, 3, 2), (0,)]
SLIP = (0.1, 0.01)


def draw(shape, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-3, 3, (*shape, 5)), rng.uniform(-3, 3, (*shape, 2))


def complex_step(f, x, h=1e-30):
    """∂f/∂x of f: (..., n) -> (..., *out), exact to rounding; differentiated axis last."""
    columns = []
    for j in range(x.shape[-1]):
        moved = x.astype(complex)
        moved[..., j] += 1j * h
        columns.append(f(moved).imag / h)
    return np.stack(columns, axis=-1)


def central_difference(f, x, h=1e-6):
    columns = []
    for j in range(x.shape[-1]):
        step = h * np.eye(x.shape[-1])[j]
        columns.append((f(x + step) - f(x - step)) / (2 * h))
    return np.stack(columns, axis=-1)


def test_drift_is_the_papers_car():
    x = np.array([7.0, -3.0, np.pi / 6, 2.0, 0.5])
    u = np.array([0.3, -0.4])
    expected = [2 * np.cos(np.pi / 6), 2 * np.sin(np.pi / 6), 0.5, 0.3, -0.4]
    np.testing.assert_allclose(car.drift(x, u), expected, rtol=1e-15)


def test_diffusion_is_the_papers_sigma_without_its_zero_columns():
    x = np.array([0.0, 0.0, 1.0, 2.0, -0.5])
    full = np.diag([0.1 * -1.0, 0.1 * -1.0, 0.01 * -1.0, 0.0, 0.0])  # ω v = −1
    np.testing.assert_allclose(car.diffusion(x, SLIP), full[:, :3], rtol=1e-15)


@pytest.mark.parametrize("shape", SHAPES)
def test_drift_jacobians(shape):
    x, u = draw(shape)
    A, B = car.drift_jacobian(x, u)
    assert A.shape == (*shape, 5, 5)
    assert B.shape == (*shape, 5, 2)
    np.testing.assert_allclose(A, complex_step(lambda y: car.drift(y, u), x), atol=1e-14)
    np.testing.assert_allclose(B, complex_step(lambda w: car.drift(x, w), u), atol=1e-14)
    np.testing.assert_allclose(A, central_difference(lambda y: car.drift(y, u), x), atol=1e-8)
    np.testing.assert_allclose(B, central_difference(lambda w: car.drift(x, w), u), atol=1e-8)


@pytest.mark.parametrize("shape", SHAPES)
def test_diffusion_jacobian(shape):
    x, _ = draw(shape)
    jacobian = car.diffusion_jacobian(x, SLIP)
    assert jacobian.shape == (*shape, 5, 3, 5)
    sigma = lambda y: car.diffusion(y, SLIP)  # noqa: E731
    np.testing.assert_allclose(jacobian, complex_step(sigma, x), atol=1e-14)
    np.testing.assert_allclose(jacobian, central_difference(sigma, x), atol=1e-8)


@pytest.mark.parametrize("shape", SHAPES)
def test_batches_are_single_states_side_by_side(shape):
    x, u = draw(shape)
    together = [car.drift(x, u), *car.drift_jacobian(x, u), car.diffusion(x, SLIP)]
    for index in np.ndindex(*shape):
        alone = [
            car.drift(x[index], u[index]),
            *car.drift_jacobian(x[index], u[index]),
            car.diffusion(x[index], SLIP),
        ]
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_array_equal(a[index], b)


@given(
    theta=st.floats(-10, 10),
    speed=st.floats(-100, 100),
    turn=st.floats(-100, 100),
    slip=st.tuples(st.floats(0, 10), st.floats(0, 10)),
)
def test_no_noise_when_standing_or_driving_straight(theta, speed, turn, slip):
    standing = np.array([1.0, 2.0, theta, 0.0, turn])
    straight = np.array([1.0, 2.0, theta, speed, 0.0])
    assert not car.diffusion(standing, slip).any()
    assert not car.diffusion(straight, slip).any()


@given(st.floats(0.01, 10), st.floats(0.01, 10))
def test_noise_never_reaches_speed_and_turn_rate_and_grows_with_both(speed, turn):
    sigma = car.diffusion(np.array([0.0, 0.0, 0.3, speed, turn]), SLIP)
    assert not sigma[3:].any()
    np.testing.assert_allclose(np.diag(sigma[:3]), speed * turn * np.array([0.1, 0.1, 0.01]))
    np.testing.assert_array_equal(sigma[:3], np.diag(np.diag(sigma[:3])))


@pytest.mark.parametrize("shape", SHAPES)
def test_torch_gives_numpys_numbers(shape):
    torch = pytest.importorskip("torch")
    x, u = draw(shape)
    X, U = torch.from_numpy(x), torch.from_numpy(u)
    pairs = [
        (car.drift(X, U), car.drift(x, u)),
        *zip(car.drift_jacobian(X, U), car.drift_jacobian(x, u), strict=True),
        (car.diffusion(X, SLIP), car.diffusion(x, SLIP)),
        (car.diffusion_jacobian(X, SLIP), car.diffusion_jacobian(x, SLIP)),
    ]
    for ours, reference in pairs:
        assert isinstance(ours, torch.Tensor)
        assert ours.dtype == torch.float64
        np.testing.assert_allclose(ours.numpy(), reference, rtol=0, atol=1e-14)


def test_jacobians_against_automatic_differentiation():
    torch = pytest.importorskip("torch")
    x, u = (torch.from_numpy(a) for a in draw(()))
    A, B = torch.autograd.functional.jacobian(car.drift, (x, u))
    mine = car.drift_jacobian(x, u)
    torch.testing.assert_close(mine[0], A, rtol=0, atol=1e-14)
    torch.testing.assert_close(mine[1], B, rtol=0, atol=1e-14)

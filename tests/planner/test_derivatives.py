import numpy as np
import pytest

from slipcar.planner.problem.derivatives import complex_step_jacobian


def f(x):
    """R² -> R^(2 x 2), analytic."""
    a, b = x[..., 0], x[..., 1]
    rows = [
        np.stack([np.sin(a) * np.exp(b), a**2 * b], axis=-1),
        np.stack([b / (1.0 + a**2), np.sqrt(1.0 + b**2)], axis=-1),
    ]
    return np.stack(rows, axis=-2)


def df(x):
    a, b = x[..., 0], x[..., 1]
    out = np.zeros((*x.shape[:-1], 2, 2, 2))
    out[..., 0, 0, 0] = np.cos(a) * np.exp(b)
    out[..., 0, 0, 1] = np.sin(a) * np.exp(b)
    out[..., 0, 1, 0] = 2 * a * b
    out[..., 0, 1, 1] = a**2
    out[..., 1, 0, 0] = -2 * a * b / (1.0 + a**2) ** 2
    out[..., 1, 0, 1] = 1.0 / (1.0 + a**2)
    out[..., 1, 1, 1] = b / np.sqrt(1.0 + b**2)
    return out


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_complex_step_equals_the_closed_form_to_rounding(batch):
    x = np.random.default_rng(0).normal(size=(*batch, 2))
    jacobian = complex_step_jacobian(f, x)
    assert jacobian.shape == (*batch, 2, 2, 2)
    assert np.isrealobj(jacobian)
    np.testing.assert_allclose(jacobian, df(x), rtol=4e-15, atol=4e-15)


def test_complex_step_loses_no_digits_where_differences_would():
    # A central difference of exp at 30 loses seven digits of sixteen; this loses none.
    x = np.array([30.0])
    np.testing.assert_allclose(complex_step_jacobian(np.exp, x)[0, 0], np.exp(30.0), rtol=1e-15)


@pytest.mark.parametrize(
    "cast",
    [
        lambda x: x.real**2,
        lambda x: np.abs(x),
        lambda x: np.real(x[..., :1]) * np.array([1.0, 2.0]),
    ],
)
def test_a_function_that_casts_to_real_is_an_error_rather_than_a_zero(cast):
    with pytest.raises(TypeError, match="real numbers for complex arguments"):
        complex_step_jacobian(cast, np.array([[0.3, -0.7]]))


@pytest.mark.filterwarnings("ignore::numpy.exceptions.ComplexWarning")
def test_a_function_that_fills_a_real_array_is_an_error():
    def fills(x):
        out = np.zeros(x.shape)
        out[..., 0] = x[..., 1] ** 2
        return out

    with pytest.raises(TypeError, match="analytic Jacobian"):
        complex_step_jacobian(fills, np.array([0.3, -0.7]))


def test_a_constant_function_is_rightly_real_and_has_no_derivative():
    # Additive noise: σ(t, x) = const, written without any thought of complex numbers.
    x = np.random.default_rng(1).normal(size=(4, 3))
    jacobian = complex_step_jacobian(lambda y: np.ones((*y.shape[:-1], 3, 2)), x)
    assert jacobian.shape == (4, 3, 2, 3)
    assert not jacobian.any()

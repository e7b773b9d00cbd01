"""Derivatives of a problem's functions: given, traced, or by differences that are checked."""

import numpy as np
import pytest
import scipy.interpolate

from slipcar.planner import Status, plan
from slipcar.planner.problem import jacobians
from slipcar.planner.problem.jacobians import Jacobians, differences


def _opaque(values):
    """The same numbers through code that leaves NumPy."""
    return np.array([float(v) for v in np.ravel(values)]).reshape(np.shape(values))


class System:
    """Three states, two controls, every function non-linear; derivatives below, by hand."""

    start = np.array([0.3, -0.2, 1.1])
    times = np.linspace(0.0, 1.0, 6)
    control_weight = np.eye(2)
    penalty_weight = np.ones(2)

    def drift(self, t, x, u):
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        rows = [b * np.sin(a), c * np.exp(-t) + u[..., 0] * a, np.cos(t) * u[..., 1] - c**3]
        return np.stack(rows, axis=-1)

    def diffusion(self, t, x):
        sigma = np.zeros((*x.shape[:-1], 3, 2), dtype=x.dtype)
        sigma[..., 0, 0], sigma[..., 1, 1] = x[..., 1] * x[..., 2], t * x[..., 0] ** 2
        return sigma

    def penalty(self, t, x):
        return np.stack([x[..., 0] * x[..., 1], t - np.sqrt(1.0 + x[..., 2] ** 2)], axis=-1)

    def terminal(self, x):
        return np.stack([np.arctan2(x[..., 1], 2.0 + x[..., 0] ** 2)], axis=-1)

    def state_cost(self, t, x):
        return np.exp(0.3 * x[..., 0]) * x[..., 1] ** 2 + t * x[..., 2] ** 3

    def control_cost(self, t, x):
        return np.stack([x[..., 0] * x[..., 2], t * x[..., 1] ** 2], axis=-1)


def _exact(t, x, u):
    """Derivatives of `System`, by name."""
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    lead = x.shape[:-1]
    A, B = np.zeros((*lead, 3, 3)), np.zeros((*lead, 3, 2))
    A[..., 0, 0], A[..., 0, 1] = b * np.cos(a), np.sin(a)
    A[..., 1, 0], A[..., 1, 2], A[..., 2, 2] = u[..., 0], np.exp(-t), -3.0 * c**2
    B[..., 1, 0], B[..., 2, 1] = a, np.cos(t)
    sigma = np.zeros((*lead, 3, 2, 3))
    sigma[..., 0, 0, 1], sigma[..., 0, 0, 2], sigma[..., 1, 1, 0] = c, b, 2.0 * t * a
    C = np.zeros((*lead, 2, 3))
    C[..., 0, 0], C[..., 0, 1], C[..., 1, 2] = b, a, -c / np.sqrt(1.0 + c**2)
    w = 2.0 + a**2
    G = np.zeros((*lead, 1, 3))
    G[..., 0, 0], G[..., 0, 1] = -2.0 * a * b / (w**2 + b**2), w / (w**2 + b**2)
    e = np.exp(0.3 * a)
    gradient = np.stack([0.3 * e * b**2, 2.0 * e * b, 3.0 * t * c**2], axis=-1)
    H = np.zeros((*lead, 3, 3))
    H[..., 0, 0], H[..., 1, 1], H[..., 2, 2] = 0.09 * e * b**2, 2.0 * e, 6.0 * t * c
    H[..., 0, 1] = H[..., 1, 0] = 0.6 * e * b
    ell = np.zeros((*lead, 2, 3))
    ell[..., 0, 0], ell[..., 0, 2], ell[..., 1, 1] = c, a, 2.0 * t * b
    return {
        "drift": (A, B), "diffusion": sigma, "penalty": C, "terminal": G,
        "state_cost": (gradient, H), "control_cost": ell,
    }  # fmt: skip


NAMES = ("drift", "diffusion", "penalty", "terminal", "state_cost", "control_cost")


def _asked(own, name, t, x, u):
    if name == "drift":
        return own.drift(t, x, u)
    if name == "state_cost":
        return own.state_cost(t, x)
    return (own.state(name, t, x),)


def _points(batch, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 1.0, batch), rng.normal(size=(*batch, 3)), rng.normal(size=(*batch, 2))


def _compared(own, name, at, rtol):
    exact = _exact(*at)[name]
    exact = exact if isinstance(exact, tuple) else (exact,)
    for got, known in zip(_asked(own, name, *at), exact, strict=True):
        assert got.shape == known.shape
        np.testing.assert_allclose(got, known, atol=rtol * (1.0 + np.abs(known).max()))


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("name", NAMES)
def test_traced_derivatives_are_the_closed_forms_to_rounding(name, batch):
    own = Jacobians(System(), 3, 2)
    _compared(own, name, _points(batch), 1e-14)
    assert own.differenced == {}
    assert not own.is_given(name)


def test_derivatives_of_functions_as_they_are_now():
    system = System()
    first = Jacobians(system, 3, 2)
    at = _points((4,))
    system.terminal = lambda x: 2.0 * System.terminal(system, x)
    second = Jacobians(system, 3, 2)
    known = _exact(*at)["terminal"]
    np.testing.assert_allclose(second.state("terminal", *at[:2]), 2.0 * known)
    assert np.shape(first.state("penalty", *at[:2])) == (4, 2, 3)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_given_is_taken_as_it_is_and_nothing_traced(name, monkeypatch):
    at = _points((4,))
    exact = _exact(*at)[name]
    mine = tuple(3.0 * e for e in exact) if isinstance(exact, tuple) else 3.0 * exact
    system = System()
    suffix = "derivatives" if name == "state_cost" else "jacobian"
    setattr(system, f"{name}_{suffix}", lambda *arguments: mine)
    own = Jacobians(system, 3, 2)
    monkeypatch.setattr(jacobians, "trace_call", None)
    got = _asked(own, name, *at)
    for part, known in zip(got, mine if isinstance(mine, tuple) else (mine,), strict=True):
        np.testing.assert_array_equal(part, known)
    assert own.is_given(name)
    own.check_given(name)


def _made_opaque(name):
    """The system with a function that cannot be traced and says why: float()."""

    class Opaque(System):
        pass

    original = getattr(System, name)

    def function(self, *arguments):
        return original(self, *(_opaque(argument) for argument in arguments))

    setattr(Opaque, name, function)
    return Opaque()


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("name", NAMES)
def test_functions_that_leave_numpy_are_differenced_and_said_so(name, batch):
    own = Jacobians(_made_opaque(name), 3, 2)
    _compared(own, name, _points(batch), 2e-7 if name == "state_cost" else 2e-9)
    assert list(own.differenced) == [name]
    assert "float()" in own.differenced[name]
    for other in NAMES:
        if other != name:
            _compared(own, other, _points(batch), 1e-14)
    assert list(own.differenced) == [name]


def test_a_spline_is_differenced():
    class Spline(System):
        road = scipy.interpolate.CubicSpline([-9.0, -1.0, 2.0, 9.0], [0.0, 1.0, -1.0, 4.0])

        def state_cost(self, t, x):
            return self.road(x[..., 0]) * x[..., 1]

    own, (t, x, _) = Jacobians(Spline(), 3, 2), _points((6,))
    gradient, hessian = own.state_cost(t, x)
    y, dy, ddy = (Spline.road(x[:, 0], k) for k in range(3))
    np.testing.assert_allclose(gradient, np.stack([dy * x[:, 1], y, 0.0 * y], -1), atol=1e-8)
    np.testing.assert_allclose(hessian[:, 0, 0], ddy * x[:, 1], atol=1e-6)
    np.testing.assert_allclose(hessian[:, 0, 1], dy, atol=1e-6)
    np.testing.assert_array_equal(hessian, hessian.swapaxes(1, 2))


@pytest.mark.parametrize(
    ("kink", "what"),
    [(lambda v: np.abs(v - 0.25), "smooth there"), (lambda v: 1.0 * (v > 0.25), "smooth there")],
)
def test_differences_of_what_is_not_smooth_are_an_error_that_names_it(kink, what):
    class Kinked(System):
        def terminal(self, x):
            return np.stack([kink(_opaque(x[..., 0]))], axis=-1)

    own = Jacobians(Kinked(), 3, 2)
    x = np.array([[0.25 + 2e-6, 0.0, 0.0]])  # nearer to the kink than the step
    with pytest.raises(ValueError, match=rf"derivative of terminal.*\[0, 0\].*{what}"):
        own.state("terminal", np.zeros(1), x)


def test_differences_of_single_precision_are_an_error():
    # A network that computes in single precision: its differences are rounding.
    class Single(System):
        def terminal(self, x):
            return np.sin(_opaque(x[..., :1]).astype(np.float32)).astype(float)

    with pytest.raises(ValueError, match="terminal_jacobian"):
        Jacobians(Single(), 3, 2).state("terminal", np.zeros(9), _points((9,))[1])


BRANCHES = {
    "drift": lambda t, x, u: x * (1.0 if (x > 0.0).all() else 2.0),
    "diffusion": lambda t, x: x[..., None] if (x > 0.0).all() else -x[..., None],
    "penalty": lambda t, x: np.sort(x, axis=-1)[..., :2],
    "terminal": lambda x: x[..., :1] if (x > 0.0).any() else x[..., 1:2],
    "state_cost": lambda t, x: x[..., 0] if max(x.ravel()) > 0.0 else x[..., 1],
    "control_cost": lambda t, x: np.round(x[..., :2]),
}


@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_so_that_it_cannot_be_traced_is_refused_by_name_and_line(name):
    system = System()
    setattr(system, name, BRANCHES[name])
    own = Jacobians(system, 3, 2)
    with pytest.raises(ValueError, match=rf"^{name}: .*test_derivatives\.py:\d+: .*{name}_jac"):
        own.check_given(name)
    with pytest.raises(ValueError, match=rf"^{name}: "):
        _asked(own, name, *_points((3,)))
    assert own.differenced == {}
    suffix = "derivatives" if name == "state_cost" else "jacobian"
    setattr(system, f"{name}_{suffix}", lambda *arguments: None)
    own.check_given(name)


@pytest.mark.parametrize("order", [2])
def test_central_differences_are_of_second_order(order):
    x = np.random.default_rng(1).normal(size=(7, 2))
    f = lambda y: np.stack([np.sin(y[..., 0]) * y[..., 1], np.exp(y[..., 1])], -1)  # noqa: E731
    exact = np.zeros((7, 2, 2))
    exact[:, 0, 0], exact[:, 0, 1] = np.cos(x[:, 0]) * x[:, 1], np.sin(x[:, 0])
    exact[:, 1, 1] = np.exp(x[:, 1])
    errors = [np.abs(differences(f, x, h) - exact).max() for h in (2e-2, 1e-2)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)
    # Steps follow the size of the states, and what is taken is what they came to in floating point.
    far = np.array([[1e9, 3.0]])
    np.testing.assert_allclose(differences(lambda y: y**2, far, 1e-5)[0, 0, 0], 2e9, rtol=1e-9)


def test_a_constant_function_has_no_derivative():
    system = System()
    system.diffusion = lambda t, x: np.ones((*x.shape[:-1], 3, 2))
    t, x, _ = _points((4,))
    slope = Jacobians(system, 3, 2).state("diffusion", t, x)
    assert slope.shape == (4, 3, 2, 3)
    assert not slope.any()


def test_a_plan_says_what_was_differentiated_numerically():
    class Cart:
        start = np.zeros(2)
        times = np.linspace(0.0, 2.0, 11)
        control_weight = np.eye(1)
        opaque = True

        def drift(self, t, x, u):
            x = _opaque(x) if self.opaque else x
            return np.stack([x[..., 1], u[..., 0] - 0.3 * np.sin(x[..., 0])], axis=-1)

        def diffusion(self, t, x):
            return np.full((*x.shape[:-1], 2, 1), 0.1)

        def terminal(self, x):
            return x - np.array([1.0, 0.0])

    cart = Cart()
    found = plan(cart, tolerance=1e-10)
    assert found.status is Status.CONVERGED
    assert found.message == "differentiated numerically, as they cannot be traced: drift"
    cart.opaque = False
    traced = plan(cart, tolerance=1e-10)
    assert traced.message == ""
    np.testing.assert_allclose(found.controls, traced.controls, atol=1e-7)

"""x(0) ~ N(start, Σ_0): its spread is in every moment, expectation and simulated path."""

import dataclasses
import types

import numpy as np
import pytest
from scipy.stats import binom, norm

from slipcar.planner import Plan, RecedingHorizon, Status, plan, plan_batch
from slipcar.planner.extremal.certificate import certify
from slipcar.planner.moments.gains import lqr_gains
from slipcar.planner.moments.monte_carlo import violations

#: Position and speed, correlated.
SPREAD = np.array([[0.04, 0.012], [0.012, 0.09]])


@dataclasses.dataclass(frozen=True)
class Cart:
    """A double integrator that the road shakes."""

    start_covariance: tuple = tuple(map(tuple, SPREAD.tolist()))
    horizon: float = 2.0
    noise: float = 0.2
    start: tuple = (0.0, 0.0)
    control_weight = np.eye(1)

    @property
    def times(self):
        return np.linspace(0.0, self.horizon, 21)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def diffusion(self, t, x):
        return np.broadcast_to([[0.0], [self.noise]], (*x.shape[:-1], 2, 1))

    def terminal(self, x):
        return x - np.array([1.0, 0.0])


KNOWN = dataclasses.replace(Cart(), start_covariance=None)


def spread_of(cart):
    """Σ at every node: what Euler's double integrator makes of Σ_0 and of white noise."""
    t, dt = cart.times, cart.times[1]
    (a, c), (_, b) = cart.start_covariance or np.zeros((2, 2))
    k, q = np.arange(len(t)), cart.noise**2 * dt
    position = a + 2.0 * c * t + b * t**2 + q * dt**2 * (k - 1) * k * (2 * k - 1) / 6.0
    mixed = c + b * t + q * dt * k * (k - 1) / 2.0
    return np.moveaxis(np.array([[position, mixed], [mixed, b + q * k]]), -1, 0)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compiled": False},
        {"method": "convex"},
        {"shooting": True},
        {"variance_weight": 0.0},
        {"expected": True},
        {"expected": True, "compiled": False},
    ],
    ids=str,
)
def test_a_linear_system_spreads_by_the_closed_form(options):
    p = plan(Cart(), tolerance=1e-12, **options)
    assert p.status is Status.CONVERGED
    known = spread_of(Cart())
    np.testing.assert_allclose(p.covariance, known, rtol=1e-9, atol=1e-12)
    integral = 0.1 * np.trace(known[1:], axis1=1, axis2=2).sum()
    assert p.variance == pytest.approx(integral, rel=1e-9)
    if p.options["variance_weight"] > 0.0:
        assert p.history[-1].variance == pytest.approx(integral, rel=1e-9)
    # Where A does not depend on the path, it changes no optimum.
    calm = plan(KNOWN, tolerance=1e-12, **options)
    np.testing.assert_allclose(p.controls, calm.controls, atol=1e-7)
    assert not calm.covariance[0].any()


def test_the_price_of_a_longer_horizon_counts_the_start():
    def worth(T):
        p = plan(Cart(horizon=T), tolerance=1e-12)
        return p.cost + p.variance, p

    slope = (worth(2.0 + 1e-4)[0] - worth(2.0 - 1e-4)[0]) / 2e-4
    found = certify(worth(2.0)[1], time_weight=1.0)
    assert 1.0 - found.transversality - 2.0 == pytest.approx(slope, abs=1e-5)
    assert abs(slope - certify(plan(KNOWN), time_weight=1.0).transversality) > 0.1


def test_a_file_and_a_batch_keep_it(tmp_path):
    p = plan(Cart())
    loaded = Plan.load(p.save(tmp_path / "plan.npz"))
    np.testing.assert_array_equal(loaded.covariance, p.covariance)
    several = [Cart(), KNOWN, Cart(start_covariance=((1.0, 0.0), (0.0, 0.0)))]
    for problem, q in zip(several, plan_batch(several), strict=True):
        np.testing.assert_allclose(q.covariance, spread_of(problem), rtol=1e-9, atol=1e-12)
    moved = plan_batch(Cart(), initial_states=[[0.1, 0.0], [0.3, 0.2]])
    for q in moved:
        np.testing.assert_allclose(q.covariance, spread_of(Cart()), rtol=1e-9, atol=1e-12)


# ------------------------------------------------------------------------------ expectations


@pytest.mark.parametrize("compiled", [None, False])
def test_feedback_of_a_regulator_costs_what_riccati_says(compiled):
    """x₀ᵀP₀x₀ + tr P₀Σ₀ + Σ dt tr Pσσᵀ, by the recursion of the cost to go."""
    W, dt = np.diag([50.0, 5.0]), 0.1
    p = plan(Cart(), feedback=True, terminal_weight=[50.0, 5.0], tolerance=1e-14, compiled=compiled)
    gains = lqr_gains(p.A, p.B, np.full(20, dt), np.zeros((2, 2)), np.eye(1), W)
    np.testing.assert_allclose(p.gains, gains, rtol=1e-8, atol=1e-10)
    P, total = W, 0.0
    sigma = np.array([[0.0], [0.2]])
    for A, B, K in zip(p.A[::-1], p.B[::-1], gains[::-1], strict=True):
        total += dt * float(np.trace(P @ sigma @ sigma.T))
        P = (A + B @ K).T @ P @ (A + B @ K) + dt * K.T @ K
    x = np.array([-1.0, 0.0])
    assert p.expected.total == pytest.approx(x @ P @ x + np.trace(P @ SPREAD) + total, rel=1e-8)


def glider(deviation):
    """A unicycle past a soft wall: (r_x, r_y, θ, v), uncertain where it begins and heads."""

    def drift(t, x, u):
        theta, v = x[..., 2], x[..., 3]
        return np.stack([v * np.cos(theta), v * np.sin(theta), u[..., 0], u[..., 1]], axis=-1)

    return types.SimpleNamespace(
        start=np.array([0.0, 0.0, 0.9, 0.6]),
        start_covariance=np.diag(np.square(deviation)),
        times=np.linspace(0.0, 2.0, 21),
        control_weight=np.eye(2),
        drift=drift,
        diffusion=lambda t, x: np.full((*x.shape[:-1], 4, 1), 0.01) * x[..., 3:, None],
        terminal=lambda x: x[..., :2] - np.array([1.0, 0.1]),
        penalty=lambda t, x: x[..., 1:2] - 0.25,
        penalty_weight=np.array([200.0]),
    )


def fly(problem, p, paths, seed=0):
    """States (N, paths, n) and the penalty's cost (paths,) under the law of a plan."""
    rng, t = np.random.default_rng(seed), p.times
    x = rng.multivariate_normal(problem.start, problem.start_covariance, paths)
    gains = np.zeros((len(t) - 1, p.controls.shape[1], x.shape[1])) if p.gains is None else p.gains
    states, cost = [x], 0.0
    for k, dt in enumerate(np.diff(t)):
        u = p.controls[k] + (x - p.mean[k]) @ gains[k].T
        sigma = problem.diffusion(t[k], x)
        noise = np.sqrt(dt) * rng.standard_normal((paths, sigma.shape[-1]))
        x = x + dt * problem.drift(t[k], x, u) + np.einsum("bij,bj->bi", sigma, noise)
        states.append(x)
        cost += dt * np.maximum(problem.penalty(t[k + 1], x), 0.0) ** 2 @ problem.penalty_weight
    return np.array(states), cost


@pytest.mark.parametrize("feedback", [False, True])
def test_a_nonlinear_system_spreads_as_its_paths_do(feedback):
    problem = glider([0.03, 0.02, 0.05, 0.03])
    p = plan(problem, expected=True, feedback=feedback)
    assert p.status is Status.CONVERGED
    states, penalty = fly(problem, p, 20_000)
    for k in (0, 7, 20):
        sampled = np.cov(states[k].T)
        size = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
        np.testing.assert_allclose(p.covariance[k] / size, sampled / size, atol=0.03)
    assert p.expected.penalty == pytest.approx(penalty.mean(), rel=0.1, abs=1e-4)
    # Who knows that he does not know where he starts keeps off the wall, and it pays.
    sure = plan(glider(np.zeros(4)), expected=True, feedback=feedback)
    other = fly(problem, sure, 20_000)[1].mean()
    assert penalty.mean() < 0.8 * other
    assert p.effort + penalty.mean() < sure.effort + other


def test_a_replan_begins_where_it_is():
    """The first plan does not know its start, those from observed states do."""
    problem = glider([0.05, 0.03, 0.1, 0.05])
    x = problem.start + np.array([0.03, -0.04, 0.08, 0.02])
    here = plan(types.SimpleNamespace(**{**vars(glider(np.zeros(4))), "start": x}), feedback=True)
    for compiled in (False, None):
        controller = RecedingHorizon(problem, iterations=40, tolerance=1e-9, compiled=compiled)
        np.testing.assert_array_equal(controller.plan.covariance[0], problem.start_covariance)
        u, _ = controller.predict(np.append(x, 0.0))
        assert controller.failures == 0
        np.testing.assert_allclose(u, here.controls[0], atol=2e-3)
        assert np.abs(u - controller.plan.controls[0]).max() > 0.02


# ------------------------------------------------------------------------------ simulated paths


def walk(start_covariance, noise=0.5):
    return types.SimpleNamespace(
        start=np.array([0.1, -0.2]),
        start_covariance=start_covariance,
        times=np.array([0.0, 0.5]),
        control_weight=np.eye(2),
        drift=lambda t, x, u: u + 0.0 * x,
        diffusion=lambda t, x: np.broadcast_to(noise * np.eye(2), (*x.shape, 2)),
        terminal=lambda x: x,
        constraint=lambda t, x: x.sum(axis=-1, keepdims=True) - 1.0,
    )


@pytest.mark.parametrize("S", [SPREAD, np.array([[0.4, -0.4], [-0.4, 0.4]]), np.ones((2, 2))])
def test_simulated_paths_begin_anywhere(S):
    n = 60_000
    found = violations(walk(S), lambda t, x: np.zeros(2), episodes=n, seed=3)
    p = norm.sf(1.1 / np.sqrt(2.0 * 0.5 * 0.25 + S.sum()))
    low, high = binom.ppf([5e-6, 1.0 - 5e-6], n, p)
    assert low <= found.sum() <= high


def test_an_uncertain_start_leaves_the_brownian_paths_as_they_are():
    rates = [
        violations(walk(S), lambda t, x: np.zeros(2), episodes=5_000, seed=1)
        for S in (None, 1e-20 * np.eye(2), 0.1 * np.eye(2))
    ]
    np.testing.assert_array_equal(rates[0], rates[1])
    assert np.mean(rates[0] != rates[2]) < 0.25
    assert rates[2].sum() > rates[0].sum()


# ------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.eye(3), r"start_covariance must have shape \(2, 2\), not \(3, 3\)"),
        (np.ones(2), r"start_covariance must have shape \(2, 2\), not \(2,\)"),
        ([[1.0, 0.2], [0.1, 1.0]], r"symmetric, but \[0, 1\] is 0\.2 and \[1, 0\] is 0\.1"),
        ([[1.0, 2.0], [2.0, 1.0]], r"positive semidefinite, but has the eigenvalue -1"),
        ([[1.0, 0.0], [0.0, np.nan]], r"start_covariance\[1, 1\] must be finite, not nan"),
        ("wide", "start_covariance must be numbers"),
    ],
)
def test_a_covariance_that_is_none_is_named(given, message):
    problem = walk(given)
    for call in (plan, lambda p: violations(p, lambda t, x: np.zeros(2), episodes=1, seed=0)):
        with pytest.raises(ValueError, match=message):
            call(problem)

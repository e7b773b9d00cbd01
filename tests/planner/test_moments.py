"""Mean and covariance of linear systems: closed forms, Monte Carlo, sensitivities."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipcar.planner import plan
from slipcar.planner.moments import covariance as moments
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import model_of


def random_system(seed, K=6, n=3, d=2):
    rng = np.random.default_rng(seed)
    A = np.eye(n) + 0.3 * rng.normal(size=(K, n, n))
    return A, rng.normal(size=(K, n, d)), rng.uniform(0.1, 0.4, size=K), rng


def test_covariance_of_a_scalar_process_is_a_geometric_sum():
    K, a, sigma, dt = 50, 0.93, 0.4, 0.1
    S = moments.covariance(np.full((K, 1, 1), a), np.full((K, 1, 1), sigma), np.full(K, dt))
    k = np.arange(K + 1)
    np.testing.assert_allclose(S[:, 0, 0], dt * sigma**2 * (1 - a ** (2 * k)) / (1 - a**2))


def test_covariance_of_a_noisy_double_integrator():
    # Noise s on the speed alone, held dt: Var r_K = s² dt³ Σ j², Cov = s² dt² Σ j, Var v = s² T.
    K, dt, s = 30, 0.05, 0.7
    A = np.broadcast_to([[1.0, dt], [0.0, 1.0]], (K, 2, 2))
    sigma = np.broadcast_to([[0.0], [s]], (K, 2, 1))
    S = moments.covariance(A, sigma, np.full(K, dt))[-1]
    j = np.arange(K)
    expected = s**2 * dt * np.array([[dt**2 * (j**2).sum(), dt * j.sum()], [dt * j.sum(), K]])
    np.testing.assert_allclose(S, expected, rtol=1e-13)


def test_covariance_against_monte_carlo():
    A, sigma, dt, rng = random_system(0)
    paths = 100_000
    x = np.zeros((paths, 3))
    S = moments.covariance(A, sigma, dt)
    for k in range(len(A)):
        x = x @ A[k].T + np.sqrt(dt[k]) * rng.normal(size=(paths, 2)) @ sigma[k].T
        sampled = x.T @ x / paths
        variances = np.diag(S[k + 1])
        error = np.sqrt((np.outer(variances, variances) + S[k + 1] ** 2) / paths)
        assert np.all(np.abs(sampled - S[k + 1]) < 4.5 * error)


@given(st.integers(0, 10**6), st.integers(1, 8), st.integers(1, 4), st.integers(1, 3))
def test_covariance_is_symmetric_positive_semidefinite(seed, K, n, d):
    A, sigma, dt, _ = random_system(seed, K, n, d)
    S = moments.covariance(10.0 * A, sigma, dt)
    for block in S:
        size = np.max(np.abs(block))
        np.testing.assert_allclose(block, block.T, atol=1e-12 * size)
        assert np.linalg.eigvalsh(block)[0] >= -1e-11 * size


@given(st.integers(0, 10**6), st.integers(1, 8))
def test_adjoint_sweep_gives_the_trace_integral(seed, K):
    A, sigma, dt, _ = random_system(seed, K)
    integral = moments.trace_integral(moments.covariance(A, sigma, dt), dt)
    Lambda = moments.adjoint_weights(A, dt)
    by_adjoint = sum(dt[k] * np.trace(Lambda[k] @ sigma[k] @ sigma[k].T) for k in range(K))
    assert by_adjoint == pytest.approx(integral, rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_variance_penalty_is_the_integral_for_any_deviation(seed):
    # σ linear in the deviation: then the quadratic is no approximation at all.
    A, sigma, dt, rng = random_system(seed)
    d_sigma, w = rng.normal(size=(*sigma.shape, 3)), 3.7
    v = moments.variance_penalty(w, sigma, d_sigma, moments.adjoint_weights(A, dt), dt)
    for scale in (0.0, 1e-3, 1.0, 50.0):
        d = scale * rng.normal(size=(len(A), 3))
        shifted = sigma + np.einsum("kndi,ki->knd", d_sigma, d)
        exact = w * moments.trace_integral(moments.covariance(A, shifted, dt), dt)
        model = v.value + np.sum(v.gradient * d) + 0.5 * np.einsum("ki,kij,kj", d, v.hessian, d)
        assert model == pytest.approx(exact, rel=1e-11)
    np.testing.assert_allclose(v.hessian, v.hessian.swapaxes(1, 2), rtol=1e-12)
    assert np.linalg.eigvalsh(v.hessian).min() > -1e-12


def test_variance_gradient_equals_differences_along_the_cars_path(paper, exact_paper_plan):
    model, p, w = model_of(paper), exact_paper_plan, 2.0
    at = linearize(model, p.mean, p.controls)
    d_sigma = model.diffusion_jacobian(model.times[:-1], p.mean[:-1])
    v = moments.variance_penalty(
        w, at.sigma, d_sigma, moments.adjoint_weights(at.A, model.dt), model.dt
    )

    def penalty(x):
        sigma = model.diffusion(model.times[:-1], x)
        return w * moments.trace_integral(moments.covariance(at.A, sigma, model.dt), model.dt)

    assert v.value == pytest.approx(penalty(p.mean[:-1]), rel=1e-12)
    h = 1e-5
    for d in np.random.default_rng(0).normal(size=(4, *p.mean[:-1].shape)):
        slope = (penalty(p.mean[:-1] + h * d) - penalty(p.mean[:-1] - h * d)) / (2 * h)
        assert np.sum(v.gradient * d) == pytest.approx(slope, rel=1e-7)


def test_trust_region_weight_is_the_second_moment_of_the_coupled_error():
    # Two linear SDEs driven by the same Brownian motion; what lies between them on average?
    A, sigma, dt, rng = random_system(1)
    K, n, d_noise = sigma.shape
    d_sigma = 0.5 * rng.normal(size=(K, n, d_noise, n))
    deviation = 0.6 * rng.normal(size=(K, n))  # of nodes 1..K; node 0 is fixed
    Lambda = moments.adjoint_weights(A, dt)
    unit = moments.variance_penalty(1.0, sigma, d_sigma, Lambda, dt)
    W = moments.trust_region_weight(unit.hessian, dt)
    predicted = 0.5 * np.einsum("ki,kij,kj", deviation, W, deviation)

    paths = 100_000
    old, new = np.zeros((2, paths, n))  # noise parts of both processes
    integral = np.zeros(paths)
    at = np.vstack([np.zeros(n), deviation])
    for k in range(K):
        noise = np.sqrt(dt[k]) * rng.normal(size=(paths, d_noise))
        shifted = sigma[k] + d_sigma[k] @ at[k]
        old = old @ A[k].T + noise @ sigma[k].T
        new = new @ A[k].T + noise @ shifted.T
        integral += dt[k] * np.sum((at[k + 1] + new - old) ** 2, axis=1)
    error = integral.std() / np.sqrt(paths)
    assert error < 0.01 * predicted
    assert abs(integral.mean() - predicted) < 4.0 * error


def test_paper_covariance_is_the_references(exact_paper_plan, reference):
    p, known = exact_paper_plan, reference["clearance_0.13"]
    assert p.variance == pytest.approx(known["covariance_trace_integral"], rel=1e-6)
    assert p.variance == pytest.approx(0.05301, abs=1e-5)
    np.testing.assert_allclose(p.covariance[-1], known["covariance_terminal"], atol=1e-8)


def test_paper_covariance_agrees_with_a_million_paths(exact_paper_plan, reference):
    p, sampled = exact_paper_plan, reference["clearance_0.13"]["monte_carlo"]
    assert p.variance == pytest.approx(sampled["covariance_trace_integral"], rel=0.02)
    S, terminal = p.covariance[-1], np.array(sampled["covariance_terminal"])
    np.testing.assert_allclose(np.diag(S)[:3], np.diag(terminal)[:3], rtol=0.02)
    assert np.max(np.abs(S - terminal)) < 0.02 * np.max(terminal)
    assert not S[3:].any()  # the noise never reaches v and ω


def test_more_variance_weight_leaves_less_variance(paper):
    plans = [plan(paper, variance_weight=w) for w in (0.0, 1.0, 10.0, 100.0)]
    assert all(p.status.ok for p in plans)
    variances = [p.variance for p in plans]
    assert variances == sorted(variances, reverse=True)
    assert variances[3] < 0.5 * variances[0]
    assert np.all(np.diff([p.cost for p in plans]) > 0.0)

"""LQR gains against SciPy, brute force and their own optimality; controllers that use them."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from slipcar.planner import Feedback, OpenLoop, plan
from slipcar.planner.moments.gains import lqr_gains, weight_matrix


@pytest.fixture(scope="module")
def stochastic(paper):
    return plan(paper)


def system(seed=0, K=5, n=3, m=2):
    rng = np.random.default_rng(seed)
    A = np.eye(n) + 0.3 * rng.normal(size=(K, n, n))
    B = rng.normal(size=(K, n, m))
    half = rng.normal(size=(3, n, n))
    Q, Qf = half[0] @ half[0].T, half[1] @ half[1].T
    R = half[2][:m, :m] @ half[2][:m, :m].T + np.eye(m)
    return A, B, rng.uniform(0.1, 0.5, size=K), Q, R, Qf, rng


def test_gains_tend_to_those_of_the_algebraic_riccati_equation():
    A, B, _, Q, R, Qf, _ = system(K=1)
    K = 400
    dt = 0.1
    gains = lqr_gains(
        np.broadcast_to(A[0], (K, 3, 3)),
        np.broadcast_to(B[0], (K, 3, 2)),
        np.full(K, dt),
        Q,
        R,
        Qf,
    )
    P = solve_discrete_are(A[0], B[0], dt * Q, dt * R)
    expected = -np.linalg.solve(dt * R + B[0].T @ P @ B[0], B[0].T @ P @ A[0])
    np.testing.assert_allclose(gains[0], expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_gains_solve_the_condensed_least_squares(seed):
    A, B, dt, Q, R, Qf, rng = system(seed)
    K, n, m = B.shape
    gains = lqr_gains(A, B, dt, Q, R, Qf)
    x0 = rng.normal(size=n)
    # All controls at once: x_k = F_k x0 + G_k U, minimise a quadratic in U.
    F, G = np.eye(n), np.zeros((n, K * m))
    H = np.kron(np.diag(dt), R)
    g = np.zeros(K * m)
    for k in range(K):
        G = A[k] @ G
        G[:, k * m : (k + 1) * m] += B[k]
        F = A[k] @ F
        weight = Qf if k == K - 1 else dt[k + 1] * Q
        H = H + G.T @ weight @ G
        g = g + G.T @ weight @ F @ x0
    U = np.linalg.solve(H, -g).reshape(K, m)
    x = x0
    for k in range(K):
        u = gains[k] @ x
        np.testing.assert_allclose(u, U[k], rtol=1e-8, atol=1e-9)
        x = A[k] @ x + B[k] @ u


def test_feedback_shrinks_the_covariance_that_open_loop_leaves(paper, stochastic):
    p = stochastic
    gains = Feedback(p).plan.gains
    assert gains.shape == (40, 2, 5)
    sigma = paper.diffusion(p.times[:-1], p.mean[:-1])
    S = np.zeros((5, 5))
    for k in range(40):
        closed = p.A[k] + p.B[k] @ gains[k]
        S = closed @ S @ closed.T + paper.dt * sigma[k] @ sigma[k].T
    assert np.trace(S[:2, :2]) < 0.25 * np.trace(p.covariance[-1][:2, :2])


def test_dear_corrections_are_small_ones(stochastic):
    sizes = [np.abs(Feedback(stochastic, R=r).plan.gains).max() for r in (1.0, 100.0, 1e8)]
    assert sizes[0] > sizes[1] > sizes[2]
    assert sizes[2] < 1e-3
    assert not Feedback(stochastic, Q=0.0, Qf=0.0).plan.gains.any()


def test_weights_may_be_scalars_diagonals_or_matrices(stochastic):
    gains = [Feedback(stochastic, Q=q, Qf=qf).plan.gains for q, qf in [
        (2.0, 7.0), (np.full(5, 2.0), np.full(5, 7.0)), (2.0 * np.eye(5), 7.0 * np.eye(5)),
    ]]  # fmt: skip
    np.testing.assert_array_equal(gains[0], gains[1])
    np.testing.assert_array_equal(gains[0], gains[2])
    # Only the symmetric part of a quadratic form means anything.
    skew = np.triu(np.ones((5, 5)), 1)
    lopsided = Feedback(stochastic, Q=2.0 * np.eye(5) + skew - skew.T, Qf=7.0).plan.gains
    np.testing.assert_allclose(lopsided, gains[0], rtol=1e-12)


def test_own_gains_are_used_as_they_are(stochastic):
    own = np.random.default_rng(0).normal(size=(40, 2, 5))
    controller = Feedback(stochastic.replace(gains=own))
    np.testing.assert_array_equal(controller.plan.gains, own)
    x = stochastic.mean[3] + 1e-3
    wanted = stochastic.controls[3] + own[3] @ np.full(5, 1e-3)
    np.testing.assert_allclose(controller.control(stochastic.times[3], x), wanted, rtol=1e-9)


@pytest.mark.parametrize("shape", [(40, 5, 2), (39, 2, 5), (2, 5), (40, 2)])
def test_gains_of_the_wrong_shape_are_refused(stochastic, shape):
    with pytest.raises(ValueError, match=r"\(40, 2, 5\)"):
        Feedback(stochastic.replace(gains=np.zeros(shape)))


def test_gains_that_are_not_numbers_are_refused(stochastic):
    with pytest.raises(ValueError, match="finite"):
        Feedback(stochastic.replace(gains=np.full((40, 2, 5), np.nan)))


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"Q": np.ones(3)}, r"Q must be a scalar, \(5,\) or \(5, 5\)"),
        ({"Q": -1.0}, "Q must be finite and positive semidefinite"),
        ({"Q": np.array([1.0, 1.0, np.nan, 1.0, 1.0])}, "Q must be finite"),
        ({"Q": "large"}, "Q must be numbers"),
        ({"Qf": np.diag([1.0, 1.0, 1.0, 1.0, -1.0])}, "Qf must be finite and positive semi"),
        ({"R": 0.0}, "R must be finite and positive definite"),
        ({"R": np.diag([1.0, 0.0])}, "R must be finite and positive definite"),
        ({"R": np.eye(3)}, r"R must be a scalar, \(2,\) or \(2, 2\)"),
    ],
)
def test_bad_weights_are_refused(stochastic, weights, message):
    with pytest.raises(ValueError, match=message):
        Feedback(stochastic, **weights)


def test_a_rank_one_weight_of_any_size_passes_in_spite_of_rounding():
    v = np.array([1.0, 1e4, -3e3, 7.0, 1e-3])
    np.testing.assert_array_equal(weight_matrix("Q", np.outer(v, v), 5), np.outer(v, v))


def test_a_plan_without_a_problem_is_not_given_another_weight(stochastic):
    with pytest.raises(ValueError, match=r"neither its problem nor .*plan.replace\(problem=...\)"):
        Feedback(stochastic.replace(problem=None))


def test_on_the_mean_feedback_plays_the_plan(stochastic):
    p = stochastic
    a, b = OpenLoop(p), Feedback(p)
    for k in range(40):
        np.testing.assert_allclose(b.control(p.times[k], p.mean[k]), p.controls[k], atol=1e-12)
        np.testing.assert_array_equal(a.control(p.times[k], p.mean[k]), p.controls[k])

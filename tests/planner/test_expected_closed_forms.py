"""Expected costs whose answers are known: regulators, least norms, marginal costs."""

import numpy as np
import pytest

from slipcar.planner.search.field import charged, expected_cost


def additive(mass, *, nodes=16):
    """A linear system with a quadratic cost and additive noise; the end at the origin."""
    problem = mass(walls=False, slip=0.0, nodes=nodes)
    problem.terminal = lambda x: 1.0 * x
    problem.start = np.array([1.0, -0.5, 0.3, 0.8])
    return problem


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("feedback", [True, False])
def test_additive_noise_leaves_the_regulators_mean(feedback, compiled, settle, mass):
    """Certainty equivalence, E J = x₀ᵀP₀x₀ + Σ dt tr(Pσσᵀ), and the same by simulation."""
    posed, stakes, answer = settle(
        additive(mass), compiled=compiled, soft=True, feedback=feedback, price=0.0
    )
    assert answer.status.ok
    model = posed.model
    dt, t, n = model.dt, model.times, 4
    A, B = model.drift_jacobian(t[:-1], answer.x[:-1], answer.u)
    sigma, shape = model.diffusion(t[:-1], answer.x[:-1]), np.diag([0.2, 0.1, 0.4, 0.3]) + 0.05
    # Riccati's recursion written out, H charged at nodes 1..K with the dt that ends there.
    V = dt[-1] * shape + np.diag(stakes.terminal)
    W = V.copy()  # of deviations
    laws, noise = [None] * len(dt), 0.0
    for k in range(len(dt) - 1, -1, -1):
        noise += dt[k] * np.trace(W @ sigma[k] @ sigma[k].T)
        F, G = np.eye(n) + dt[k] * A[k], dt[k] * B[k]
        laws[k] = -np.linalg.solve(dt[k] * model.R + G.T @ V @ G, G.T @ V @ F)
        closed = F + G @ laws[k]
        here = dt[k - 1] * shape if k else 0.0
        V = closed.T @ V @ closed + dt[k] * laws[k].T @ model.R @ laws[k] + here
        W = V if feedback else F.T @ W @ F + here
    x = model.start
    for k, law in enumerate(laws):
        np.testing.assert_allclose(answer.u[k], law @ x, atol=1e-7)
        np.testing.assert_allclose(answer.gains[k], law if feedback else 0.0, atol=1e-9)
        x = x + dt[k] * model.drift(t[k], x, answer.u[k])
    expected = model.start @ V @ model.start + noise
    assert charged(model, stakes, answer) == pytest.approx(expected, rel=1e-9)
    total = expected_cost(model, stakes, answer).total
    assert total == pytest.approx(expected, rel=1e-9)
    # What the iteration itself charges, P and gains held, is the same.
    assert answer.objective == pytest.approx(expected, rel=1e-9)
    # By simulation.
    rng, paths = np.random.default_rng(1), 100_000
    x, costs = np.tile(model.start, (paths, 1)), np.zeros(paths)
    for k in range(len(dt)):
        u = answer.u[k] + (x - answer.x[k]) @ answer.gains[k].T
        costs += dt[k] * np.einsum("ei,ij,ej->e", u, model.R, u)
        x = x + dt[k] * model.drift(t[k], x, u)
        x += np.sqrt(dt[k]) * rng.standard_normal((paths, 2)) @ sigma[k].T
        costs += dt[k] * np.einsum("ei,ij,ej->e", x, shape, x)
    costs += np.einsum("ei,i,ei->e", x, stakes.terminal, x)
    assert abs(costs.mean() - total) < 5.0 * costs.std() / np.sqrt(paths)


def test_least_effort_to_an_exact_end_is_the_least_norm_solution(settle, mass):
    problem = mass(walls=False, slip=0.0, curved=False)
    posed, _, answer = settle(problem, soft=False, feedback=False, price=0.0)
    model = posed.model
    K, m, n = len(model.dt), 2, 4
    A, B = model.drift_jacobian(model.times[:-1], answer.x[:-1], answer.u)
    reach, free = np.zeros((n, K * m)), model.start
    for k in range(K):
        F = np.eye(n) + model.dt[k] * A[k]
        reach, free = F @ reach, F @ free
        reach[:, k * m : (k + 1) * m] = model.dt[k] * B[k]
    weight = np.linalg.inv(np.kron(np.diag(model.dt), model.R))
    goal = -model.terminal(np.zeros(n))
    u = weight @ reach.T @ np.linalg.solve(reach @ weight @ reach.T, goal - free)
    np.testing.assert_allclose(answer.u, u.reshape(K, m), atol=1e-8)


def test_multipliers_at_a_solution_are_the_marginal_cost_of_the_end(settle, mass, nominal):
    """Moving the goal by g changes the least expected cost by νᵀg (or by 2Wg where it is soft)."""
    problem, h = mass(), 1e-5
    goal = np.array([1.0, 0.7, 0.0, 0.0])
    start = nominal(problem)
    asked = {"soft": False, "feedback": False, "price": 2.0, "tolerance": 1e-18, "start": start}
    _, _, answer = settle(problem, **asked)
    for i in range(4):
        costs = []
        for sign in (1.0, -1.0):
            moved = mass()
            to = goal + sign * h * np.eye(4)[i]
            moved.terminal = lambda x, to=to: x - to
            posed, stakes, there = settle(moved, **asked)
            costs.append(charged(posed.model, stakes, there))
        # L = J + νᵀg with g = x − goal: dJ/dgoal = −ν.
        assert (costs[0] - costs[1]) / (2 * h) == pytest.approx(-answer.terminal[i], rel=1e-3)

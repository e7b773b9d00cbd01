"""Steps of the mean: convergence orders, exact derivatives, plans that the true system follows."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from slipcar.envs import Scenario
from slipcar.planner import Status, plan
from slipcar.planner.problem.integrators import INTEGRATORS, change, jacobian
from slipcar.planner.problem.jacobians import differences
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import model_of


class Rocket:
    """Time, states and controls all enter non-linearly but for the control itself."""

    start = np.array([0.3, -0.2, 1.0])
    control_weight = np.diag([0.5, 1.0])

    def __init__(self, nodes=21, T=1.5):
        self.times = np.linspace(0.0, T, nodes)

    def drift(self, t, x, u):
        a, b, c = x[..., 0], x[..., 1], x[..., 2]
        rows = [b, np.sin(a) * c + u[..., 0] * np.cos(b), -c * a + (1.0 + 0.5 * t) * u[..., 1]]
        return np.stack(rows, axis=-1)

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 3, 1), 0.1)

    def terminal(self, x):
        return x[..., :2] - np.array([0.5, 0.0])


def exact(problem, t, dt, x, u):
    """The flow over one interval with the control held, to 12 digits."""
    right = lambda s, y: problem.drift(np.array(s), y, u)  # noqa: E731
    found = solve_ivp(right, (t, t + dt), x, method="DOP853", rtol=1e-13, atol=1e-13)
    return found.y[:, -1]


@pytest.mark.parametrize(("name", "order"), [("euler", 1), ("rk4", 4)])
def test_the_order_of_a_step(name, order):
    problem, x, u = Rocket(), np.array([0.4, -0.3, 0.8]), np.array([0.7, -0.5])
    lengths = np.array([0.2, 0.1, 0.05])
    errors = [
        np.linalg.norm(
            x + change(name, problem.drift, np.array(0.2), np.array(h), x, u)
            - exact(problem, 0.2, h, x, u)
        )
        for h in lengths
    ]  # fmt: skip
    measured = np.log2(errors[0] / errors[1]), np.log2(errors[1] / errors[2])
    np.testing.assert_allclose(measured, order + 1, atol=0.15)  # of one step: one more


@pytest.mark.parametrize("name", INTEGRATORS)
def test_jacobians_are_those_of_the_step(name):
    problem = Rocket()
    model, rng = model_of(problem), np.random.default_rng(0)
    x, u = rng.normal(size=(7, 3)), rng.normal(size=(7, 2))
    t, dt = rng.uniform(0.0, 1.0, 7), rng.uniform(0.05, 0.4, 7)
    A, B = jacobian(name, model.drift, model.drift_jacobian, t, dt, x, u)
    by_x = differences(lambda y: y + change(name, model.drift, t, dt, y, u), x, 1e-5)
    by_u = differences(lambda v: x + change(name, model.drift, t, dt, x, v), u, 1e-5)
    np.testing.assert_allclose(A, by_x, atol=1e-9)
    np.testing.assert_allclose(B, by_u, atol=1e-9)


def test_on_a_linear_system_rk4_is_the_exponential_to_fourth_order():
    M = np.array([[0.0, 1.0], [-3.0, -0.4]])
    at_all = lambda M, x: np.broadcast_to(M, (*x.shape, 2))  # noqa: E731
    A, B = jacobian(
        "rk4",
        lambda t, x, u: x @ M.T + u,
        lambda t, x, u: (at_all(M, x), at_all(np.eye(2), x)),
        np.zeros(1),
        np.full(1, 0.3),
        np.ones((1, 2)),
        np.ones((1, 2)),
    )  # fmt: skip
    hM = 0.3 * M
    powers = [np.eye(2), hM, hM @ hM / 2, hM @ hM @ hM / 6, hM @ hM @ hM @ hM / 24]
    np.testing.assert_allclose(A[0], sum(powers), rtol=1e-13)
    integral = 0.3 * (np.eye(2) + hM / 2 + hM @ hM / 6 + hM @ hM @ hM / 24)
    np.testing.assert_allclose(B[0], integral, rtol=1e-13)


def flown(problem, p):
    """States where the continuous system really gets under the plan's controls, (N, n)."""
    path = [problem.start]
    for k, u in enumerate(p.controls):
        t, dt = problem.times[k], problem.times[k + 1] - problem.times[k]
        path.append(exact(problem, t, dt, path[-1], u))
    return np.array(path)


@pytest.mark.parametrize(("name", "order"), [("euler", 1), ("rk4", 4)])
def test_the_mean_meets_the_continuous_system_at_the_integrators_order(name, order):
    errors = []
    for nodes in (9, 17, 33):
        problem = Rocket(nodes)
        p = plan(problem, integrator=name, variance_weight=0.0, tolerance=1e-14)
        assert p.status is Status.CONVERGED
        assert p.options["integrator"] == name
        errors.append(np.max(np.abs(flown(problem, p) - p.mean)))
    measured = np.log2(errors[1] / errors[2])
    assert measured == pytest.approx(order, abs=0.3)
    assert errors[2] < (0.1 if name == "euler" else 1e-5)


def test_rk4_plans_arrive_where_euler_plans_miss():
    car = Scenario.named("paper")
    a = plan(car, variance_weight=0.0, integrator="rk4", tolerance=1e-8)
    b = plan(car, variance_weight=0.0, tolerance=1e-8)
    assert a.status is b.status is Status.CONVERGED
    assert np.max(np.abs(flown(car, a)[-1] - car.goal)) < 1e-4
    assert np.max(np.abs(flown(car, b)[-1] - car.goal)) > 1e-2
    # Both are first-order near the continuous optimum and a step apart.
    assert a.cost == pytest.approx(b.cost, rel=0.1)


def test_covariance_uses_the_integrators_matrices():
    problem = Rocket()
    p = plan(problem, integrator="rk4")
    S = np.zeros((3, 3))
    noise = np.full((3, 1), 0.1)
    for k, dt in enumerate(np.diff(problem.times)):
        S = p.A[k] @ S @ p.A[k].T + dt * noise @ noise.T
        np.testing.assert_allclose(p.covariance[k + 1], S, rtol=1e-12)
    assert not np.allclose(p.A, plan(problem).A, atol=1e-3)


def test_euler_is_the_papers_step():
    problem = Rocket()
    model, rng = model_of(problem), np.random.default_rng(3)
    x, u = rng.normal(size=(21, 3)), rng.normal(size=(20, 2))
    at = linearize(model, x, u)
    dt = np.diff(problem.times)[:, None]
    A, B = model.drift_jacobian(problem.times[:-1], x[:-1], u)
    np.testing.assert_array_equal(at.A, np.eye(3) + dt[..., None] * A)
    np.testing.assert_array_equal(at.B, dt[..., None] * B)
    b = model.drift(problem.times[:-1], x[:-1], u)
    np.testing.assert_allclose(at.defect, x[:-1] + dt * b - x[1:], atol=1e-15)
    fourth = linearize(dataclasses.replace(model, integrator="rk4"), x, u)
    assert np.max(np.abs(fourth.defect - at.defect)) > 1e-4


def test_an_unknown_integrator_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown integrator 'heun'.*euler.*rk4"):
        plan(Rocket(), integrator="heun")

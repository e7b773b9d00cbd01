"""The linearisation and the convex model against differences of the non-linear path."""

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner.convex.subproblem import convexify
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import model_of


class Crane:
    """A pendulum on a driven cart: drift, diffusion and terminal alone, uneven time grid."""

    start = np.array([0.1, 0.2, 0.0, -0.1])
    times = np.linspace(0.0, 1.3, 12) ** 1.2
    control_weight = np.array([[0.7]])

    def drift(self, t, x, u):
        s, c = np.sin(x[..., 1]), np.cos(x[..., 1])
        acceleration = u[..., 0] * (1.0 + 0.1 * np.sin(t)) - 0.2 * x[..., 2]
        return np.stack([x[..., 2], x[..., 3], acceleration, -9.81 * s - acceleration * c], axis=-1)

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 4, 2), 0.1)

    def terminal(self, x):
        return np.stack([x[..., 0] + np.sin(x[..., 1]), x[..., 2] * x[..., 3]], axis=-1)

    def penalty(self, t, x):
        return np.stack([x[..., 0] ** 2 - 0.01 * t, np.sin(x[..., 1])], axis=-1)

    penalty_weight = np.array([3.0, 5.0])


PROBLEMS = {
    "paper": Scenario.named("paper"),
    "turned world": Scenario.random(3, turned=True),
    "crane": Crane(),
}


@pytest.fixture(params=PROBLEMS)
def driven(request, rollout):
    """A problem along a path it can drive: model, states, controls."""
    problem = PROBLEMS[request.param]
    model = model_of(problem)
    u = np.random.default_rng(4).normal(size=(len(model.dt), model.control_dim))
    return model, rollout(problem, u), u


def directions(u, count=3):
    return np.random.default_rng(5).normal(size=(count, *u.shape))


def arrays(at, model, composite=True):
    return convexify(
        model,
        at,
        variance=None,
        composite=composite,
        trust_multiplier=0.0,
        trust_weight=None,
        rho=1.0,
    )


def test_a_path_that_obeys_the_dynamics_has_no_defect(driven):
    model, x, u = driven
    assert np.max(np.abs(linearize(model, x, u).defect)) < 1e-14


def test_the_defect_is_what_one_step_from_each_node_misses(driven):
    model, x, u = driven
    x = x + np.random.default_rng(1).normal(size=x.shape)
    at = linearize(model, x, u)
    for k in range(len(u)):
        step = x[k] + model.dt[k] * model.problem.drift(model.times[k], x[k], u[k])
        np.testing.assert_allclose(at.defect[k], step - x[k + 1], atol=1e-14)


def test_state_response_is_the_derivative_of_the_rollout(driven, rollout):
    model, x, u = driven
    sub = arrays(linearize(model, x, u), model)
    h = 1e-6
    for e in directions(u):
        ahead, back = (rollout(model.problem, u + s * h * e)[1:] for s in (1.0, -1.0))
        response = sub.response(e)
        error = np.max(np.abs((ahead - back) / (2 * h) - response))
        assert error < 1e-7 * np.max(np.abs(response))


@pytest.mark.parametrize("composite", [True, False])
def test_convex_model_has_the_gradient_of_the_non_linear_cost(driven, composite, cost_of_controls):
    model, x, u = driven
    at = linearize(model, x, u)
    sub = arrays(at, model, composite)
    assert at.effort + at.penalty == pytest.approx(cost_of_controls(model.problem, u), rel=1e-12)
    h = 1e-5
    for e in directions(u):
        ahead, back = (cost_of_controls(model.problem, u + s * h * e) for s in (1.0, -1.0))
        # The terminal penalty is the model's own: taken out.
        model_cost = [
            sub.objective(d, s * h * e) - sub.rho * sub.virtual_control(d)
            for s in (1.0, -1.0)
            for d in [sub.response(s * h * e)]
        ]
        assert (model_cost[0] - model_cost[1]) == pytest.approx(
            ahead - back, rel=1e-6, abs=1e-9 * abs(ahead)
        )


def test_composite_model_agrees_in_value_where_the_penalty_acts(driven):
    model, x, u = driven
    at = linearize(model, x, u)
    sub = arrays(at, model)
    d, e = np.zeros_like(at.defect), np.zeros_like(u)
    value = sub.objective(d, e) - sub.rho * sub.virtual_control(d)
    assert value == pytest.approx(at.penalty, rel=1e-12)
    literal = arrays(at, model, composite=False)
    assert literal.objective(d, e) == pytest.approx(sub.rho * sub.virtual_control(d), abs=1e-12)


def test_terminal_and_penalty_rows_are_first_order_models(driven):
    model, x, u = driven
    at = linearize(model, x, u)
    h = 1e-6
    for d in np.random.default_rng(2).normal(size=(3, *x.shape)):
        ahead, back = (linearize(model, x + s * h * d, u) for s in (1.0, -1.0))
        np.testing.assert_allclose((ahead.g - back.g) / (2 * h), at.G @ d[-1], atol=1e-7)
        rows = np.einsum("kpn,kn->kp", at.C, d[1:])
        np.testing.assert_allclose((ahead.c - back.c) / (2 * h), rows, atol=1e-7)


def test_bounds_of_the_step_are_those_of_the_control(driven):
    model, x, u = driven
    sub = arrays(linearize(model, x, u), model)
    np.testing.assert_array_equal(sub.lower, model.lower - u)
    np.testing.assert_array_equal(sub.upper, model.upper - u)
    assert sub.bounded == (getattr(model.problem, "control_bounds", None) is not None)


def test_virtual_control_counts_only_what_lies_beyond_the_box(driven):
    model, x, u = driven
    at = linearize(model, x, u)
    d = np.zeros_like(at.defect)
    missing = np.sum(np.abs(at.g))
    assert arrays(at, model).virtual_control(d) == pytest.approx(missing)
    box = convexify(
        model,
        at,
        variance=None,
        composite=True,
        trust_multiplier=0.0,
        trust_weight=None,
        rho=1.0,
        tolerance=1e3,
    )
    assert box.virtual_control(d) == 0.0

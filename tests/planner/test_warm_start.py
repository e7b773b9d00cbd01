"""Guesses: earlier plans, other grids, bad ones; what is returned when they lead nowhere."""

import functools

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status, plan
from slipcar.planner.problem.model import model_of
from slipcar.planner.search.warm_start import given_guess


class Hanging:
    """A pendulum to be swung to a height, on any grid."""

    start = np.array([0.2, 0.0])
    control_weight = np.array([[0.5]])

    def __init__(self, times, target=(1.5, 0.0)):
        self.times, self.target = np.asarray(times), np.asarray(target)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - 9.81 * np.sin(x[..., 0])], -1)

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 2, 1), 0.1)

    def terminal(self, x):
        return x - self.target


COARSE, FINE = np.linspace(0.0, 1.5, 16), np.linspace(0.0, 1.5, 76) ** 1.1 / 1.5**0.1
PAPER = Scenario.named("paper")


def test_a_plan_on_another_grid_is_resampled():
    p = plan(Hanging(COARSE))
    model = model_of(Hanging(FINE))
    x, u = given_guess(model, p)
    assert x.shape == (76, 2)
    assert u.shape == (75, 1)
    for i in range(2):
        np.testing.assert_allclose(x[1:, i], np.interp(FINE[1:], COARSE, p.mean[:, i]), atol=1e-12)
    for k in range(75):
        middle = 0.5 * (FINE[k] + FINE[k + 1])
        assert u[k] == p.controls[np.searchsorted(COARSE, middle, side="right") - 1]


def test_refining_a_plan_takes_fewer_iterations_than_planning_anew():
    coarse = plan(Hanging(COARSE), tolerance=1e-6)
    cold = plan(Hanging(FINE), tolerance=1e-6)
    warm = plan(Hanging(FINE), tolerance=1e-6, guess=coarse)
    assert warm.status is Status.CONVERGED
    assert warm.iterations < cold.iterations
    np.testing.assert_allclose(warm.controls, cold.controls, atol=1e-2)


def test_replanning_on_the_way_takes_the_same_times():
    p = plan(PAPER)
    later = Scenario.named("paper").replace(start=p.mean[16], horizon=3.0, nodes=25)

    class FromTwo:  # the same task from t = 2 s on
        times = 2.0 + later.times

        def __getattr__(self, name):
            return getattr(later, name)

    x, u = given_guess(model_of(FromTwo()), p)
    np.testing.assert_allclose(x, p.mean[16:], atol=1e-12)
    np.testing.assert_array_equal(u, p.controls[16:])


def test_another_horizon_stretches_the_plan():
    p = plan(Hanging(COARSE))
    longer = Hanging(np.linspace(3.0, 6.0, 31))
    x, u = given_guess(model_of(longer), p)
    np.testing.assert_allclose(x[::2], p.mean, atol=1e-12)
    np.testing.assert_array_equal(u, np.repeat(p.controls, 2, axis=0))


def test_a_plan_of_other_dimensions_is_refused():
    with pytest.raises(ValueError, match=r"a plan with 5 states and 2 controls.*with 2 and 1"):
        plan(Hanging(COARSE), guess=plan(Scenario.named("open")))


def test_a_converged_plan_is_trusted_and_costs_no_second_run():
    p = plan(PAPER, tolerance=1e-8)
    q = plan(PAPER, guess=p, tolerance=1e-8)
    assert q.status is Status.CONVERGED
    assert q.iterations <= 2
    assert q.message == ""
    assert q.options["cold_start"] == "auto"
    np.testing.assert_array_equal(q.guess, p.mean)


def objective(p):
    return p.cost + p.options["variance_weight"] * p.variance


def bad_guesses():
    rng = np.random.default_rng(0)
    x, u = PAPER.initial_guess()
    yield "noise", (x + rng.normal(size=x.shape), rng.uniform(-2.0, 2.0, u.shape))
    yield "far away", (x + 1e3, u)
    yield "at rest", (np.linspace(0.0, 1.0, 41)[:, None] * PAPER.goal, u)
    yield "backwards", (x[::-1], -u)
    yield "loops", (x + np.outer(np.sin(np.linspace(0, 20, 41)), [5.0, 5.0, 20.0, 5.0, 5.0]), u)
    left = x.copy()
    left[:, :2] += np.outer(np.sin(np.linspace(0, np.pi, 41)), [-3.0, 2.0])
    yield "wrong side", (left, u)


CONVEX = {"method": "convex"}


@functools.cache
def by_itself(method):
    """The plan from the problem's own guess."""
    return plan(PAPER, method=method)


@functools.cache
def left_alone(name, method):
    """The plan from a bad guess, compared with nothing."""
    return plan(PAPER, guess=dict(bad_guesses())[name], cold_start="never", method=method)


@pytest.mark.parametrize("method", ["auto", "convex"])
@pytest.mark.parametrize("name", [name for name, _ in bad_guesses()])
def test_no_bad_guess_makes_a_plan_worse(name, method):
    p = plan(PAPER, guess=dict(bad_guesses())[name], method=method)
    assert p.status is Status.CONVERGED
    own = objective(by_itself(method))
    assert objective(p) <= own * (1.0 + 1e-5)
    assert "guess" in p.message
    alone = left_alone(name, method)
    if alone.status.ok and abs(objective(alone) - own) > 1e-3:
        better = objective(alone) < own
        source = "from the given guess" if better else "from the problem's own guess"
        assert source in p.message


def test_bad_guesses_do_lead_elsewhere_when_left_alone():
    # Otherwise the test above would show nothing.
    worse = [
        not p.status.ok or objective(p) > 1.01 * objective(by_itself("convex"))
        for p in (left_alone(name, "convex") for name, _ in bad_guesses())
    ]
    assert sum(worse) >= 2


def test_a_converged_plan_on_the_wrong_side_stays_there_unless_compared():
    x, u = PAPER.initial_guess()
    x[:, :2] += np.outer(np.sin(np.linspace(0, np.pi, 41)), [-3.0, 2.0])
    wrong = plan(PAPER, guess=(x, u), cold_start="never", **CONVEX)
    assert wrong.status is Status.CONVERGED
    assert objective(wrong) > 1.1 * objective(by_itself("convex"))
    stays = plan(PAPER, guess=wrong, **CONVEX)
    assert objective(stays) == pytest.approx(objective(wrong), rel=1e-3)
    compared = plan(PAPER, guess=wrong, cold_start="always", **CONVEX)
    assert objective(compared) == pytest.approx(objective(by_itself("convex")), rel=1e-3)
    assert "the problem's own guess: the given one led to CONVERGED at" in compared.message


def test_a_plan_of_another_world_is_not_trusted():
    other = plan(Scenario.random(3))
    p, cold = plan(PAPER, guess=other), plan(PAPER)
    assert p.status is Status.CONVERGED
    assert objective(p) <= objective(cold) * (1.0 + 1e-5)
    assert p.message  # it says that both were tried


def test_an_infeasible_plan_is_not_trusted():
    bad = plan(PAPER.replace(control_bounds=(0.2, 0.4)))
    assert bad.status is Status.INFEASIBLE
    p = plan(PAPER, guess=bad)
    assert p.status is Status.CONVERGED
    assert objective(p) <= objective(plan(PAPER)) * (1.0 + 1e-5)
    assert p.message


def test_stopping_stops():
    calls = []

    def stop(iteration):
        calls.append(iteration)
        return True

    x, u = PAPER.initial_guess()
    p = plan(PAPER, guess=(x + 0.1, u), callback=stop)
    assert p.status is Status.STOPPED
    assert len(calls) == 1


@pytest.mark.parametrize("choice", ["yes", None, True, 3])
def test_unknown_choices(choice):
    with pytest.raises(ValueError, match=r"unknown cold_start .*auto.*always.*never"):
        plan(PAPER, cold_start=choice)

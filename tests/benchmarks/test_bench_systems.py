"""The benchmark of users' systems: IPOPT solves what the planner solves, units change nothing."""

import importlib
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from slipcar.planner import plan
from slipcar.planner.problem.model import model_of

pytest.importorskip("casadi", reason='casadi is not installed: pip install "slipcar[bench]"')

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
NAMES = (
    "CartPole", "Rocket", "Quad12", "Dubins", "Race", "Corridor", "CSTR", "Arm", "FreeFlyer",
    "Rendezvous", "Glucose", "FallingArm", "FreeFlyerMm", "Upright",
)  # fmt: skip


@pytest.fixture(scope="module")
def bench():
    """Imports a module of benchmarks/systems."""
    sys.path.insert(0, str(FOLDER))
    yield lambda name: importlib.import_module(f"systems.{name}")
    sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def systems(bench):
    return bench("catalogue").SYSTEMS


def points(problem, seed=0, count=5):
    """Times, states and controls round the guess of a problem."""
    rng, model = np.random.default_rng(seed), model_of(problem)
    x, u = model.guess()
    k = rng.integers(1, len(u), count)
    x, u = x[k], model.admissible(u[k] + rng.normal(size=(count, u.shape[1])))
    return model.times[k], x + 0.1 * np.abs(x) * rng.normal(size=x.shape), u


def test_there_are_eleven_systems_and_their_variants(systems):
    assert tuple(systems) == NAMES
    assert sum(not system.variant for system in systems.values()) == 11


@pytest.mark.parametrize("name", NAMES)
def test_ipopt_finds_the_optimum_that_is_known(bench, systems, name):
    # Of the first seven, it is from another transcription than ours.
    problem = systems[name].make()
    answer = bench("transcription").Programme(problem).solve()
    judged = bench("judge").judge(problem, answer.states, answer.controls)
    assert answer.converged
    assert judged.feasible
    assert judged.cost == pytest.approx(answer.cost, rel=1e-9)
    assert judged.cost == pytest.approx(systems[name].optimum, rel=1e-5)


def test_judge_and_planner_agree_on_cost_and_feasibility(bench, systems):
    problem = systems["Glucose"].make()  # a state cost, a bound that is met
    p = plan(problem, variance_weight=0.0)
    judged = bench("judge").judge(problem, p.mean, p.controls)
    assert judged.cost == pytest.approx(p.cost, rel=1e-12)
    assert judged.feasible
    moved = p.mean + 1e-2 * p.mean.max(axis=0)
    assert not bench("judge").judge(problem, moved, p.controls).feasible
    assert bench("judge").judge(problem, p.mean, p.controls - 1.0).outside > 1e-2


@pytest.mark.parametrize("name", NAMES)
def test_units_are_converted_consistently(bench, systems, name):
    problem = systems[name].make()
    t, x, u = points(problem)
    for choice in bench("units").CHOICES:
        by = bench("units").factors(systems[name].dimensions, choice)
        other = bench("units").InUnits(problem, by)
        model, at = model_of(problem), (by.time * t, by.states * x)
        np.testing.assert_allclose(
            other.drift(*at, by.controls * u),
            by.states / by.time * problem.drift(t, x, u), rtol=1e-9, atol=0.0,
        )  # fmt: skip
        # σσᵀ dt is a covariance of states.
        covariance, own = (
            sigma @ sigma.swapaxes(-1, -2)
            for sigma in (other.diffusion(*at), problem.diffusion(t, x))
        )
        np.testing.assert_allclose(
            by.time * covariance, np.outer(by.states, by.states) * own, rtol=1e-9
        )
        np.testing.assert_allclose(
            other.terminal(at[1]), by.terminal * problem.terminal(x), rtol=1e-9
        )
        np.testing.assert_allclose(model_of(other).upper, by.controls * model.upper, rtol=1e-12)
        # Any trajectory costs as much, in its own unit.
        path, controls = model.guess()
        costs = [
            bench("judge").judge(problem, path, controls).cost,
            bench("judge").judge(other, *other.converted(path, controls)).cost / by.cost,
        ]
        assert costs[1] == pytest.approx(costs[0], rel=1e-9)
        for own, back in zip((x, u), other.original(*other.converted(x, u)), strict=True):
            np.testing.assert_allclose(back, own, rtol=1e-12)


def test_lengths_are_lengths(bench, systems):
    # By dimensional analysis: a rocket's state (m, m/s, rad, rad/s), thrust m/s², torque 1/s².
    by = bench("units").factors(
        systems["Rocket"].dimensions, bench("units").Units("", 10.0, time=2.0)
    )
    np.testing.assert_allclose(by.states, [10.0, 10.0, 5.0, 5.0, 1.0, 0.5])
    np.testing.assert_allclose(by.controls, [2.5, 0.25])


def test_disturbed_guesses_keep_their_ends_and_bounds(bench, systems):
    problem = systems["Rocket"].make()
    model = model_of(problem)
    x, u = model.guess()
    solution = (x, u + np.linspace(0.0, 1.0, len(u))[:, None])
    first, again, other = (bench("guesses").disturbed(problem, solution, s) for s in (0, 0, 1))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert np.abs(first[0] - other[0]).max() > 0.1
    np.testing.assert_allclose(first[0][[0, -1]], x[[0, -1]], atol=1e-12)
    np.testing.assert_array_equal(first[1], model.admissible(first[1]))
    assert (np.abs(first[0] - x).max(axis=0) <= 2 * 0.3 * np.ptp(x, axis=0) + 1e-12).all()


def test_answers_are_remembered_by_what_they_depend_on(bench, systems, tmp_path):
    programme = bench("transcription").Programme(systems["CartPole"].make())
    first = bench("memory").solved(programme, None, tmp_path)
    programme.solve = None  # nothing is solved again
    again = bench("memory").solved(programme, None, tmp_path)
    np.testing.assert_array_equal(first.controls, again.controls)
    assert (first.cost, first.status, first.seconds) == (again.cost, again.status, again.seconds)
    other = systems["CartPole"].make()
    other.control_weight = 2.0 * other.control_weight
    bench("memory").solved(bench("transcription").Programme(other), None, tmp_path)
    assert len(list(tmp_path.glob("*.npz"))) == 2


def test_a_call_that_takes_too_long_ends(bench):
    class Slow:
        start, times, control_weight = np.zeros(1), np.linspace(0.0, 1.0, 5), np.eye(1)

        def drift(self, t, x, u):
            time.sleep(30.0)

    found = bench("attempts").attempt(Slow(), patience=0.05)
    assert not found.solved
    assert found.status == "TypeError"  # it lacks diffusion and terminal
    Slow.diffusion = lambda self, t, x: np.zeros((*x.shape, 1))
    Slow.terminal = lambda self, x: x
    assert bench("attempts").attempt(Slow(), patience=0.05).status == "TOO_LONG"

"""The iteration on expected costs is one on every path: compiled or not, warm or cold."""

import importlib.util

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status
from slipcar.planner.expected import loop
from slipcar.planner.expected.guarded import posed
from slipcar.planner.problem.derivatives import complex_step_jacobian

NUMBA = importlib.util.find_spec("numba") is not None
needs_numba = pytest.mark.skipif(not NUMBA, reason="needs numba")


def _same(a, b, atol=1e-8):
    assert a.status is b.status
    assert a.iterations == b.iterations
    for name in ("u", "x", "gains", "covariance", "c", "s", "A", "B", "held"):
        one, two = getattr(a, name), getattr(b, name)
        scale = 1.0 + np.abs(two).max(initial=0.0)
        np.testing.assert_allclose(one, two, atol=atol * scale, rtol=0.0, err_msg=name)
    for name in ("adjoint", "terminal"):
        one, two = getattr(a, name), getattr(b, name)
        scale = 1.0 + np.abs(two).max(initial=0.0)
        np.testing.assert_allclose(one, two, atol=10 * atol * scale, rtol=0.0, err_msg=name)
    for name in ("effort", "running", "objective"):
        assert getattr(a, name) == pytest.approx(getattr(b, name), rel=1e-7)


MASSES = {
    "open": {"soft": False, "feedback": False, "price": 0.0},
    "open priced": {"soft": False, "feedback": False, "price": 3.0},
    "soft priced": {"soft": True, "feedback": False, "price": 3.0},
    "feedback": {"soft": True, "feedback": True, "price": 0.0},
    "feedback priced": {"soft": True, "feedback": True, "price": 3.0},
    "feedback exact": {"soft": False, "feedback": True, "price": 3.0},
    "spread": {"soft": False, "feedback": False, "price": 1.0, "w": 2.0},
}

CARS = {
    "open": {"soft": False, "feedback": False, "price": 0.0},
    "open priced": {"soft": False, "feedback": False, "price": 10.0},
    "soft": {"soft": True, "feedback": False, "price": 10.0, "w": 1.0},
    "feedback": {"soft": True, "feedback": True, "price": 0.0},
    "feedback priced": {"soft": True, "feedback": True, "price": 30.0},
    "feedback exact": {"soft": False, "feedback": True, "price": 30.0},
}


@needs_numba
@pytest.mark.parametrize("kind", CARS)
def test_compiled_steps_are_those_of_numpy_on_the_paper_case(paper, kind, settle, nominal):
    start = nominal(paper)
    asked = {"start": start, "tolerance": 1e-6, **CARS[kind]}
    _, _, slow = settle(paper, **asked)
    _, _, fast = settle(paper, native=True, **asked)
    assert slow.status is Status.CONVERGED
    _same(fast, slow)
    # And when each goes on from the other's answer at another price.
    again = {**asked, "price": 3.0 * asked["price"] + 1.0}
    a = settle(paper, **{**again, "start": (fast.x, fast.u)}, warm=fast)[2]
    b = settle(paper, native=True, **{**again, "start": (slow.x, slow.u)}, warm=slow)[2]
    _same(b, a, atol=1e-7)


@needs_numba
@pytest.mark.parametrize("seed", range(6))
def test_compiled_steps_are_those_of_numpy_in_random_worlds(seed, settle, nominal):
    world = Scenario.random(seed, turned=seed % 2 == 1)
    kind = list(CARS)[seed]
    start = nominal(world)
    # Few steps: far from a solution chaos takes over, not rounding.
    for limit in (3, 100):
        asked = {"start": start, "tolerance": 1e-4, "limit": limit, **CARS[kind]}
        slow, fast = (settle(world, native=native, **asked)[2] for native in (False, True))
        if limit == 3 or (slow.status.ok and fast.status.ok):
            _same(fast, slow, atol=1e-8 if limit == 3 else 1e-6)
        else:
            assert slow.status is fast.status


@needs_numba
@pytest.mark.parametrize("kind", MASSES)
def test_compiled_steps_are_those_of_numpy_for_a_traced_problem(kind, settle, mass, nominal):
    problem = mass()
    start = nominal(problem)
    asked = {"start": start, "tolerance": 1e-8, **MASSES[kind]}
    _, _, slow = settle(problem, **asked)
    _, _, fast = settle(problem, native=True, **asked)
    _same(fast, slow, atol=1e-7)


@needs_numba
@pytest.mark.parametrize("feedback", [False, True])
def test_compiled_steps_are_those_of_numpy_at_bounds(feedback, settle, mass, nominal):
    asked = {"soft": True, "feedback": feedback, "price": 1.0, "terminal": 30.0, "tolerance": 1e-8}
    _, _, free = settle(mass(), **asked)
    problem = mass(bounds=0.9 * np.abs(free.u).max(axis=0))
    asked["start"] = nominal(problem)
    _, _, slow = settle(problem, **asked)
    _, _, fast = settle(problem, native=True, **asked)
    _same(fast, slow, atol=1e-7)


def test_a_warm_start_at_a_solution_stays_there(paper, settle):
    asked = {"soft": True, "feedback": True, "price": 10.0}
    _, _, found = settle(paper, tolerance=1e-14, **asked)
    _, _, again = settle(paper, tolerance=1e-8, start=(found.x, found.u), warm=found, **asked)
    assert again.status.ok
    assert again.iterations <= 3
    np.testing.assert_allclose(again.u, found.u, atol=1e-4)


def test_a_solution_does_not_depend_on_damping_or_on_where_it_came_from(settle, mass):
    answers = []
    for damping, price in ((0.3, None), (0.7, None), (0.5, 30.0)):
        warm, start = None, None
        if price is not None:  # by way of another price
            _, _, warm = settle(mass(), soft=True, feedback=True, price=price)
            start = (warm.x, warm.u)
        _, _, found = settle(
            mass(), soft=True, feedback=True, price=3.0, damping=damping, start=start, warm=warm
        )
        assert found.status.ok
        answers.append(found)
    for other in answers[1:]:
        np.testing.assert_allclose(other.u, answers[0].u, atol=1e-5)
        np.testing.assert_allclose(other.gains, answers[0].gains, atol=1e-4)


def test_a_guess_where_the_model_is_not_finite_is_refused(mass, expected_stakes):
    problem = mass()
    ready = posed(problem)
    x, u = ready.model.guess()
    functions = ready.functions(x, u, native=False)
    x = x.copy()
    x[3] = np.nan
    stakes = expected_stakes(ready, soft=True, feedback=True, price=1.0)
    with pytest.raises(ValueError, match="finite"):
        loop.iterate(
            ready.model, functions, stakes, x, u, tolerance=1e-6, max_iterations=5, warm=None
        )


def test_rows_of_both_kinds_are_kept_apart(paper, nominal):
    """Penalties first, then constraints, with the Jacobians of both."""
    ready = posed(paper)
    model, guarded = ready.model, ready.guarded
    o = len(paper.obstacles)
    np.testing.assert_array_equal(guarded.is_constraint, [False] * o + [True] * o)
    np.testing.assert_array_equal(guarded.penalty_weight[o:], 0.0)
    x, u = nominal(paper)
    t = model.times
    rows = model.penalty(t, x)
    np.testing.assert_array_equal(rows[:, :o], paper.penalty(t, x))
    np.testing.assert_array_equal(rows[:, o:], paper.constraint(t, x))
    known = complex_step_jacobian(lambda y: model.penalty(t, y), x)
    np.testing.assert_allclose(model.penalty_jacobian(t, x), known, atol=1e-12)
    functions = ready.functions(x, u, native=False)
    node = functions.node(t=t[1:], x=x[1:])
    np.testing.assert_allclose(node["c"], rows[1:], atol=1e-12)
    np.testing.assert_allclose(node["C"].reshape(known[1:].shape), known[1:], atol=1e-12)

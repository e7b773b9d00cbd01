"""The iteration on expected costs is one on every path: machine code or NumPy, traced or called."""

import types

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status
from slipcar.planner.newton.posing import pose
from slipcar.planner.newton.quantities import Traced
from slipcar.planner.newton.running import advance, solve_noise
from slipcar.planner.problem.model import model_of
from slipcar.planner.trace import machine_code

needs_llvm = pytest.mark.skipif(not machine_code.available(), reason="needs llvmlite")

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

ARRAYS = ("u", "x", "gains", "covariance", "c", "s", "eta", "A", "B", "g", "G")


def _same(a, b, atol=1e-11):
    assert a.status is b.status
    assert a.iterations == b.iterations
    for name in (*ARRAYS, "adjoint", "terminal"):
        one, two = getattr(a, name), getattr(b, name)
        scale = 1.0 + np.abs(two).max(initial=0.0)
        np.testing.assert_allclose(one, two, atol=atol * scale, rtol=0.0, err_msg=name)
    for name in ("effort", "running", "objective"):
        assert getattr(a, name) == pytest.approx(getattr(b, name), rel=10.0 * atol)


def _identical(a, b):
    for name in (*ARRAYS, "adjoint", "terminal"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


# ------------------------------------------------------------------------- machine code or NumPy


@needs_llvm
@pytest.mark.parametrize("kind", CARS)
def test_machine_code_steps_as_numpy_does_on_the_paper_case(paper, kind, settle, nominal):
    asked = {"start": nominal(paper), "tolerance": 1e-6, **CARS[kind]}
    _, _, slow = settle(paper, compiled=False, **asked)
    _, _, fast = settle(paper, compiled=True, **asked)
    assert slow.status is Status.CONVERGED
    _same(fast, slow)
    # And when each goes on from the other's answer at another price.
    again = {**asked, "start": (fast.x, fast.u), "warm": fast}
    if asked["price"]:
        again["price"] = 3.0 * asked["price"]
    else:
        again["terminal"] = 50.0
    a = settle(paper, compiled=False, **again)[2]
    b = settle(paper, compiled=True, **again)[2]
    _same(b, a)


@needs_llvm
@pytest.mark.parametrize("seed", range(6))
def test_machine_code_steps_as_numpy_does_in_random_worlds(seed, settle, nominal):
    world = Scenario.random(seed, turned=seed % 2 == 1)
    kind = list(CARS)[seed]
    start = nominal(world)
    # Few steps: far from a solution chaos takes over, not rounding.
    for limit in (3, 100):
        asked = {"start": start, "tolerance": 1e-4, "limit": limit, **CARS[kind]}
        slow, fast = (settle(world, compiled=compiled, **asked)[2] for compiled in (False, True))
        if limit == 3 or (slow.status.ok and fast.status.ok):
            _same(fast, slow, atol=1e-10 if limit == 3 else 1e-7)
        else:
            assert slow.status is fast.status


@needs_llvm
@pytest.mark.parametrize("kind", MASSES)
def test_machine_code_steps_as_numpy_does_for_a_point_mass(kind, settle, mass, nominal):
    problem = mass()
    asked = {"start": nominal(problem), "tolerance": 1e-8, **MASSES[kind]}
    _, _, slow = settle(problem, compiled=False, **asked)
    _, _, fast = settle(problem, compiled=True, **asked)
    _same(fast, slow)


@needs_llvm
@pytest.mark.parametrize("feedback", [False, True])
def test_machine_code_steps_as_numpy_does_at_bounds(feedback, settle, mass, nominal):
    asked = {"soft": True, "feedback": feedback, "price": 1.0, "terminal": 30.0, "tolerance": 1e-8}
    _, _, free = settle(mass(), **asked)
    problem = mass(bounds=0.9 * np.abs(free.u).max(axis=0))
    asked["start"] = nominal(problem)
    _, _, slow = settle(problem, compiled=False, **asked)
    _, _, fast = settle(problem, compiled=True, **asked)
    _same(fast, slow)


# ------------------------------------------------------------------------- traced or called


def _opaque(function):
    """The same function by way of Python's numbers: it cannot be traced."""

    def numbers(a):
        return np.array([float(entry) for entry in np.ravel(a)]).reshape(np.shape(a))

    return lambda *arguments: function(*map(numbers, arguments))


def _called(problem):
    """The same problem, of functions that can only be called, without any derivatives."""
    functions = ("drift", "diffusion", "terminal", "penalty", "constraint", "state_cost")
    numbers = ("start", "times", "control_weight", "control_bounds", "penalty_weight")
    members = {name: getattr(problem, name) for name in numbers if hasattr(problem, name)}
    known = [name for name in functions if getattr(problem, name, None) is not None]
    members |= {name: _opaque(getattr(problem, name)) for name in known}
    return types.SimpleNamespace(**members)


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("kind", ["open priced", "feedback priced"])
@pytest.mark.parametrize("which", ["mass", "paper"])
def test_functions_that_cannot_be_traced_give_the_same_plan(
    which, kind, compiled, settle, mass, paper, nominal
):
    """By differences: as near as those come, step by step."""
    problem = mass() if which == "mass" else paper
    asked = {"start": nominal(problem), "tolerance": 1e-8, **MASSES[kind]}
    traced, _, known = settle(problem, **asked)
    called, _, answer = settle(_called(problem), compiled=compiled, **asked)
    assert isinstance(traced.problem, Traced)
    assert not isinstance(called.problem, Traced)
    assert known.status is Status.CONVERGED
    _same(answer, known, atol=1e-6)


# ------------------------------------------------------------------------- one after another


@pytest.mark.parametrize("compiled", [None, False])
def test_what_was_planned_before_leaves_no_trace(compiled, paper, settle, nominal):
    """Arrays are used again: the same question has the same answer, to the last bit."""
    asked = {"soft": True, "feedback": True, "price": 10.0, "limit": 3, "compiled": compiled}
    other = paper.replace(obstacles=paper.obstacles + 0.05)
    start = nominal(paper)
    _, _, first = settle(paper, start=start, **asked)
    settle(other, start=nominal(other), **asked)
    with pytest.raises(ValueError, match="finite"):
        settle(other, start=(np.full_like(start[0], np.nan), start[1]), **asked)
    _, _, again = settle(paper, start=start, **asked)
    _identical(again, first)


@pytest.mark.parametrize("compiled", [None, False])
@pytest.mark.parametrize("kind", ["feedback priced", "feedback exact"])
def test_a_batch_steps_as_each_of_its_problems_does_alone(kind, compiled, settle, mass):
    """From other starts, two steps; one whose guess is not finite is said so, and no other's."""
    bounds = np.array([3.0, 3.0])
    posed, stakes, plan = settle(mass(bounds=bounds), compiled=compiled, **MASSES[kind])
    rng, count = np.random.default_rng(0), 4
    warm = ("gains", "eta", "adjoint", "terminal", "A", "B")
    batch = {name: np.stack([getattr(plan, name)] * count) for name in ("x", "u", *warm)}
    batch["x"][:, 0] += 0.05 * rng.normal(size=(count, 4))
    batch["x"][1, 3] = np.nan
    guesses = batch["x"].copy()
    endings = advance(posed, stakes, batch, tolerance=1e-8, max_iterations=2)
    assert endings[1] is None
    assert endings[0] is endings[2] is endings[3] is Status.MAX_ITERATIONS
    for i in (0, 2, 3):
        alone = solve_noise(
            posed, stakes, guesses[i], plan.u, tolerance=1e-8, max_iterations=2, warm=plan
        )
        assert np.abs(alone.u - plan.u).max() > 1e-3
        np.testing.assert_array_equal(batch["x"][i, 0], guesses[i, 0])
        for name in ("x", "u", *warm):
            np.testing.assert_array_equal(batch[name][i], getattr(alone, name), err_msg=name)


# ------------------------------------------------------------------------- rows


@pytest.mark.parametrize("compiled", [None, False])
def test_rows_are_the_penalties_then_the_constraints(compiled, paper, nominal):
    """With a certain state their values; along one direction their slopes."""
    problems = (paper, _called(paper)) if compiled is None else (paper,)
    x, _ = nominal(paper)
    t, v, h = paper.times[1:], np.array([0.3, -0.2, 0.1, 0.05, 0.4]), 1e-6
    for problem in problems:
        for constraints in (False, True):
            posed = pose(model_of(problem), constraints=constraints, compiled=compiled)

            def rows(y, constraints=constraints):
                both = (paper.penalty(t, y[1:]), paper.constraint(t, y[1:]))
                return np.concatenate(both[: 1 + constraints], axis=1)

            assert posed.tails == (len(paper.obstacles) if constraints else 0)
            c, _ = posed.row_moments(x, np.zeros((len(x), 5, 5)))
            np.testing.assert_allclose(c, rows(x), atol=1e-12)
            _, s = posed.row_moments(x, np.broadcast_to(np.outer(v, v), (len(x), 5, 5)))
            slope = np.abs(rows(x + h * v) - rows(x - h * v)) / (2 * h)
            known = np.maximum(slope, 0.02 * slope.max(axis=0) + 1e-9)
            np.testing.assert_allclose(s, known, rtol=1e-6, atol=1e-8)

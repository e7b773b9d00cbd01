"""`plan_batch` keeps its promise: each plan is the one that `plan` gives."""

import warnings

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Plan, Status, plan, plan_batch
from slipcar.planner.search.tasks import in_threads


class Pendulum:
    """A pendulum to be brought to rest elsewhere; its numbers may change at any time."""

    control_weight = np.eye(1)

    def __init__(self, stiffness=1.0, times=None, goal=(1.5, 0.0)):
        self.stiffness = stiffness
        self.times = np.linspace(0.0, 2.0, 21) if times is None else np.asarray(times)
        self.start = np.zeros(2)
        self.goal = np.array(goal)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - self.stiffness * np.sin(x[..., 0])], axis=-1)

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 2, 1), 0.1)

    def terminal(self, x):
        return x - self.goal


class Rooted(Pendulum):
    """Its cost is not finite along its own guess."""

    def initial_guess(self):
        N = len(self.times)
        return np.full((N, 2), -1.0), np.zeros((N - 1, 1))

    def state_cost(self, t, x):
        with np.errstate(invalid="ignore"):
            return np.sqrt(x[..., 0] + 0.5)


class NotConvex(Pendulum):
    control_weight = -np.eye(1)


def _same(a: Plan, b: Plan) -> bool:
    return (
        a.status is b.status
        and a.iterations == b.iterations
        and np.array_equal(a.mean, b.mean)
        and np.array_equal(a.controls, b.controls)
        and np.array_equal(a.covariance, b.covariance)
        and np.array_equal(a.multipliers.terminal, b.multipliers.terminal)
    )


OPTIONS = {
    "default": {},
    "newton": {"method": "newton"},
    "numpy": {"compiled": False},
    "convex": {"method": "convex"},
    "osqp": {"solver": "osqp"},
    "rk4": {"integrator": "rk4"},
    "deterministic": {"variance_weight": 0.0},
    "box": {"terminal_tolerance": 1e-3},
    "literal": {"linearization": "literal"},
    "paper": {"trust_region": "paper"},
    "penalties at once": {"free_first": False},
    "convex, penalties later": {"method": "convex", "free_first": True},
    "too few iterations": {"max_iterations": 3},
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_a_batch_of_one_is_plan(paper, options):
    assert _same(plan_batch([paper], **options)[0], plan(paper, **options))


def test_a_batch_of_everything_is_plan_for_each(paper):
    problems = [
        paper,
        Pendulum(),
        Scenario.random(seed=3, turned=True),
        Pendulum(stiffness=2.0),
        paper.replace(nodes=21),
        Pendulum(times=[0.0, 0.1, 0.5, 2.0]),
        paper.replace(nodes=2),  # cannot be solved
        paper.replace(control_bounds=None),
        paper.replace(obstacles=[]),
        paper.replace(goal=(30.0, 0.0, 0.0, 0.0, 0.0)),  # nor this
        paper,
    ]
    batch = plan_batch(problems)
    assert len(batch) == len(problems)
    for found, problem in zip(batch, problems, strict=True):
        assert found.problem is problem
        assert _same(found, plan(problem))
    assert {found.status for found in batch} >= {Status.CONVERGED, Status.INFEASIBLE}


def test_start_states_are_those_of_reposed_problems(paper):
    states = np.random.default_rng(0).normal(0.0, 0.05, (12, 5))
    batch = plan_batch(paper, initial_states=states)
    for found, state in zip(batch, states, strict=True):
        np.testing.assert_array_equal(found.problem.start, state)
        np.testing.assert_array_equal(found.mean[0], state)
        assert _same(found, plan(paper.reposed(start=state)))
    for workers in (1, 3):
        again = plan_batch(paper, initial_states=states, workers=workers)
        assert all(_same(a, b) for a, b in zip(batch, again, strict=True))


@pytest.mark.parametrize("workers", [1, 3])
def test_what_numpy_does_about_overflow_is_the_callers_word_in_any_thread(workers):
    def overflowing(x):
        return np.array([1e300]).dot(np.array([x]))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with np.errstate(all="ignore"):
            assert in_threads(overflowing, [1e300, 2e300, 3e300], workers) == [np.inf] * 3
        with np.errstate(all="raise"), pytest.raises(FloatingPointError):
            in_threads(overflowing, [1e300, 2e300, 3e300], workers)


def test_start_states_of_an_own_system():
    states = np.array([[0.1, 0.0], [0.2, -0.3]])
    for found, state in zip(plan_batch(Pendulum(), initial_states=states), states, strict=True):
        there = Pendulum()
        there.start = state
        assert _same(found, plan(there))
        np.testing.assert_array_equal(found.problem.start, state)
        assert found.certificate.extremal


def test_guesses_are_trusted_and_may_be_plans_of_another_grid(paper):
    coarse = plan(paper.replace(nodes=21))
    x, u = paper.initial_guess()
    bent = (x + 0.1, u)
    found = plan_batch([paper] * 3, guesses=[coarse, None, bent])
    for p, guess in zip(found, (coarse, None, bent), strict=True):
        assert _same(p, plan(paper, guess=guess, cold_start="never"))


def test_history_is_kept_on_request(paper):
    without = plan_batch([paper])[0]
    with_it = plan_batch([paper], history=True)[0]
    alone = plan(paper)
    assert len(without.history) == 0
    assert len(with_it.history) == with_it.iterations == alone.iterations
    for a, b in zip(with_it.history, alone.history, strict=True):
        np.testing.assert_array_equal(a.controls, b.controls)
    assert without.certificate.extremal
    np.testing.assert_array_equal(without.certificate.adjoint, alone.certificate.adjoint)


def test_plans_of_a_batch_can_be_saved(paper, tmp_path):
    for p in plan_batch(paper, initial_states=[[0.0] * 5, [0.1, 0.0, 0.2, 0.0, 0.0]]):
        loaded = Plan.load(p.save(tmp_path / "plan"))
        assert _same(loaded, p)
        assert len(loaded.history) == 0


def test_nothing_to_plan(paper):
    assert plan_batch([]) == []
    assert plan_batch(paper, initial_states=np.zeros((0, 5))) == []


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        (NotConvex(), r"problem 1 of the batch: control_weight must be"),
        (Rooted(), r"problem 1 of the batch: state_cost .* not finite along the guess"),
    ],
    ids=["data", "not finite"],
)
@pytest.mark.parametrize("method", ["auto", "convex"])
def test_errors_name_the_index(paper, problem, message, method):
    with pytest.raises(ValueError, match=message):
        plan_batch([paper, problem, paper], method=method)


def test_missing_members_name_the_index(paper):
    with pytest.raises(TypeError, match=r"problem 2 of the batch: int is not a .*Problem"):
        plan_batch([paper, paper, 3])


def test_a_bad_guess_names_the_index(paper):
    nan = (np.full((41, 5), np.nan), np.zeros((40, 2)))
    with pytest.raises(ValueError, match="problem 1 of the batch: guess"):
        plan_batch([paper, paper], guesses=[None, nan])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"problems": iter(())}, TypeError, "sequence of problems"),
        ({"problems": "paper"}, TypeError, "sequence of problems"),
        ({"problems": Pendulum()}, TypeError, "sequence of problems"),
        ({"problems": [Pendulum()], "initial_states": [[0, 0]]}, ValueError, "one problem"),
        ({"problems": Pendulum(), "initial_states": [[0, 0, 0]]}, ValueError, r"\(any, 2\)"),
        ({"problems": Pendulum(), "initial_states": [[0], [1, 2]]}, ValueError, "initial_states"),
        ({"problems": Pendulum(), "initial_states": "ab"}, ValueError, "initial_states"),
        (
            {"problems": Pendulum(), "initial_states": [[0, 0], [0, np.inf]]},
            ValueError,
            r"initial_states\[1\] must be finite",
        ),
        ({"problems": [Pendulum()], "guesses": []}, ValueError, "one for each of 1"),
        ({"problems": [Pendulum()], "guesses": iter(())}, TypeError, "guesses must be a sequence"),
        ({"problems": [Pendulum()], "workers": -1}, ValueError, "workers"),
        ({"problems": [Pendulum()], "starts": 2}, TypeError, "no option"),
        ({"problems": [Pendulum()], "tolerance": -1.0}, ValueError, "tolerance"),
    ],
)
def test_wrong_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        plan_batch(arguments.pop("problems"), **arguments)

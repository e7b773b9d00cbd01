"""Bad input is refused at the boundary: what is wrong, and what would be right."""

import importlib
import sys

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Problem, Status, plan
from slipcar.planner.convex.solvers.registry import make_solver


class Cart:
    """A double integrator; members given to it replace its own."""

    start = np.zeros(2)
    times = np.linspace(0.0, 2.0, 21)
    control_weight = np.eye(1)

    def __init__(self, **members):
        self.__dict__.update(members)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 2, 1), 0.1)

    def terminal(self, x):
        return x - np.array([1.0, 0.0])


def refused(message, problem=None, error=ValueError, **options):
    with pytest.raises(error, match=message):
        plan(Cart() if problem is None else problem, **options)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, "1", np.ones(2), 1j])
def test_variance_weight(value):
    refused("variance_weight must be finite and >= 0", variance_weight=value)


@pytest.mark.parametrize("value", [0.0, -1e-3, np.nan, np.inf, "small", None, np.ones(2)])
def test_tolerance(value):
    refused("tolerance must be finite and > 0", tolerance=value)


@pytest.mark.parametrize("value", [-1e-3, np.nan, np.inf, "box", None])
def test_terminal_tolerance(value):
    refused("terminal_tolerance must be finite and >= 0", terminal_tolerance=value)


@pytest.mark.parametrize("value", [0, -3, 2.5, np.nan, np.inf, True, "ten", None])
def test_max_iterations(value):
    refused("max_iterations must be an integer >= 1", max_iterations=value)


def test_unknown_choices_list_the_known_ones():
    refused(r"unknown solver 'ipopt'.*structured.*osqp.*cvxpy", solver="ipopt")
    refused(r"unknown trust_region 'wide'.*adaptive.*paper.*none", trust_region="wide")
    refused(r"unknown linearization 'exact'.*composite.*literal", linearization="exact")


@pytest.mark.parametrize(
    ("guess", "message"),
    [
        ((np.zeros((20, 2)), np.zeros((20, 1))), r"guess: states must have shape \(21, 2\)"),
        ((np.zeros((21, 2)), np.zeros((21, 1))), r"guess: controls must have shape \(20, 1\)"),
        ((np.zeros((21, 2)), np.zeros(20)), r"guess: controls must have shape"),
        ((np.full((21, 2), np.nan), np.zeros((20, 1))), r"guess: states\[0, 0\] must be finite"),
        ((np.zeros((21, 2)), np.full((20, 1), np.inf)), r"guess: controls\[0, 0\] must be finite"),
        ((np.zeros((21, 2)), "none"), "guess: controls must be numbers"),
        ((np.zeros((21, 2)),), "a pair"),
        (np.zeros((21, 2)), "a pair"),
        ("straight", "a pair"),
    ],
)
def test_guess(guess, message):
    refused(message, guess=guess)


def test_a_plan_of_another_problem_is_no_guess():
    refused("guess: a plan with 5 states and 2 controls", guess=plan(Scenario.named("open")))


@pytest.mark.parametrize(
    "member", ["start", "times", "control_weight", "drift", "diffusion", "terminal"]
)
def test_a_problem_that_lacks_a_member_is_told_which(member):
    names = ("start", "times", "control_weight", "drift", "diffusion", "terminal")
    given = {n: getattr(Cart(), n) for n in names if n != member}
    partial = type("Partial", (), {})()
    partial.__dict__.update(given)
    refused(
        rf"Partial is not a slipcar.planner.Problem: it lacks \['{member}'\]", partial, TypeError
    )
    assert not isinstance(partial, Problem)


def test_all_missing_members_are_named_at_once():
    refused(r"lacks \['start', 'times', 'control_weight', 'drift'", object(), TypeError)
    refused("str is not a slipcar.planner.Problem", "paper", TypeError)


def test_a_penalty_needs_its_weights():
    penalty = lambda t, x: x[..., :1]  # noqa: E731
    refused("penalty_weight", Cart(penalty=penalty), TypeError)
    refused(r"penalty_weight must have shape \(1\)",
            Cart(penalty=penalty, penalty_weight=np.ones(2)))  # fmt: skip
    refused("penalty_weight must be >= 0", Cart(penalty=penalty, penalty_weight=-np.ones(1)))
    refused(r"penalty_weight\[0\] must be finite",
            Cart(penalty=penalty, penalty_weight=np.array([np.nan])))  # fmt: skip


@pytest.mark.parametrize(
    "weight",
    [np.zeros((1, 1)), -np.eye(1), np.array([[np.nan]]), np.ones(1), np.ones((1, 2)), "one"],
)
def test_control_weight_of_one_control(weight):
    refused("control_weight", Cart(control_weight=weight))


@pytest.mark.parametrize(
    "weight", [np.diag([1.0, 0.0]), np.array([[1.0, 0.5], [0.0, 1.0]]), np.diag([1.0, -2.0])]
)
def test_control_weight_of_two_controls(weight):
    class Two(Cart):
        def drift(self, t, x, u):
            return u

    refused("control_weight must be symmetric positive definite", Two(control_weight=weight))


@pytest.mark.parametrize(
    "times",
    [
        np.zeros(0),
        np.zeros(1),
        np.array([0.0, 0.0]),
        np.array([0.0, 1.0, 0.5]),
        np.array([0.0, 1.0, 1.0]),
        np.array([2.0, 1.0]),
    ],
)
def test_times_must_increase(times):
    refused("times must be at least 2 increasing nodes", Cart(times=times))


def test_other_bad_data():
    refused(r"times\[1\] must be finite", Cart(times=np.array([0.0, np.nan, 1.0])))
    refused(r"start\[1\] must be finite, not nan", Cart(start=np.array([0.0, np.nan])))
    refused("start must have shape", Cart(start=np.zeros((2, 1))))
    refused("start must have shape", Cart(start=0.0))


@pytest.mark.parametrize(
    "bounds",
    [
        np.array([-1.0]),
        np.array([0.0]),
        np.array([np.nan]),
        np.ones(2),
        np.ones((2, 2)),
        np.array([[1.0], [1.0]]),
        np.array([[2.0], [1.0]]),
        np.array([[0.0], [np.nan]]),
        1.0,
        "tight",
    ],
)
def test_control_bounds(bounds):
    refused(r"control_bounds must be None, \(1,\).*or \(2, 1\) lower", Cart(control_bounds=bounds))


@pytest.mark.parametrize(
    ("name", "function", "message"),
    [
        ("drift", lambda t, x, u: x[..., 0], r"drift.*must have shape \(2, 2\), not \(2,\)"),
        ("drift", lambda t, x, u: np.zeros((2, 3)), r"drift.*must have shape \(2, 2\)"),
        ("drift", lambda t, x, u: x * np.nan + u, r"drift.*\[0, 0\] must be finite, not nan"),
        ("drift", lambda t, x, u: None, "drift.*must"),
        ("diffusion", lambda t, x: x, r"diffusion.*must have shape \(2, any, any\)|diffusion"),
        ("diffusion", lambda t, x: np.full((2, 2, 1), np.inf), "diffusion.*must be finite"),
        ("terminal", lambda x: x[..., 0], r"terminal.*must have shape \(2, any\)"),
        ("terminal", lambda x: x / 0.0, "terminal.*must be finite"),
        ("drift_jacobian", lambda t, x, u: (np.zeros((2, 2, 2)), np.zeros((2, 2, 2))),
         r"drift_jacobian\(t, x, u\)\[1\] must have shape \(2, 2, 1\)"),
        ("diffusion_jacobian", lambda t, x: np.zeros((2, 2, 2)),
         r"diffusion_jacobian.*\(2, 2, 1, 2\)"),
        ("terminal_jacobian", lambda x: np.zeros((2, 2)), r"terminal_jacobian.*\(2, 2, 2\)"),
    ],
)  # fmt: skip
def test_functions_of_wrong_shape_or_value(name, function, message):
    with np.errstate(all="ignore"):
        refused(message, Cart(**{name: function}))


def test_diffusion_must_have_a_row_for_each_state():
    refused("diffusion", Cart(diffusion=lambda t, x: np.full((*x.shape[:-1], 3, 1), 0.1)))


@pytest.mark.filterwarnings("ignore::numpy.exceptions.ComplexWarning")
def test_a_cast_to_float_changes_nothing():
    def casts(t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1).astype(np.float64)

    p, plain = plan(Cart(drift=casts)), plan(Cart())
    assert p.status is Status.CONVERGED
    np.testing.assert_allclose(p.controls, plain.controls, atol=1e-9)


def test_a_drift_that_writes_into_its_argument():
    def drift(t, x, u):
        speed = x[..., 1].copy()
        x[..., 1] *= 0.5
        return np.stack([speed, u[..., 0]], axis=-1)

    refused("wrote into its argument", Cart(drift=drift), ValueError)


def test_a_drift_that_is_not_finite_along_the_guess():
    def drift(t, x, u):
        with np.errstate(all="ignore"):
            return np.stack([x[..., 1], u[..., 0] + np.sqrt(1.0 - x[..., 0])], axis=-1)

    beyond = (np.full((21, 2), 5.0), np.zeros((20, 1)))
    refused("not finite along the guess", Cart(drift=drift), guess=beyond)


@pytest.mark.parametrize("solver", ["osqp", "cvxpy"])
def test_a_missing_solver_package_says_what_to_install(monkeypatch, solver):
    monkeypatch.setitem(sys.modules, solver, None)
    monkeypatch.delitem(sys.modules, f"slipcar.planner.convex.solvers.{solver}", raising=False)
    with pytest.raises(ImportError, match=rf"{solver}.*pip install {solver}"):
        plan(Cart(), solver=solver)


def test_cvxpy_without_a_cone_solver_says_what_to_install(monkeypatch):
    cvxpy = pytest.importorskip("cvxpy")
    monkeypatch.setattr(cvxpy, "installed_solvers", lambda: ["OSQP"])
    with pytest.raises(ImportError, match="pip install clarabel"):
        make_solver("cvxpy")


def test_bounds_too_tight_to_reach_the_goal_are_a_status_not_an_error():
    # Bang-bang over 2 s covers b: 1 m needs b >= 1 (a little more with Euler's steps).
    assert plan(Cart(control_bounds=np.array([0.9]))).status is Status.INFEASIBLE
    assert plan(Cart(control_bounds=np.array([1.2]))).status is Status.CONVERGED


def test_statuses_are_typed_and_say_what_happened():
    assert [s.name for s in Status if s.ok] == ["CONVERGED"]
    assert all(str(s) == s.name and len(s.value) > 10 for s in Status)


def test_importing_the_planner_needs_no_other_package_of_ours():
    # Run apart: this process has imported everything.
    import subprocess

    script = (
        "import sys, slipcar.planner\n"
        "heavy = {'torch', 'gymnasium', 'osqp', 'cvxpy', 'numba', 'matplotlib', 'pandas',\n"
        "         'slipcar.envs', 'slipcar.baselines', 'slipcar.evaluation'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert importlib.import_module("slipcar.planner").__all__

"""Balls of controls: closed forms, a cone solver, SciPy, symmetries; alone and with a box."""

import numpy as np
import pytest
from scipy.optimize import minimize

from slipcar.envs import Scenario
from slipcar.planner import Feedback, Status, plan
from slipcar.planner.convex.solvers.registry import make_solver
from slipcar.planner.convex.solvers.structured import StructuredSolver
from slipcar.planner.problem.control_set import project_controls

UNEVEN = np.linspace(0.0, 2.0, 25) ** 1.2


class Ship:
    """A point mass in the plane pushed by a thruster of bounded force, against a drag."""

    def __init__(self, radius, target=(1.6, 0.6, 0.0, 0.0), wind=0.0, **members):
        self.start, self.times = np.zeros(4), UNEVEN
        self.control_weight, self.control_radius = np.eye(2), radius
        self.target, self.wind = np.asarray(target), wind
        self.__dict__.update(members)

    def drift(self, t, x, u):
        pull = self.wind * np.sin(x[..., :2])
        return np.concatenate([x[..., 2:], u - pull - 0.3 * x[..., 2:]], axis=-1)

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 4, 1), 0.1)

    def terminal(self, x):
        return x - self.target


class Drifter:
    """ẋ = u in the plane with R = I: the cheapest way somewhere is straight and even."""

    start, times, control_weight = np.zeros(2), UNEVEN, np.eye(2)

    def __init__(self, radius, goal):
        self.control_radius, self.goal = radius, np.asarray(goal)

    def drift(self, t, x, u):
        return u + 0.0 * x

    def diffusion(self, t, x):
        return np.zeros((*x.shape[:-1], 2, 1))

    def terminal(self, x):
        return x - self.goal


def test_a_goal_that_is_just_out_of_reach():
    T, direction = UNEVEN[-1], np.array([0.6, 0.8])
    p = plan(Drifter(1.0, 0.999 * T * direction), solver=StructuredSolver())
    assert p.status is Status.CONVERGED
    np.testing.assert_allclose(p.controls, np.tile(0.999 * direction, (24, 1)), rtol=1e-7)
    q = plan(Drifter(1.0, 1.2 * T * direction), solver=StructuredSolver())
    assert q.status is Status.INFEASIBLE
    # As far as it gets: full thrust (an exact 1-norm penalty may choose another direction).
    np.testing.assert_allclose(np.linalg.norm(q.controls, axis=1), 1.0, rtol=1e-9)
    assert "g[" in q.message


@pytest.mark.parametrize("cost", [1e-20, 1e-12, 1e12])
def test_a_ball_is_kept_whatever_the_unit_of_the_cost(cost):
    """What is held at the ball needs a curvature of R's size: a one beside 1e-20 is singular."""
    p, q = (plan(Ship(1.7, control_weight=c * np.eye(2)), tolerance=1e-10) for c in (1.0, cost))
    assert np.isclose(np.linalg.norm(p.controls, axis=1), 1.7, rtol=1e-9).any()
    assert (p.status, q.status) == (Status.CONVERGED, Status.CONVERGED)
    np.testing.assert_allclose(q.controls, p.controls, atol=1e-4)


def test_the_regulator_with_a_bounded_thrust_in_closed_form():
    # min Σ dt ‖u − c‖² (up to a constant): the projection of c onto the ball, at every node.
    centre = np.array([3.0, -4.0])
    ship = Ship(
        2.0,
        terminal=lambda x: x[..., :0],
        control_cost=lambda t, x: np.broadcast_to(-2.0 * centre, (*x.shape[:-1], 2)),
    )
    p = plan(ship)
    assert p.status is Status.CONVERGED
    np.testing.assert_allclose(p.controls, np.tile(0.4 * centre, (24, 1)), rtol=1e-9)


PROBLEMS = {
    "tight": lambda: Ship(1.65),
    "loose": lambda: Ship(10.0),
    "windy": lambda: Ship(1.6, wind=0.5),
    "with a box": lambda: Ship(1.75, control_bounds=np.array([[-1.62, -0.8], [1.7, 0.6]])),
    "one-sided box": lambda: Ship(
        1.75, control_bounds=np.array([[-np.inf, -0.64], [1.65, np.inf]])
    ),
    "out of reach": lambda: Ship(0.9),
    "box of one side, out of reach": lambda: Ship(0.9, control_bounds=np.array([0.7, 0.8])),
}


class Recorder:
    def __init__(self, inner):
        self.inner, self.subs = inner, []

    def solve(self, sub):
        self.subs.append(sub)
        return self.inner.solve(sub)


@pytest.fixture(scope="module")
def met():
    """Sub-problems with a ball, the first and the last of each problem."""
    found = {}
    for name, make in PROBLEMS.items():
        recorder = Recorder(StructuredSolver())
        plan(make(), solver=recorder, trust_region="none", tolerance=1e-8)
        found[name] = [recorder.subs[0], recorder.subs[-1]]
    paper = Recorder(StructuredSolver())
    world = Scenario.named("paper")
    limited = type("Limited", (), {"__getattr__": lambda self, name: getattr(world, name)})()
    limited.control_radius = 1.2
    plan(limited, solver=paper, trust_region="none")
    found["paper"] = [paper.subs[0], paper.subs[2], paper.subs[-1]]
    return found


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize("name", [*PROBLEMS, "paper"])
def test_the_structured_solver_agrees_with_a_cone_solver(met, name):
    pytest.importorskip("cvxpy")
    oracle, solver = make_solver("cvxpy"), StructuredSolver()
    for sub in met[name]:
        known, found = oracle.solve(sub), solver.solve(sub)
        assert found.found
        assert np.isfinite(known.objective)
        assert found.objective == pytest.approx(known.objective, rel=1e-6, abs=1e-8)
        np.testing.assert_allclose(found.e, known.e, atol=1e-4)
        u = found.e - sub.center
        assert np.max(np.linalg.norm(u, axis=1)) <= sub.radius * (1.0 + 1e-12)
        assert np.all(found.e >= sub.lower - 1e-12)
        assert np.all(found.e <= sub.upper + 1e-12)
        price = 1.0 + np.max(np.abs(known.adjoint))
        assert np.max(np.abs(found.adjoint - known.adjoint)) < 2e-4 * price


@pytest.mark.parametrize("name", ["tight", "windy", "with a box", "paper"])
def test_controls_minimise_the_hamiltonian_over_the_ball(met, name):
    # u minimises slope·v over U to first order: u is the projection of u − slope onto U.
    for sub in met[name]:
        s = StructuredSolver().solve(sub)
        slope = np.einsum("kij,kj->ki", sub.R, s.e) + sub.r
        slope += np.einsum("kni,kn->ki", sub.B, s.adjoint)
        u = s.e - sub.center
        low, high = sub.lower - sub.center, sub.upper - sub.center
        scale = 1.0 / np.max(sub.R)
        back = project_controls(u - scale * slope, low, high, sub.radius)
        np.testing.assert_allclose(back, u, atol=1e-6)


def test_the_cases_have_balls_at_work_and_at_rest(met):
    def touching(name):
        sub = met[name][-1]
        u = StructuredSolver().solve(sub).e - sub.center
        return int(np.sum(np.linalg.norm(u, axis=1) > sub.radius * (1.0 - 1e-9)))

    assert touching("loose") == 0
    assert 3 < touching("tight") < 24
    assert 3 < touching("windy") < 24
    assert touching("with a box") > 0
    assert touching("out of reach") > 20
    assert touching("paper") > 3


def test_a_ball_that_nothing_touches_changes_nothing():
    a, b = plan(Ship(None, wind=0.7), tolerance=1e-16), plan(Ship(50.0, wind=0.7), tolerance=1e-16)
    np.testing.assert_allclose(a.controls, b.controls, atol=1e-9)


def test_in_one_dimension_a_ball_is_a_box():
    class Cart:
        start, times, control_weight = np.zeros(2), UNEVEN, np.eye(1)

        def drift(self, t, x, u):
            return np.stack([x[..., 1], u[..., 0]], axis=-1)

        def diffusion(self, t, x):
            return np.full((*x.shape[:-1], 2, 1), 0.1)

        def terminal(self, x):
            return x - np.array([1.0, 0.0])

    box, ball = Cart(), Cart()
    box.control_bounds, ball.control_radius = np.array([0.9]), 0.9
    a, b = plan(box, tolerance=1e-10), plan(ball, tolerance=1e-10)
    assert a.status is b.status is Status.CONVERGED
    np.testing.assert_allclose(a.controls, b.controls, atol=1e-8)
    assert np.isclose(np.abs(a.controls), 0.9).any()


def test_turning_the_plane_turns_the_plan():
    # A box would not allow this: the ball knows no direction.
    angle = 0.7
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    target = np.array([1.6, 0.6, 0.0, 0.0])
    turned = np.concatenate([turn @ target[:2], turn @ target[2:]])
    a = plan(Ship(1.65, target), tolerance=1e-12)
    b = plan(Ship(1.65, turned), tolerance=1e-12)
    assert a.status is b.status is Status.CONVERGED
    assert (np.linalg.norm(a.controls, axis=1) > 1.65 - 1e-9).sum() > 3
    np.testing.assert_allclose(b.controls, a.controls @ turn.T, atol=1e-6)


def test_a_plan_with_ball_box_and_wind_against_scipy(rollout):
    ship = Ship(1.6, wind=0.5, control_bounds=np.array([1.55, 0.9]))
    p = plan(ship, tolerance=1e-10)
    assert p.status is Status.CONVERGED
    dt = np.diff(UNEVEN)
    known = minimize(
        lambda z: np.einsum("k,ki,ki", dt, z.reshape(-1, 2), z.reshape(-1, 2)),
        0.9 * p.controls.ravel(),
        method="SLSQP",
        bounds=[(-1.55, 1.55), (-0.9, 0.9)] * 24,
        constraints=[
            {"type": "eq", "fun": lambda z: ship.terminal(rollout(ship, z.reshape(-1, 2))[-1])},
            {"type": "ineq", "fun": lambda z: 1.6**2 - np.sum(z.reshape(-1, 2) ** 2, axis=1)},
        ],
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert known.success
    assert p.cost == pytest.approx(known.fun, rel=1e-6)
    np.testing.assert_allclose(p.controls.ravel(), known.x, atol=2e-3)
    assert np.max(np.linalg.norm(p.controls, axis=1)) == pytest.approx(1.6, rel=1e-9)


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
def test_plans_do_not_depend_on_the_backend():
    pytest.importorskip("cvxpy")
    a = plan(Ship(1.6, wind=0.5), tolerance=1e-6)
    b = plan(Ship(1.6, wind=0.5), tolerance=1e-6, solver="cvxpy", max_iterations=30)
    assert a.status is Status.CONVERGED
    np.testing.assert_allclose(a.controls, b.controls, atol=1e-4)


def test_osqp_says_what_it_cannot_do():
    pytest.importorskip("osqp")
    with pytest.raises(ValueError, match="osqp cannot take control_radius"):
        plan(Ship(1.4), solver="osqp", trust_region="none")


@pytest.mark.parametrize("seed", range(5))
def test_projection_onto_box_and_ball(seed):
    rng = np.random.default_rng(seed)
    lower, upper = -rng.uniform(0.1, 2.0, 3), rng.uniform(0.1, 2.0, 3)
    if seed == 4:
        lower[0], upper[1] = 0.05, np.inf
    radius = rng.uniform(0.5, 2.0)
    u = 3.0 * rng.normal(size=(50, 3))
    nearest = project_controls(u, lower, upper, radius)
    assert np.all(nearest >= lower)
    assert np.all(nearest <= upper)
    assert np.max(np.linalg.norm(nearest, axis=1)) <= radius * (1 + 1e-12)
    np.testing.assert_allclose(project_controls(nearest, lower, upper, radius), nearest, atol=1e-12)
    # The variational inequality (u − P u)·(v − P u) ≤ 0 for admissible v says that it is nearest.
    v = np.clip(2.0 * rng.normal(size=(2000, 3)), lower, upper)
    v = v[np.linalg.norm(v, axis=1) <= radius]
    assert len(v) > 50
    gaps = np.einsum("ki,kvi->kv", u - nearest, v[None] - nearest[:, None])
    assert gaps.max() < 1e-9


def test_guesses_and_feedback_are_projected():
    ship = Ship(1.65)
    x, u = np.zeros((25, 4)), np.tile([3.0, 4.0], (24, 1))
    p = plan(ship, guess=(x, u), max_iterations=1, callback=lambda h: True)
    assert np.max(np.linalg.norm(p.controls, axis=1)) <= 1.65 * (1 + 1e-12)
    q = plan(ship)
    far = Feedback(q).control(np.array([0.3, 1.0]), np.array([[5.0] * 4, [-9.0] * 4]))
    np.testing.assert_allclose(np.linalg.norm(far, axis=1), 1.65)


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan, "wide", np.ones(2)])
def test_bad_radii(radius):
    with pytest.raises(ValueError, match="control_radius must be None or a number > 0"):
        plan(Ship(radius))


def test_a_ball_apart_from_the_box():
    with pytest.raises(ValueError, match=r"control_radius 1 leaves no controls.*has norm 1.41"):
        plan(Ship(1.0, control_bounds=np.array([[1.0, 1.0], [2.0, 2.0]])))

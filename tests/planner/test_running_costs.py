"""State and control costs beyond hinges: closed forms, SciPy, invariances, three backends."""

import numpy as np
import pytest
from scipy.optimize import minimize

from slipcar.planner import Plan, Status, plan
from slipcar.planner.problem.linearization import linearize, nearest_semidefinite
from slipcar.planner.problem.model import model_of

UNEVEN = np.linspace(0.0, 2.0, 21) ** 1.2


class Cart:
    """A double integrator with free end; members given to it replace its own."""

    start = np.array([1.0, -0.5])
    times = UNEVEN
    control_weight = np.array([[0.3]])

    def __init__(self, **members):
        self.__dict__.update(members)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 2, 1), 0.1)

    def terminal(self, x):
        return x[..., :0]


Q = np.array([[2.0, 0.4], [0.4, 1.0]])


def quadratic(t, x):
    return np.einsum("...i,ij,...j", x, Q, x) * (1.0 + 0.2 * t)


def riccati(problem, Q_of_t):
    """Controls of min Σ dt (u'Ru) + Σ dt x'Q(t)x by the textbook recursion, and its value."""
    times, dt, R = problem.times, np.diff(problem.times), problem.control_weight
    steps = [(np.array([[1.0, h], [0.0, 1.0]]), np.array([[0.0], [h]])) for h in dt]
    P, gains = dt[-1] * Q_of_t(times[-1]), []
    for k in range(len(dt) - 1, -1, -1):
        A, B = steps[k]
        K = np.linalg.solve(dt[k] * R + B.T @ P @ B, B.T @ P @ A)
        P = A.T @ P @ (A - B @ K) + (dt[k - 1] * Q_of_t(times[k]) if k else 0.0)
        gains.append(K)
    x, controls = problem.start, []
    for (A, B), K in zip(steps, gains[::-1], strict=True):
        u = -K @ x
        controls.append(u)
        x = A @ x + B @ u
    return np.array(controls), float(problem.start @ P @ problem.start)


@pytest.mark.parametrize("solver", ["structured", "osqp", "cvxpy"])
def test_the_linear_quadratic_regulator(solver):
    cart = Cart(state_cost=quadratic)
    p = plan(cart, solver=solver, tolerance=1e-8, variance_weight=0.0)
    assert p.status is Status.CONVERGED
    u, value = riccati(cart, lambda t: Q * (1.0 + 0.2 * t))
    np.testing.assert_allclose(p.controls, u, atol=1e-5 * np.max(np.abs(u)))
    assert p.cost == pytest.approx(value, rel=1e-7)
    assert p.cost == p.effort + p.running_cost
    assert p.obstacle_cost == 0.0
    assert p.history[-1].running == pytest.approx(p.running_cost, rel=1e-9)


def test_costs_are_charged_where_the_protocol_says():
    # State costs at nodes 1..N−1 with the dt that ends there, control costs with that of theirs.
    cart = Cart(
        state_cost=lambda t, x: x[..., 0] ** 3 + t,
        control_cost=lambda t, x: (x[..., 1] * t)[..., None] + 0.5,
    )
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(21, 2)), rng.normal(size=(20, 1))
    at = linearize(model_of(cart), x, u)
    expected = 0.0
    for k, dt in enumerate(np.diff(UNEVEN)):
        expected += dt * (x[k + 1, 0] ** 3 + UNEVEN[k + 1])
        expected += dt * (x[k, 1] * UNEVEN[k] + 0.5) * u[k, 0]
    assert at.running == pytest.approx(expected, rel=1e-12)


def test_gradients_equal_differences_of_the_running_cost():
    cart = Cart(
        state_cost=lambda t, x: np.exp(0.3 * x[..., 0]) * np.cos(x[..., 1]) + t * x[..., 1],
        control_cost=lambda t, x: np.sin(x[..., :1]) * (1.0 + t[..., None]),
    )
    model, rng = model_of(cart), np.random.default_rng(1)
    x, u = rng.normal(size=(21, 2)), rng.normal(size=(20, 1))
    at, h = linearize(model, x, u), 1e-5
    for _ in range(5):
        d, e = rng.normal(size=(20, 2)), rng.normal(size=(20, 1))
        moved = np.vstack([np.zeros((1, 2)), d])
        ahead, behind = (linearize(model, x + s * moved, u + s * e).running for s in (h, -h))
        slope = np.vdot(at.q_running, d) + np.vdot(at.r_running, e)
        assert slope == pytest.approx((ahead - behind) / (2 * h), rel=1e-7)


def test_a_constant_control_cost_completes_the_square():
    # u'Ru + l'u = (u − c)'R(u − c) − c'Rc with c = −R⁻¹l/2; nothing else is charged or asked.
    slope = np.array([0.8])
    p = plan(Cart(control_cost=lambda t, x: np.broadcast_to(slope, (*x.shape[:-1], 1))))
    centre = -0.5 * slope / 0.3
    np.testing.assert_allclose(p.controls, np.tile(centre, (20, 1)), rtol=1e-9)
    assert p.cost == pytest.approx(-0.3 * centre[0] ** 2 * UNEVEN[-1], rel=1e-9)


def both_ways(f, g):
    """A problem's functions with and without their derivatives."""
    return [{"state_cost": f}, {"state_cost": f, "state_cost_derivatives": g}]


@pytest.mark.parametrize("method", ["newton", "convex"])
def test_given_derivatives_and_traced_ones_lead_to_the_same_plan(method):
    def derivatives(t, x):
        scale = (1.0 + 0.2 * t)[..., None]
        return 2.0 * scale * (x @ Q), 2.0 * scale[..., None] * np.broadcast_to(
            Q, (*x.shape[:-1], 2, 2)
        )

    a, b = (
        plan(Cart(**m), tolerance=1e-10, method=method) for m in both_ways(quadratic, derivatives)
    )
    np.testing.assert_allclose(a.controls, b.controls, atol=1e-9)

    def jacobian(t, x):
        out = np.zeros((*x.shape[:-1], 1, 2))
        out[..., 0, 0] = np.cos(x[..., 0])
        return out

    linear = {"state_cost": quadratic, "control_cost": lambda t, x: np.sin(x[..., :1])}
    a, b = (
        plan(Cart(**linear, **m), tolerance=1e-10, method=method)
        for m in ({}, {"control_cost_jacobian": jacobian})
    )
    np.testing.assert_allclose(a.controls, b.controls, atol=1e-9)


def test_the_nearest_semidefinite_matrix():
    rng = np.random.default_rng(3)
    H = rng.normal(size=(6, 4, 4))
    H = H + H.swapaxes(1, 2)
    P = nearest_semidefinite(H)
    assert np.linalg.eigvalsh(P).min() > -1e-12
    # Nearest in Frobenius' norm: the residual is negative and orthogonal to it.
    assert np.linalg.eigvalsh(H - P).max() < 1e-12
    assert np.max(np.abs(np.einsum("kij,kij->k", H - P, P))) < 1e-10
    convex = H @ H
    np.testing.assert_array_equal(nearest_semidefinite(convex), convex)


class Swing(Cart):
    """A pendulum with costs of every kind, none of them quadratic."""

    start = np.array([0.4, 0.0])
    times = np.linspace(0.0, 1.5, 16) ** 1.1
    penalty_weight = np.array([20.0])
    control_bounds = np.array([3.0])

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - 9.81 * np.sin(x[..., 0])], axis=-1)

    def terminal(self, x):
        return x[..., :1] + 0.2

    def state_cost(self, t, x):  # not convex
        return 2.0 * np.cos(2.0 * x[..., 0]) + 0.1 * x[..., 1] ** 4

    def control_cost(self, t, x):
        return 0.3 * np.sin(x[..., :1]) * x[..., 1:]

    def penalty(self, t, x):
        return x[..., 1:] - 0.8


@pytest.mark.parametrize("solver", ["structured", "osqp", "cvxpy"])
def test_all_costs_together_against_scipy(solver, rollout):
    problem = Swing()
    p = plan(problem, variance_weight=0.0, tolerance=1e-8, solver=solver)
    assert p.status is Status.CONVERGED
    assert p.running_cost != 0.0
    assert p.obstacle_cost > 0.0
    t, dt = problem.times, np.diff(problem.times)

    def cost(z):
        u = z[:, None]
        x = rollout(problem, u)
        hinge = np.maximum(problem.penalty(t[1:], x[1:])[:, 0], 0.0)
        return (
            np.sum(dt * 0.3 * z**2)
            + np.sum(dt * problem.state_cost(t[1:], x[1:]))
            + np.sum(dt * problem.control_cost(t[:-1], x[:-1])[:, 0] * z)
            + 20.0 * np.sum(dt * hinge**2)
        )

    assert p.cost == pytest.approx(cost(p.controls[:, 0]), rel=1e-6)
    known = minimize(
        cost,
        p.controls[:, 0] + 0.05 * np.random.default_rng(0).normal(size=15),
        method="SLSQP",
        bounds=[(-3.0, 3.0)] * 15,
        constraints={
            "type": "eq",
            "fun": lambda z: problem.terminal(rollout(problem, z[:, None])[-1]),
        },
        options={"ftol": 1e-13, "maxiter": 500},
    )
    assert known.success
    assert p.cost == pytest.approx(known.fun, rel=1e-5)
    np.testing.assert_allclose(p.controls[:, 0], known.x, atol=5e-3)


def test_scaling_all_costs_changes_no_control():
    a = plan(Cart(state_cost=quadratic), tolerance=1e-10, variance_weight=0.0)
    b = plan(
        Cart(state_cost=lambda t, x: 1e3 * quadratic(t, x), control_weight=np.array([[300.0]])),
        tolerance=1e-10,
        variance_weight=0.0,
    )
    np.testing.assert_allclose(a.controls, b.controls, atol=1e-7)
    assert b.cost == pytest.approx(1e3 * a.cost, rel=1e-9)


def test_a_tracking_penalty_written_either_way():
    # w max(0, c)² + w max(0, −c)² = w c²: hinges and a smooth state cost are the same problem.
    def hinges(t, x):
        c = x[..., 0] - np.sin(t)
        return np.stack([c, -c], axis=-1)

    a = plan(Cart(penalty=hinges, penalty_weight=np.array([5.0, 5.0])), tolerance=1e-10)
    b = plan(Cart(state_cost=lambda t, x: 5.0 * (x[..., 0] - np.sin(t)) ** 2), tolerance=1e-10)
    np.testing.assert_allclose(a.controls, b.controls, atol=1e-6)
    assert a.obstacle_cost == pytest.approx(b.running_cost, rel=1e-7)


def test_running_costs_are_kept_in_the_file(tmp_path):
    p = plan(Cart(state_cost=quadratic))
    q = Plan.load(p.save(tmp_path / "plan.npz"))
    assert q.running_cost == p.running_cost != 0.0
    assert q.cost == p.cost
    assert [h.running for h in q.history] == [h.running for h in p.history]


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"state_cost": lambda t, x: x}, r"state_cost.*must have shape \(2\), not \(2, 2\)"),
        ({"state_cost": lambda t, x: x[..., 0] * np.inf}, "state_cost.*must be finite"),
        (
            {"state_cost": quadratic, "state_cost_derivatives": lambda t, x: (x, x)},
            r"state_cost_derivatives\(t, x\)\[1\] must have shape \(2, 2, 2\)",
        ),
        ({"control_cost": lambda t, x: x[..., 0]}, r"control_cost.*must have shape \(2, 1\)"),
        (
            {"control_cost": lambda t, x: x[..., :1], "control_cost_jacobian": lambda t, x: x},
            r"control_cost_jacobian.*must have shape \(2, 1, 2\)",
        ),
    ],
)
def test_costs_of_wrong_shape_are_named(members, message):
    with np.errstate(all="ignore"), pytest.raises(ValueError, match=message):
        plan(Cart(**members))

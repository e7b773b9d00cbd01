"""The examples run as printed, and their systems against closed forms, SciPy and Monte Carlo."""

import importlib.util
import math
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.stats import rice

from slipcar.planner import Feedback, Problem, Status, plan
from slipcar.planner.newton.posing import pose
from slipcar.planner.problem.model import model_of

FOLDER = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(path.stem for path in FOLDER.glob("*.py"))


def load(name):
    module = sys.modules.get(f"example_{name}")
    if module is None:
        spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return module


SYSTEMS = [
    load("boat").Boat(),
    load("linear_quadratic").Docking(),
    load("free_time").Hoist(),
    load("quadrotor").Quadrotor(),
    load("risk").Ferry(),
]


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_runs_and_converges(name, capsys):
    runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
    printed = capsys.readouterr().out
    assert "CONVERGED" in printed
    assert [s.name for s in Status if not s.ok and s.name in printed] == []


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_is_short(name):
    assert len((FOLDER / f"{name}.py").read_text(encoding="utf-8").splitlines()) < 80


@pytest.mark.parametrize("system", SYSTEMS, ids=lambda s: type(s).__name__)
def test_systems_are_sound_and_can_be_traced(system):
    # What the trace recorded computes the same.
    assert isinstance(system, Problem)
    assert plan(system, check_derivatives=True).status is Status.CONVERGED
    model = model_of(system)
    posed = pose(model)
    assert posed.reason == ""
    rng, n = np.random.default_rng(0), model.state_dim
    t, dt = rng.uniform(0.0, 1.0, 7), 0.3
    x, u = rng.normal(size=(7, n)), rng.normal(size=(7, model.control_dim))
    found = posed.problem.values(t, dt, x, u, posed.numbers)
    np.testing.assert_allclose(found[:, :n], x + dt * system.drift(t, x, u), rtol=1e-12)
    sigma = system.diffusion(t, x).reshape(7, -1)
    np.testing.assert_allclose(found[:, n : n + sigma.shape[1]], sigma, atol=1e-13)


# ------------------------------------------------------------------ linear_quadratic.py


class Dense(load("linear_quadratic").Docking):
    """Four Brownian motions on all states, two linear terminal conditions."""

    def diffusion(self, t, x):
        noise = np.random.default_rng(5).normal(size=(4, 4)) * 1e-3
        return np.cos(t / 200.0)[..., None, None] * noise

    def terminal(self, x):
        return x @ np.array([[1.0, 0.5, 0.0, 20.0], [0.0, 1.0, 30.0, 0.0]]).T - 2.0


def discretized(problem, order):
    """A_d and B_d, the Taylor polynomials of the exact ones: order 1 is Euler, 4 is rk4."""
    dt, zero = np.diff(problem.times)[0], np.zeros((4, 1))
    A = problem.drift(zero[:, 0], np.eye(4), np.zeros((4, 2))).T
    B = problem.drift(zero[:2, 0], np.zeros((2, 4)), np.eye(2)).T
    powers = [np.linalg.matrix_power(A * dt, j) for j in range(order + 1)]
    A_d = sum(P / math.factorial(j) for j, P in enumerate(powers))
    B_d = sum(P / math.factorial(j + 1) for j, P in enumerate(powers[:-1])) @ B * dt
    return A_d, B_d


def solved_at_once(problem, order):
    """Controls, states, Σ and cost of the discrete problem, by one dense KKT system."""
    A, B = discretized(problem, order)
    K, dt = len(problem.times) - 1, np.diff(problem.times)[0]
    Phi = [np.linalg.matrix_power(A, k) for k in range(K + 1)]
    effect = np.zeros((K, 4, K, 2))
    for k in range(K):
        for j in range(k + 1):
            effect[k, :, j] = Phi[k - j] @ B
    effect = effect.reshape(4 * K, 2 * K)
    free = np.concatenate([P @ problem.start for P in Phi[1:]])
    # g is affine: its matrix by unit vectors.
    offset = problem.terminal(np.zeros((1, 4)))[0]
    C = (problem.terminal(np.eye(4)) - offset).T
    w, last, q = problem.state_weight, effect[-4:], len(C)
    H = 2.0 * dt * (np.eye(2 * K) + w * effect.T @ effect)
    KKT = np.block([[H, (C @ last).T], [C @ last, np.zeros((q, q))]])
    right = np.append(-2.0 * dt * w * effect.T @ free, -C @ free[-4:] - offset)
    u = np.linalg.solve(KKT, right)[: 2 * K]
    x = free + effect @ u
    noise = problem.diffusion(problem.times[:-1], np.zeros((K, 4)))
    S = np.zeros((K + 1, 4, 4))
    for k in range(1, K + 1):
        for j in range(k):
            arrived = Phi[k - 1 - j] @ noise[j]
            S[k] += dt * arrived @ arrived.T
    mean = np.vstack([problem.start, x.reshape(K, 4)])
    return u.reshape(K, 2), mean, S, dt * (u @ u), dt * w * (x @ x)


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("rk4", 4)])
@pytest.mark.parametrize("system", [load("linear_quadratic").Docking, Dense])
def test_linear_quadratic_plan_is_the_closed_form(system, integrator, order):
    problem = system()
    w = problem.state_weight
    p = plan(problem, variance_weight=w, tolerance=1e-18, integrator=integrator)
    assert p.status is Status.CONVERGED
    u, mean, S, effort, state_cost = solved_at_once(problem, order)
    np.testing.assert_allclose(p.controls, u, atol=1e-9 * np.max(np.abs(u)))
    np.testing.assert_allclose(p.mean, mean, atol=1e-9 * np.max(np.abs(mean)))
    scale = np.sqrt(np.einsum("ki,kj->kij", *2 * [np.einsum("kii->ki", S)]))
    assert (np.abs(p.covariance - S) <= 1e-9 * scale).all()
    assert p.effort == pytest.approx(effort, rel=1e-9)
    assert p.cost == pytest.approx(effort + state_cost, rel=1e-9)
    variance = np.diff(problem.times)[0] * np.einsum("kii->", S)
    assert p.variance == pytest.approx(variance, rel=1e-9)


def test_expected_cost_is_that_of_many_paths():
    problem = load("linear_quadratic").Docking(nodes=31)
    p = plan(problem, variance_weight=problem.state_weight)
    rng = np.random.default_rng(1)
    x, cost = np.tile(problem.start, (20_000, 1)), np.full(20_000, p.effort)
    for k, dt in enumerate(np.diff(problem.times)):
        t = np.full(len(x), problem.times[k])
        noise = np.sqrt(dt) * rng.normal(size=(len(x), 3, 1))
        x = x + dt * problem.drift(t, x, p.controls[k]) + (problem.diffusion(t, x) @ noise)[..., 0]
        cost += dt * problem.state_cost(t, x)
    error = np.std(cost) / np.sqrt(len(cost))
    assert error < 0.01 * p.cost
    assert abs(cost.mean() - p.cost - problem.state_weight * p.variance) < 4.0 * error


def test_free_space_is_the_textbook_case_to_second_order():
    # u affine in t and J = 12 ‖d‖²/T³; Euler's controls sit in the middle of their intervals.
    Docking = load("linear_quadratic").Docking
    errors = []
    for nodes in (31, 61, 121, 241):
        problem = Docking(rate=0.0, state_weight=0.0, nodes=nodes)
        T, d = problem.horizon, -1e3 * problem.start[:2]  # [mm]
        p = plan(problem, tolerance=1e-16)
        middle = p.times[:-1] + 0.5 * T / (nodes - 1)
        exact = np.outer(6.0 / T**2 - 12.0 * middle / T**3, d)
        J = 12.0 * d @ d / T**3
        errors.append([p.effort / J - 1.0, np.max(np.abs(p.controls - exact)) / np.max(exact)])
    orders = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.05)


def test_rk4_flies_the_exact_orbit():
    problem = load("linear_quadratic").Docking()
    p = plan(problem, integrator="rk4")
    A = problem.drift(np.zeros(4), np.eye(4), np.zeros((4, 2))).T
    B = problem.drift(np.zeros(2), np.zeros((2, 4)), np.eye(2)).T
    both = expm(15.0 * np.block([[A, B], [np.zeros((2, 6))]]))
    x = problem.start
    for k, u in enumerate(p.controls):
        x = both[:4, :4] @ x + both[:4, 4:] @ u
        np.testing.assert_allclose(p.mean[k + 1], x, atol=1e-6)


# ------------------------------------------------------------------ free_time.py


def least_energy(times):
    """Least Σ dt u² for one metre from rest to rest, on the grid by Euler: minimum norm."""
    dt, beyond = np.diff(times), times[-1] - times[1:]
    effect = np.stack([np.sqrt(dt) * beyond, np.sqrt(dt)])
    return np.linalg.norm(np.linalg.pinv(effect) @ [1.0, 0.0]) ** 2


def spread_of(times, s):
    """∫ tr Σ dt under noise s on the speed, by Euler, from explicit sums."""
    dt = np.diff(times)
    total = 0.0
    for k in range(1, len(times)):
        lever = times[k] - times[1 : k + 1]
        total += dt[k - 1] * s**2 * np.sum(dt[:k] * (1.0 + lever**2))
    return total


GRIDS = {"even": np.linspace(0.0, 5.0, 51), "uneven": 3.0 * np.linspace(0.0, 1.0, 26) ** 1.4}


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize(("c", "w"), [(0.1, 0.0), (1.0, 0.0), (10.0, 0.0), (1.0, 10.0)])
def test_free_final_time_is_the_closed_form(c, w, grid):
    hoist = load("free_time").Hoist(times=GRIDS[grid])
    p = plan(hoist, free_final_time=True, time_weight=c, variance_weight=w, tolerance=1e-12)
    assert p.status is Status.CONVERGED
    # On a grid stretched to T the energy is α d²/T³, and ∫ tr Σ a polynomial: s²(a T² + b T⁴).
    unit = hoist.times / hoist.times[-1]
    alpha = least_energy(unit) * hoist.distance**2
    one, two = spread_of(unit, hoist.shaking), spread_of(2.0 * unit, hoist.shaking)
    b = (two - 4.0 * one) / 12.0
    a = one - b

    def slope(T):
        return -3.0 * alpha / T**4 + c + w * (2.0 * a * T + 4.0 * b * T**3)

    T = brentq(slope, 0.1, 100.0, xtol=1e-13)
    assert p.final_time == pytest.approx(T, rel=1e-6)
    np.testing.assert_allclose(p.times, T * unit, rtol=1e-6)
    assert p.effort == pytest.approx(alpha / T**3, rel=1e-6)
    assert p.variance == pytest.approx(a * T**2 + b * T**4, rel=1e-5)
    if w == 0.0:
        assert p.final_time == pytest.approx((3.0 * alpha / c) ** 0.25, rel=1e-6)
        assert abs(p.certificate.transversality) < 1e-5 * c


def test_free_final_time_nears_the_textbook():
    Hoist = load("free_time").Hoist
    errors = []
    for nodes in (26, 51, 101):
        hoist = Hoist(times=np.linspace(0.0, 5.0, nodes))
        p = plan(hoist, free_final_time=True, time_weight=2.0, variance_weight=0.0, tolerance=1e-12)
        errors.append(p.final_time / (36.0 * hoist.distance**2 / 2.0) ** 0.25 - 1.0)
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.1)


# ------------------------------------------------------------------ quadrotor.py

Quadrotor = load("quadrotor").Quadrotor
MIRROR = np.array([-1.0, 1.0, -1.0, -1.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def flights():
    """Plans by variance weight, to the last digit."""
    options = {"integrator": "rk4", "tolerance": 1e-14}
    return {w: plan(Quadrotor(), variance_weight=w, **options) for w in (0.0, 10.0)}


def simulate(problem, p, paths, substeps, *, feedback=None, seed=0):
    """End states (paths, 6) and those at half time by Euler–Maruyama with the midpoint's drift."""
    rng = np.random.default_rng(seed)
    x = np.tile(problem.start, (paths, 1))
    half = None
    for k, dt in enumerate(np.diff(p.times) / substeps):
        u = np.broadcast_to(p.controls[k], (paths, 2))
        if feedback is not None:
            u = feedback.control(np.full(paths, p.times[k]), x)
        for i in range(substeps):
            t = np.full(paths, p.times[k] + i * dt)
            noise = np.sqrt(dt) * rng.normal(size=(paths, 2, 1))
            middle = x + 0.5 * dt * problem.drift(t, x, u)
            pushed = (problem.diffusion(t, x) @ noise)[..., 0]
            x = x + dt * problem.drift(t, middle, u) + pushed
        if k + 1 == len(p.controls) // 2:
            half = x
    return half, x


def test_quadrotor_flies_through_the_gate(flights):
    problem = Quadrotor()
    for p in flights.values():
        assert p.status is Status.CONVERGED
        assert (np.abs(p.controls) <= problem.control_bounds).all()
        assert (np.abs(p.controls[:, 1]) == 20.0).any()  # the turns are as hard as they may be
        for x, z, radius in problem.posts:
            assert (np.hypot(p.mean[:, 0] - x, p.mean[:, 1] - z) > radius).all()
        assert 1.5 < np.interp(2.5, p.mean[:, 0], p.mean[:, 1]) < 2.5
        np.testing.assert_allclose(p.mean[-1], problem.goal, atol=1e-8)
    calm, wary = flights.values()
    assert wary.variance < 0.95 * calm.variance
    assert np.max(np.abs(wary.mean[:, 2])) < 0.95 * np.max(np.abs(calm.mean[:, 2]))
    assert calm.cost < wary.cost


@pytest.mark.parametrize("w", [0.0, 10.0])
def test_quadrotor_mirrored_and_moved(flights, w):
    p, q = flights[w], Quadrotor()
    options = {"variance_weight": w, "integrator": "rk4", "tolerance": 1e-14}
    mirrored = Quadrotor(
        start=tuple(MIRROR * q.start),
        goal=tuple(MIRROR * q.goal),
        posts=tuple((-x, z, r) for x, z, r in q.posts),
    )
    other = plan(mirrored, **options)
    np.testing.assert_allclose(other.mean, p.mean * MIRROR, atol=1e-5)
    np.testing.assert_allclose(other.controls, p.controls * [1.0, -1.0], atol=1e-4)
    np.testing.assert_allclose(other.covariance, p.covariance * np.outer(MIRROR, MIRROR), atol=1e-6)
    shift = np.array([3.0, -2.0, 0.0, 0.0, 0.0, 0.0])
    moved = Quadrotor(
        start=tuple(q.start + shift),
        goal=tuple(q.goal + shift),
        posts=tuple((x + 3.0, z - 2.0, r) for x, z, r in q.posts),
    )
    other = plan(moved, **options)
    np.testing.assert_allclose(other.mean, p.mean + shift, atol=1e-5)
    np.testing.assert_allclose(other.controls, p.controls, atol=1e-4)


def on_a_grid(nodes):
    class Regridded(Quadrotor):
        times = np.linspace(0.0, 2.0, nodes)

    return Regridded()


def test_quadrotor_moments_are_those_of_the_continuous_flight():
    # θ is deterministic and the rest linear in what is noisy, so mean and covariance of the true
    # process obey ẋ = b and Ṡ = A S + S Aᵀ + σσᵀ exactly.
    errors = []
    for nodes in (51, 101, 201):
        problem = on_a_grid(nodes)
        p = plan(problem, variance_weight=10.0, integrator="rk4", tolerance=1e-10)
        jacobian = model_of(problem).drift_jacobian

        def moments(t, y, u, problem=problem, jacobian=jacobian):
            x, S = y[:6], y[6:].reshape(6, 6)
            A, sigma = jacobian(t, x, u)[0], problem.diffusion(t, x)
            return np.append(problem.drift(t, x, u), A @ S + S @ A.T + sigma @ sigma.T)

        y = np.append(problem.start, np.zeros(36))
        for k, u in enumerate(p.controls):
            span = p.times[k : k + 2]
            y = solve_ivp(moments, span, y, args=(u,), rtol=1e-8, atol=1e-10).y[:, -1]
        errors.append([np.max(np.abs(y[:6] - p.mean[-1])), y[6] - p.covariance[-1, 0, 0]])
    mean, variance = np.transpose(errors)
    assert mean[0] < 1e-4
    assert mean[2] < 1e-6  # rk4
    assert variance[2] < 0.02 * y[6]
    # An interval's noise acts at its beginning: first order.
    np.testing.assert_allclose(np.log2(variance[:-1] / variance[1:]), 1.0, atol=0.1)


@pytest.mark.parametrize("w", [0.0, 10.0])
def test_quadrotor_moments_are_those_of_many_flights(w):
    problem, paths = on_a_grid(201), 10_000
    p = plan(problem, variance_weight=w, integrator="rk4")
    for k, x in zip((100, 200), simulate(problem, p, paths, 2), strict=True):
        sigma = np.sqrt(np.diag(p.covariance[k]))
        scale = np.outer(sigma, sigma) + 1e-12
        assert np.max(np.abs(np.cov(x.T) - p.covariance[k]) / scale) < 0.06
        assert (np.abs(x.mean(axis=0) - p.mean[k]) < 4.0 * sigma / np.sqrt(paths) + 1e-3).all()
        assert x[:, 2].std() == pytest.approx(0.0, abs=1e-12)


def test_quadrotor_with_feedback_arrives_nearer(flights):
    problem, p = Quadrotor(), flights[10.0]
    goal = np.array(problem.goal)
    _, open_loop = simulate(problem, p, 1000, 5)
    _, closed = simulate(problem, p, 1000, 5, feedback=Feedback(p))
    apart = [np.sqrt(np.mean((x - goal)[:, :2] ** 2)) for x in (open_loop, closed)]
    assert apart[1] < 0.2 * apart[0]


# ------------------------------------------------------------------ risk.py


def ferry_paths(p, *, closed, paths=40_000, seed=11):
    """Which paths come too near, simulated here from the equation that Ferry's docstring states."""
    rng = np.random.default_rng(seed)
    ferry, dt = p.problem, 0.5
    x, hit, effort = np.zeros((paths, 4)), np.zeros(paths, dtype=bool), np.zeros(paths)
    for k in range(40):
        u = np.broadcast_to(p.controls[k], (paths, 2))
        if closed:
            u = np.clip(u + (x - p.mean[k]) @ p.gains[k].T, -0.6, 0.6)
        effort += dt * (u * u).sum(axis=1)
        gust = 0.05 * np.sqrt(dt) * rng.standard_normal((paths, 2))
        velocity = x[:, 2:]
        x = np.concatenate(
            [x[:, :2] + dt * velocity, velocity + dt * (u - 0.1 * velocity) + gust], 1
        )
        hit |= np.hypot(*(x[:, :2] - ferry.lightship).T) < ferry.safe
    return hit.mean(), effort.mean(), x


@pytest.mark.parametrize("delta", [0.05, 0.01])
def test_ferry_keeps_its_risk_within_exact_bounds(delta):
    # Linear with isotropic gusts: the distance at a node is a Rice variable, its law exact.
    ferry = load("risk").Ferry()
    p = plan(ferry, risk=delta)
    assert p.status is Status.CONVERGED
    s = np.sqrt(p.covariance[2:, 0, 0])  # the gusts take two steps to be felt
    near = np.linalg.norm(p.mean[2:, :2] - ferry.lightship, axis=1)
    with np.errstate(over="ignore"):
        node = rice.cdf(ferry.safe / s, near / s)
    rate, effort, _ = ferry_paths(p, closed=False)
    noise = 4.0 * np.sqrt(delta / 40_000)
    assert node.max() - noise <= rate <= min(node.sum(), delta) + noise
    # What was minimised is Boole's bound to second order: neither half planes nor the discs.
    assert p.risk.predicted == pytest.approx(node.sum(), rel=0.15)
    assert 0.5 * delta < p.risk.verified <= delta
    assert effort == pytest.approx(p.effort)


def test_ferry_that_corrects_itself_passes_nearer_for_less():
    ferry = load("risk").Ferry()
    still, steered = plan(ferry, risk=0.01), plan(ferry, feedback=True, risk=0.01)
    rate, effort, x = ferry_paths(steered, closed=True)
    assert rate <= 0.01 + 4.0 * np.sqrt(0.01 / 40_000)
    expected = steered.expected
    assert effort == pytest.approx(expected.effort + expected.feedback, rel=0.01)
    missed = (x - ferry.goal) ** 2 @ ferry.terminal_weight
    assert missed.mean() == pytest.approx(expected.goal, rel=0.03)
    assert effort < 0.9 * still.effort
    near = [np.linalg.norm(p.mean[:, :2] - ferry.lightship, axis=1).min() for p in (still, steered)]
    assert near[1] < near[0] - 1.0

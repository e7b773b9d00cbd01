"""Systems written as a user would, against closed forms and SciPy's optimisers."""

import numpy as np
import pytest
from scipy.optimize import minimize

from slipcar.planner import Problem, Status, plan


class Cart:
    """A double integrator with additive noise on position and speed: drift and no more."""

    def __init__(self, times, target=(1.0, 0.0), noise=((0.0,), (0.3,)), **members):
        self.start = np.zeros(2)
        self.times = np.asarray(times)
        self.control_weight = np.eye(1)
        self.target, self.noise = np.asarray(target), np.asarray(noise)
        self.__dict__.update(members)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def diffusion(self, t, x):
        return np.broadcast_to(self.noise, (*x.shape[:-1], *self.noise.shape))

    def terminal(self, x):
        return x[..., : len(self.target)] - self.target


UNEVEN = np.linspace(0.0, 1.0, 26) ** 1.4


def minimum_energy(times, target):
    """Least Σ dt u² with x_N = target, by the pseudo-inverse of the controls' effect."""
    dt = np.diff(times)
    effect, Phi = np.empty((len(target), len(dt))), np.eye(2)
    for k in range(len(dt) - 1, -1, -1):
        effect[:, k] = dt[k] * Phi[: len(target), 1]
        Phi = Phi @ np.array([[1.0, dt[k]], [0.0, 1.0]])
    scaled = effect / np.sqrt(dt)
    return np.linalg.pinv(scaled) @ target / np.sqrt(dt)


@pytest.mark.parametrize("solver", ["structured", "osqp", "cvxpy"])
@pytest.mark.parametrize("target", [(1.0, 0.0), (1.0,)])
@pytest.mark.parametrize("times", [np.linspace(0.0, 2.0, 21), UNEVEN])
def test_minimum_energy_of_a_double_integrator(times, target, solver):
    cart = Cart(times, target)
    assert isinstance(cart, Problem)
    p = plan(cart, solver=solver)
    assert p.status is Status.CONVERGED
    assert p.iterations <= 3  # it is linear: one to solve, two to see that nothing moves
    u = minimum_energy(times, np.array(target))
    np.testing.assert_allclose(p.controls[:, 0], u, atol=1e-5 * np.max(np.abs(u)))
    assert p.effort == pytest.approx(np.sum(np.diff(times) * u**2), rel=1e-7)
    assert p.obstacle_cost == 0.0


def test_rest_to_rest_in_the_limit_of_a_fine_grid():
    # The continuous problem: ∫u² = 12 for one metre in one second, u = 6 − 12 t.
    p = plan(Cart(np.linspace(0.0, 1.0, 1001)))
    assert p.effort == pytest.approx(12.0, rel=1e-5)
    np.testing.assert_allclose(p.controls[:, 0], 6.0 - 12.0 * p.times[:-1], atol=0.02)


def test_covariance_of_the_double_integrator_in_closed_form():
    # Noise s on the speed: Var v = s² t, Cov = s² t²/2, Var r = s² t³/3 as dt -> 0.
    p = plan(Cart(np.linspace(0.0, 1.0, 2001)))
    t = p.times[1:]
    exact = 0.09 * np.array([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]]).transpose(2, 0, 1)
    np.testing.assert_allclose(p.covariance[1:], exact, atol=1e-3 * 0.09)
    assert p.variance == pytest.approx(0.09 * (1.0 / 12.0 + 0.5), rel=2e-3)


def test_covariance_with_several_brownian_motions_on_an_uneven_grid():
    noise = np.array([[0.2, 0.0, -0.1], [0.3, 0.5, 0.4]])
    p = plan(Cart(UNEVEN, noise=noise))
    S = np.zeros((2, 2))
    for k, dt in enumerate(np.diff(UNEVEN)):
        F = np.array([[1.0, dt], [0.0, 1.0]])
        S = F @ S @ F.T + dt * noise @ noise.T
        np.testing.assert_allclose(p.covariance[k + 1], S, rtol=1e-12)


def test_asymmetric_bounds_against_scipy():
    times = np.linspace(0.0, 2.0, 21)
    cart = Cart(times, control_bounds=np.array([[-0.9], [1.3]]))
    p = plan(cart, tolerance=1e-8)
    assert p.status is Status.CONVERGED
    dt = np.diff(times)

    def end(u):
        x = np.zeros(2)
        for k, v in enumerate(u):
            x = x + dt[k] * np.array([x[1], v])
        return x - cart.target

    known = minimize(
        lambda u: np.sum(dt * u**2),
        np.zeros(20),
        jac=lambda u: 2 * dt * u,
        method="SLSQP",
        bounds=[(-0.9, 1.3)] * 20,
        constraints={"type": "eq", "fun": end},
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert p.effort == pytest.approx(known.fun, rel=1e-6)
    np.testing.assert_allclose(p.controls[:, 0], known.x, atol=1e-4)
    # Symmetric energy-optimal controls would reach ±1.5: both bounds are at work.
    assert np.isclose(p.controls, -0.9, atol=1e-9).any()
    assert np.isclose(p.controls, 1.3, atol=1e-9).any()


def test_bounds_that_exclude_zero_and_bounds_on_one_side():
    times = np.linspace(0.0, 2.0, 21)
    p = plan(Cart(times, (1.0,), control_bounds=np.array([[0.2], [2.0]])))
    assert p.status is Status.CONVERGED
    assert p.controls.min() == pytest.approx(0.2)
    p = plan(Cart(times, control_bounds=np.array([[-np.inf], [1.1]])))
    assert p.status is Status.CONVERGED
    assert p.controls.max() == pytest.approx(1.1)
    assert p.controls.min() < -1.5


class Slipping(Cart):
    """Noise on the position in proportion to the speed: a quadratic variance penalty, exactly."""

    def diffusion(self, t, x):
        zero = 0.0 * x[..., 1]
        return np.stack([0.8 * x[..., 1], zero], axis=-1)[..., None]


@pytest.mark.parametrize("weight", [0.0, 3.0, 300.0])
def test_variance_penalty_of_a_linear_system_is_minimised_exactly(weight):
    times = UNEVEN
    dt, K = np.diff(times), len(UNEVEN) - 1
    p = plan(Slipping(times), variance_weight=weight, tolerance=1e-12)
    assert p.status is Status.CONVERGED

    # The same least squares by hand: v_k is linear in u, Var r_k = Σ_{j<k} dt_j (0.8 v_j)².
    speed = np.tril(np.broadcast_to(dt, (K, K)), -1)  # v_j = Σ_{i<j} dt_i u_i, j = 0..K−1
    price = dt * 0.64 * np.cumsum(dt[::-1])[::-1]  # of v_j²: dt_j σ² times the time left
    H = np.diag(dt) + weight * speed.T @ (price[:, None] * speed)
    to_end = np.vstack([dt @ speed, dt])  # r_N = Σ dt_j v_j, v_N
    kkt = np.block([[2 * H, to_end.T], [to_end, np.zeros((2, 2))]])
    u = np.linalg.solve(kkt, np.concatenate([np.zeros(K), [1.0, 0.0]]))[:K]
    np.testing.assert_allclose(p.controls[:, 0], u, atol=1e-7 * np.max(np.abs(u)))
    assert p.variance == pytest.approx(np.sum(price * (speed @ u) ** 2), rel=1e-9)


class Pendulum:
    """sin in the drift, two Brownian motions, a full diffusion matrix; Jacobians left out."""

    start = np.array([0.2, 0.0])
    times = np.concatenate([np.linspace(0.0, 0.5, 9), np.linspace(0.6, 1.5, 10)])
    control_weight = np.array([[0.5]])

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - 9.81 * np.sin(x[..., 0]) - 0.1 * x[..., 1]], -1)

    def diffusion(self, t, x):
        one = np.ones(x.shape[:-1])
        return np.stack(
            [np.stack([0.1 * one, 0.05 * one], -1), np.stack([0.2 * one, 0.3 + 0.1 * t], -1)], -2
        )

    def terminal(self, x):
        return x - np.array([1.5, 0.0])


class Tip(Pendulum):
    """The tip at a height, with no matter which speed: one non-linear terminal condition."""

    def terminal(self, x):
        return np.cos(x[..., :1]) - 0.2


class Unicycle:
    """Speed and yaw rate as controls, to the rim of a circle; noise on the position."""

    start = np.array([0.0, 0.0, 0.3])
    times = np.linspace(0.0, 2.0, 17)
    control_weight = np.diag([1.0, 0.3])

    def drift(self, t, x, u):
        return np.stack(
            [u[..., 0] * np.cos(x[..., 2]), u[..., 0] * np.sin(x[..., 2]), u[..., 1]], -1
        )

    def diffusion(self, t, x):
        return 0.1 * np.broadcast_to([[1.0, 0.3], [0.3, 1.0], [0.0, 0.0]], (*x.shape[:-1], 3, 2))

    def terminal(self, x):
        return (x[..., :1] - 1.0) ** 2 + (x[..., 1:2] - 2.0) ** 2 - 0.25

    def initial_guess(self):
        # At rest the linearised car cannot move sideways, so the guess already drives.
        u = np.tile([1.0, 0.5], (16, 1))
        x = np.empty((17, 3))
        x[0] = self.start
        for k in range(16):
            x[k + 1] = x[k] + 0.125 * self.drift(0.0, x[k], u[k])
        return x, u


class Fenced(Pendulum):
    """A soft fence on the speed, so that a penalty of one's own takes part."""

    penalty_weight = np.array([40.0])

    def penalty(self, t, x):
        return x[..., 1:] - 1.2 + 0.1 * t[..., None]


@pytest.mark.parametrize("system", [Pendulum, Tip, Unicycle, Fenced])
def test_deterministic_plans_against_scipy(system, rollout, cost_of_controls):
    problem = system()
    assert isinstance(problem, Problem)
    p = plan(problem, variance_weight=0.0, tolerance=1e-10)
    assert p.status is Status.CONVERGED
    np.testing.assert_allclose(rollout(problem, p.controls), p.mean, atol=1e-8)
    np.testing.assert_allclose(problem.terminal(p.mean[-1]), 0.0, atol=1e-8)
    if system is Fenced:
        assert p.obstacle_cost > 1e-3

    # SciPy starts nearby and finds its own way; far away lie other local optima.
    known = minimize(
        lambda z: cost_of_controls(problem, z.reshape(p.controls.shape)),
        p.controls.ravel() + 0.1 * np.random.default_rng(0).normal(size=p.controls.size),
        method="SLSQP",
        constraints={
            "type": "eq",
            "fun": lambda z: problem.terminal(rollout(problem, z.reshape(p.controls.shape))[-1]),
        },
        options={"ftol": 1e-12, "maxiter": 500},
    )
    assert known.success
    assert p.cost == pytest.approx(known.fun, rel=1e-6)
    np.testing.assert_allclose(p.controls.ravel(), known.x, atol=2e-3)


@pytest.mark.parametrize("system", [Pendulum, Tip, Unicycle])
def test_stochastic_plans_converge_and_their_covariance_meets_monte_carlo(system):
    problem = system()
    p = plan(problem, variance_weight=0.5)
    assert p.status is Status.CONVERGED
    rng = np.random.default_rng(3)
    paths, small = 20_000, 0.2
    # With little noise the non-linear process is its linearisation; Σ is quadratic in σ.
    x = np.broadcast_to(problem.start, (paths, len(problem.start)))
    for k, dt in enumerate(np.diff(problem.times)):
        t = np.full(paths, problem.times[k])
        u = np.broadcast_to(p.controls[k], (paths, p.controls.shape[1]))
        sigma = problem.diffusion(t, x)
        noise = small * np.sqrt(dt) * rng.normal(size=(paths, sigma.shape[2], 1))
        x = x + dt * problem.drift(t, x, u) + (sigma @ noise)[..., 0]
    sampled = np.cov(x.T) / small**2
    assert np.max(np.abs(sampled - p.covariance[-1])) < 0.05 * np.max(sampled)
    np.testing.assert_allclose(x.mean(axis=0), p.mean[-1], atol=0.01)


def test_without_a_terminal_condition_the_cheapest_thing_is_nothing(rollout):
    class Free(Pendulum):
        def terminal(self, x):
            return x[..., :0]

    p = plan(Free())
    assert p.status is Status.CONVERGED
    assert not p.controls.any()
    assert p.multipliers.terminal.shape == (0,)


def test_converged_means_that_the_mean_is_what_the_controls_do(rollout):
    # The controls settle at once (they are zero throughout) while the guessed states are still
    # far from the path: small steps in the controls prove nothing by themselves.
    class Free(Pendulum):
        times = np.linspace(0.0, 4.0, 81)

        def terminal(self, x):
            return x[..., :0]

    problem = Free()
    guess = (np.linspace([0.2, 0.0], [3.0, -2.0], 81), np.zeros((80, 1)))
    p = plan(problem, guess=guess)
    assert p.status is Status.CONVERGED
    assert np.max(np.abs(rollout(problem, p.controls) - p.mean)) < 1e-3


def test_an_uncontrolled_path_that_escapes_gives_way_to_a_line_to_the_end():
    # ẋ = x³ + u from 1.2 is beyond 10³⁰⁰ within a few steps.
    class Escaping:
        start, times, control_weight = np.array([1.2]), np.linspace(0.0, 2.0, 41), np.eye(1)

        def drift(self, t, x, u):
            return x**3 + u

        def diffusion(self, t, x):
            return np.full((*x.shape[:-1], 1, 1), 0.1)

        def terminal(self, x):
            return x - 0.5

    with np.errstate(all="raise"):
        p = plan(Escaping(), variance_weight=0.0)
    assert p.status is Status.CONVERGED
    np.testing.assert_allclose(p.guess[:, 0], np.linspace(1.2, 0.5, 41), rtol=1e-12)
    assert p.mean[-1, 0] == pytest.approx(0.5)


@pytest.mark.parametrize("scale", [1e-4, 1e4, 1e8])
def test_feasibility_does_not_depend_on_units(scale):
    # Controls dear or cheap, states in nanometres or megametres: reachable is reachable.
    times = np.linspace(0.0, 2.0, 21)
    dear = Cart(times)
    dear.control_weight = scale * np.eye(1)
    far = Cart(times, target=(scale, 0.0))
    unit = plan(Cart(times)).effort
    p, q = plan(dear, variance_weight=0.0), plan(far, variance_weight=0.0)
    assert p.status is Status.CONVERGED
    assert p.effort == pytest.approx(scale * unit, rel=1e-6)
    assert q.status is Status.CONVERGED
    assert q.effort == pytest.approx(scale**2 * unit, rel=1e-6)


def test_a_problem_with_one_interval():
    class Once:
        start, times, control_weight = np.array([1.0]), np.array([0.0, 0.5]), np.array([[2.0]])

        def drift(self, t, x, u):
            return -x + u

        def diffusion(self, t, x):
            return np.full((*x.shape[:-1], 1, 1), 0.3)

        def terminal(self, x):
            return x - 0.8

    p = plan(Once())
    assert p.status is Status.CONVERGED
    # 1 + 0.5 (u − 1) = 0.8
    np.testing.assert_allclose(p.controls, [[0.6]])
    assert p.variance == pytest.approx(0.5 * 0.5 * 0.09)


def test_conditions_that_repeat_or_contradict_each_other():
    times = np.linspace(0.0, 2.0, 21)

    class Twice(Cart):
        def terminal(self, x):
            return np.concatenate([x - self.target, 2.0 * (x - self.target)], axis=-1)

    class Both(Cart):
        def terminal(self, x):
            return np.stack([x[..., 0] - 1.0, x[..., 0] - 1.5], axis=-1)

    p = plan(Twice(times))
    assert p.status is Status.CONVERGED
    u = minimum_energy(times, np.array([1.0, 0.0]))
    np.testing.assert_allclose(p.controls[:, 0], u, atol=1e-6)
    assert plan(Both(times)).status is Status.INFEASIBLE

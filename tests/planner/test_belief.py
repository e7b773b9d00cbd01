"""Covariance, weights of the noise and gains: against simulation, differences, Riccati's recursion.

The system is a point mass whose noise grows with its speed, with rows that are affine in the state:
then nothing is neglected: every equation of :mod:`slipcar.planner.moments.propagation` is exact.
All matrices are written out here; the kernels are run as machine code and by NumPy.
"""

import copy
import dataclasses
import types

import numpy as np
import pytest

from slipcar.planner.moments.gains import feedback_effort, lqr_gains
from slipcar.planner.moments.losses import loss
from slipcar.planner.moments.propagation import noise_charge, noise_model
from slipcar.planner.newton.loop import iterate
from slipcar.planner.newton.posing import pose
from slipcar.planner.newton.program import Workspace
from slipcar.planner.newton.running import form_of, load, solve_noise, task_of
from slipcar.planner.newton.tuning import NOISE
from slipcar.planner.problem.model import model_of

N, M = 4, 2
SLIP, ADDITIVE, TERMINAL, W = 0.4, 0.05, 30.0, 0.3
#: Hessian/2 of the mass' state cost, Jacobian of its penalty and its two constraints.
SHAPE = np.diag([0.2, 0.1, 0.4, 0.3]) + 0.05
ROWS = np.array([[-0.8, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
ENGINES = pytest.mark.parametrize("compiled", [None, False], ids=["machine code", "numpy"])


def believe(posed, stakes, x, u, *, warm=None, renewal=0.5):
    """What the kernels make of a path before any step: P at nodes 1..K, (K, n, n), and the rest."""
    K = len(u)
    workspace = Workspace(posed.program(form_of(posed, stakes)), K)
    load(workspace, posed, stakes.weight, x, u)
    workspace.arrays["W"][0] = stakes.terminal
    if warm is not None:
        workspace.at(0, "gains")[:K], workspace.at(0, "eta")[1:] = warm.gains, warm.eta
    task = task_of(posed.model, stakes, 0.0, 0, warm is not None)
    ending = iterate(workspace, task, NOISE._replace(renewal=renewal), posed.filler)
    assert ending.side == 0
    belief = {name: workspace.at(0, name).copy() for name in ("Sigma", "s", "c", "x", "noise")}
    for name in ("P", "gains", "lower", "upper"):  # each of an interval; P arrives at its end
        belief[name] = workspace.at(0, name)[:K].copy()
    return types.SimpleNamespace(eta=workspace.at(0, "eta")[1:].copy(), **belief)


class Deviations:
    """Deviations from a path x (N, n) of the mass, with gains: their covariance and cost."""

    def __init__(self, posed, stakes, x, c):
        self.dt, self.R, self.x, self.c, self.stakes = posed.model.dt, posed.model.R, x, c, stakes
        self.start = posed.model.start_covariance
        self.F = [np.eye(N) + h * np.eye(N, k=2) for h in self.dt]
        self.B = [np.concatenate([np.zeros((2, 2)), h * np.eye(2)]) for h in self.dt]

    def arrives(self, k, S):
        """Dt E σσᵀ on the way from node k, where deviations have covariance S: in closed form."""
        vx, vy = self.x[k, 2:]
        noise = np.zeros((N, N))
        noise[0, 0] = SLIP**2 * (vy**2 + S[3, 3]) + ADDITIVE**2
        noise[1, 1] = SLIP**2 * (vx**2 + S[2, 2])
        noise[0, 1] = noise[1, 0] = ADDITIVE * SLIP * vx
        return self.dt[k] * noise

    def covariance(self, gains, extra=None):
        """Σ (N, n, n); `extra` (N, n, n) is injected on arrival at each node."""
        extra = np.zeros((len(self.x), N, N)) if extra is None else extra
        S = [self.start + extra[0]]
        for k, gain in enumerate(gains):
            closed = self.F[k] + self.B[k] @ gain
            S.append(closed @ S[k] @ closed.T + self.arrives(k, S[k]) + extra[k + 1])
        return np.array(S)

    def cost(self, eta, gains, extra=None):
        """What spread costs with the rows' weights (K, p) held."""
        S, value = self.covariance(gains, extra), 0.0
        C = ROWS[: eta.shape[1]]
        for k, h in enumerate(self.dt):
            value += eta[k] @ np.diag(C @ S[k + 1] @ C.T)
            value += h * np.trace((self.stakes.variance_weight * np.eye(N) + SHAPE) @ S[k + 1])
            value += h * np.trace(gains[k] @ S[k] @ gains[k].T @ self.R)
        return value + self.stakes.terminal @ np.diag(S[-1])

    def deviations(self, S):
        """Of the rows at nodes 1..K, at least a part of the largest."""
        s = np.sqrt(np.einsum("pi,kij,pj->kp", ROWS, S[1:], ROWS))
        return np.maximum(s, 0.02 * s.max(axis=0) + 1e-9)

    def rows(self, s):
        """Losses of the rows, weighed: penalties by the second, constraints by the node."""
        weight = self.stakes.weight * np.stack(
            [self.dt, 0.0 * self.dt + 1.0, 0.0 * self.dt + 1.0], 1
        )
        return loss(self.c[1:], s, weight, np.array([False, True, True]))

    def whole_cost(self, gains, extra=None):
        """The same with what rows really cost."""
        nothing = np.zeros((len(self.dt), 0))
        s = self.deviations(self.covariance(gains, extra))
        return self.rows(s).value.sum() + self.cost(nothing, gains, extra)

    def kicks(self, rng, k, e):
        """√dt σ ξ on the way from node k: σ is that where each path (P, n) is."""
        vx, vy = (self.x[k] + e).T[2:]
        kick, xi = np.zeros_like(e), np.sqrt(self.dt[k]) * rng.standard_normal((2, len(e)))
        kick[:, 0], kick[:, 1] = SLIP * vy * xi[0] + ADDITIVE * xi[1], SLIP * vx * xi[1]
        return kick


def wander(posed, seed=6, scale=1.0):
    """Controls at random, and the path they lead to: the dynamics hold, nothing else does."""
    model = posed.model
    x, u = model.guess()
    u = u + scale * np.random.default_rng(seed).normal(size=u.shape)
    for k, dt in enumerate(model.dt):
        x[k + 1] = x[k] + dt * model.drift(model.times[k], x[k], u[k])
    return x, u


@pytest.fixture(scope="module", params=[None, False], ids=["machine code", "numpy"])
def settled(request, mass, expected_stakes):
    """A plan with feedback, and its belief when weights and gains have found each other."""
    problem = mass(spread=0.03)
    posed = pose(model_of(problem), constraints=True, compiled=request.param)
    stakes = expected_stakes(problem, price=2.0, soft=True, feedback=True, w=W, terminal=TERMINAL)
    x, u = posed.model.guess()
    plan = solve_noise(posed, stakes, x, u, tolerance=1e-18, max_iterations=300)
    assert plan.status.ok
    now = believe(posed, stakes, plan.x, plan.u, warm=plan)
    for _ in range(25):
        now = believe(posed, stakes, plan.x, plan.u, warm=now)
    return now, Deviations(posed, stakes, plan.x, now.c)


# ------------------------------------------------------------------------------ covariance


def test_the_covariance_is_that_of_simulated_deviations(settled):
    now, about = settled
    rng, paths = np.random.default_rng(0), 200_000
    e = rng.multivariate_normal(np.zeros(N), about.start, size=paths)
    plain = about.start  # without the noise of noisy states
    for k, gain in enumerate(now.gains):
        closed = about.F[k] + about.B[k] @ gain
        plain = closed @ plain @ closed.T + about.arrives(k, np.zeros((N, N)))
        e = e @ closed.T + about.kicks(rng, k, e)
        S, squares = now.Sigma[k + 1], e * e
        # Not Gaussian any more: the standard errors are the paths' own.
        error = np.sqrt((squares.T @ squares / paths - S**2).clip(0.0) / paths)
        assert (np.abs(e.T @ e / paths - S) <= 5.0 * error + 1e-15).all()
    assert (np.abs(plain - S) > 10.0 * error).any()
    # And to rounding, by the recursion itself.
    np.testing.assert_allclose(now.Sigma, about.covariance(now.gains), atol=1e-15, rtol=1e-12)


def test_deviations_of_rows_are_those_of_the_closed_loop(settled):
    now, about = settled
    known = np.sqrt(np.einsum("pi,kij,pj->kp", ROWS, about.covariance(now.gains), ROWS))
    np.testing.assert_allclose(now.s, known, rtol=1e-12, atol=1e-15)


@ENGINES
def test_expectations_of_curved_rows_count_their_spread(compiled, expected_stakes):
    """E c = c(μ) + ½ tr(∂²c Σ), exact for quadratic rows whatever is distributed how."""
    shape = np.array([[2.0, 0.3], [0.3, -1.0]])
    problem = types.SimpleNamespace(
        start=np.array([0.5, -0.2]),
        start_covariance=np.array([[0.3, 0.1], [0.1, 0.2]]),
        times=np.linspace(0.0, 1.0, 7),
        control_weight=np.eye(2),
        drift=lambda t, x, u: u + 0.0 * x,
        diffusion=lambda t, x: np.broadcast_to(np.diag([0.4, 0.7]), (*x.shape, 2)),
        terminal=lambda x: x - 1.0,
        penalty=lambda t, x: np.einsum("...i,ij,...j", x, shape, x)[..., None] - t[..., None],
        penalty_weight=np.ones(1),
    )
    posed = pose(model_of(problem), compiled=compiled)
    x, u = wander(posed, scale=0.5)
    stakes = expected_stakes(problem, price=0.0, soft=True, feedback=False, terminal=1.0)
    plan = solve_noise(posed, stakes, x, u, tolerance=0.0, max_iterations=0)
    t = problem.times
    S = problem.start_covariance + t[:, None, None] * np.diag([0.4, 0.7]) ** 2
    np.testing.assert_allclose(plan.covariance, S, rtol=1e-12)
    known = np.einsum("ki,ij,kj->k", x, shape, x) - t + np.einsum("ij,kij->k", shape, S)
    np.testing.assert_allclose(plan.c[:, 0], known[1:], rtol=1e-9)
    c, s = posed.row_moments(plan.x, plan.covariance)
    np.testing.assert_allclose(c[:, 0], known[1:], rtol=1e-9)
    slopes = 2.0 * x @ shape
    deviation = np.sqrt(np.einsum("ki,kij,kj->k", slopes, S, slopes))[1:]
    for known in (plan.s, s):
        floor = 0.02 * deviation.max() + 1e-9
        np.testing.assert_allclose(known[:, 0], np.maximum(deviation, floor), rtol=1e-9)


# ------------------------------------------------------------------------------ weights


def test_weights_are_the_derivative_by_the_noise_that_arrives(settled):
    """P at a node is ∂cost/∂(noise injected there): with weights held, and of the whole.

    Noise that arrives makes later noise larger: that is in the derivative.
    """
    now, about = settled
    rng = np.random.default_rng(3)
    # At a fixed point the weights that are held are those the spread asks for.
    wanted = about.rows(about.deviations(now.Sigma)).by_variance
    # (None is held below 1e-9 of the largest.)
    np.testing.assert_allclose(now.eta, wanted, rtol=1e-6, atol=2e-9 * wanted.max())
    for k in range(len(now.P)):
        F = rng.normal(size=(N, 2))
        extra, h = np.zeros_like(now.Sigma), 1e-6
        extra[k + 1] = h * F @ F.T
        predicted = np.trace(now.P[k] @ F @ F.T)
        for cost in (
            lambda e: about.cost(now.eta, now.gains, e),
            lambda e: about.whole_cost(now.gains, e),
        ):
            slope = (cost(extra) - cost(-extra)) / (2 * h)
            assert slope == pytest.approx(predicted, rel=2e-5)


def test_the_noise_costs_its_trace_against_the_weights(settled):
    """Σ dt tr(P σσᵀ) + tr(P_0 Σ_0) is all that deviations cost."""
    now, about = settled
    value = about.cost(now.eta, now.gains)
    assert now.noise[0] == pytest.approx(value, rel=1e-12)
    # What does not come from the start comes from the noise, each interval by itself.
    about = copy.copy(about)
    about.start = np.zeros((N, N))
    arrives = sum(np.vdot(P, about.arrives(k, about.start)) for k, P in enumerate(now.P))
    assert arrives == pytest.approx(about.cost(now.eta, now.gains), rel=1e-12)
    assert arrives < 0.99 * value


def test_the_noise_is_a_quadratic_with_the_right_slope():
    """Dt tr(P σσᵀ) in the state, P held; exact where σ is affine."""
    rng, n, d, dt = np.random.default_rng(4), 5, 3, 0.2
    half, at, slopes = rng.normal(size=(n, n)), rng.normal(size=(n, d)), rng.normal(size=(n, d, n))
    P = half @ half.T
    gradient, hessian = noise_model(P, at, slopes, dt)
    for _ in range(5):
        move = rng.normal(size=n)
        sigma = at + slopes @ move
        moved = noise_charge(P, at, dt) + gradient @ move + 0.5 * move @ hessian @ move
        assert dt * np.trace(P @ sigma @ sigma.T) == pytest.approx(moved, rel=1e-12)


@ENGINES
def test_open_loop_has_no_gains_but_the_same_weights_by_differences(
    compiled, mass, expected_stakes
):
    problem = mass(spread=0.03)
    posed = pose(model_of(problem), constraints=True, compiled=compiled)
    stakes = expected_stakes(problem, price=2.0, soft=False, feedback=False, w=W, terminal=TERMINAL)
    x, u = wander(posed)
    now = believe(posed, stakes, x, u)
    assert not now.gains.any()
    about, rng, checked = Deviations(posed, stakes, x, now.c), np.random.default_rng(7), 0
    for k in range(len(u)):
        F, extra = rng.normal(size=(N, 1)), np.zeros_like(now.Sigma)
        extra[k + 1] = 1e-6 * F @ F.T
        slope = (about.cost(now.eta, now.gains, extra) - about.cost(now.eta, now.gains)) / 1e-6
        assert slope == pytest.approx(np.trace(now.P[k] @ F @ F.T), rel=1e-6)
        # Where Φ is no longer what is charged its slope by s is not believed.
        if not (now.c[k + 1 :, 1:] > -0.5 * now.s[k + 1 :, 1:]).any():
            checked += 1
            up, down = (about.whole_cost(now.gains, e) for e in (extra, -extra))
            assert (up - down) / 2e-6 == pytest.approx(np.trace(now.P[k] @ F @ F.T), rel=1e-4)
    assert checked > 3
    assert (now.lower == -np.inf).all()
    assert (now.upper == np.inf).all()


@ENGINES
@pytest.mark.parametrize("renewal", [0.25, 1.0])
def test_renewal_mixes_weights_of_tails_by_their_logarithms(
    renewal, compiled, mass, expected_stakes
):
    problem = mass()
    posed = pose(model_of(problem), constraints=True, compiled=compiled)
    stakes = expected_stakes(problem, price=2.0, soft=True, feedback=True, terminal=TERMINAL)
    x, u = wander(posed, scale=0.5)
    fresh = believe(posed, stakes, x, u)
    # Fresh weights are what the spread without gains asks for.
    about = Deviations(posed, stakes, x, fresh.c)
    wanted = about.rows(about.deviations(about.covariance(0.0 * fresh.gains))).by_variance
    np.testing.assert_allclose(fresh.eta, wanted, rtol=1e-9, atol=2e-9 * wanted.max())
    before = types.SimpleNamespace(gains=0.0 * fresh.gains, eta=3.0 * fresh.eta + 1e-3)
    eta = believe(posed, stakes, x, u, warm=before, renewal=renewal).eta
    tails = before.eta[:, 1:] ** (1.0 - renewal) * wanted[:, 1:] ** renewal
    large = wanted[:, 1:] > 1e-6 * wanted.max()
    assert large.sum() > 3
    np.testing.assert_allclose(eta[:, 1:][large], tails[large], rtol=1e-9)
    # Penalties are not exponential: nothing is mixed.
    np.testing.assert_allclose(eta[:, 0], wanted[:, 0], rtol=1e-9, atol=1e-15)


# ------------------------------------------------------------------------------ gains


def test_no_gains_are_better(settled):
    now, about = settled
    rng = np.random.default_rng(5)
    best, whole = about.cost(now.eta, now.gains), about.whole_cost(now.gains)
    for size in (1e-3, 0.1, 1.0):
        for _ in range(10):
            other = now.gains + size * rng.normal(size=now.gains.shape)
            assert about.cost(now.eta, other) > best
            # A stationary point of the whole, so no better nearby either.
            if size < 0.01:
                assert about.whole_cost(other) > whole
    d, h = rng.normal(size=now.gains.shape), 1e-4
    up, down = about.whole_cost(now.gains + h * d), about.whole_cost(now.gains - h * d)
    curvature = (up + down - 2 * whole) / h**2
    assert abs(up - down) / (2 * h) < 1e-6 * curvature
    assert np.abs(now.gains[1:]).max() > 0.1
    assert best < about.cost(now.eta, 0.0 * now.gains)


@ENGINES
@pytest.mark.parametrize("w", [0.0, 0.7])
def test_gains_of_a_linear_quadratic_problem_are_the_regulators(compiled, w, mass, expected_stakes):
    problem = mass(walls=False, slip=0.0)  # additive noise: certainty equivalence
    problem.times = np.linspace(0.0, 1.5, 16)  # lqr_gains charges the interval that begins
    posed = pose(model_of(problem), compiled=compiled)
    stakes = expected_stakes(problem, price=0.0, soft=True, feedback=True, w=w, terminal=TERMINAL)
    now, dt = believe(posed, stakes, *wander(posed)), posed.model.dt
    about = Deviations(posed, stakes, now.x, now.c)
    Q = SHAPE + w * np.eye(N)
    end = TERMINAL * np.eye(N) + dt[-1] * Q
    known = lqr_gains(np.array(about.F), np.array(about.B), dt, Q, posed.model.R, end)
    np.testing.assert_allclose(now.gains, known, rtol=1e-10, atol=1e-12)


@ENGINES
def test_gains_where_noise_grows_with_the_state_are_more_than_the_regulators(
    compiled, expected_stakes
):
    """One state, noise σ = b x: Riccati's recursion has b² dt P more, in closed form."""
    b, r, w_end, K = 0.8, 2.0, 30.0, 12
    problem = types.SimpleNamespace(
        start=np.ones(1),
        times=np.linspace(0.0, 1.2, K + 1),
        control_weight=r * np.eye(1),
        drift=lambda t, x, u: 0.3 * x + u,
        diffusion=lambda t, x: b * x[..., None],
        terminal=lambda x: x + 0.0,
    )
    posed = pose(model_of(problem), compiled=compiled)
    stakes = expected_stakes(problem, price=0.0, soft=True, feedback=True, terminal=w_end)
    now = believe(posed, stakes, *wander(posed))
    P = w_end
    for k in range(K - 1, -1, -1):
        h = posed.model.dt[k]
        assert now.P[k, 0, 0] == pytest.approx(P, rel=1e-12)
        gain = -h * P * (1.0 + 0.3 * h) / (h * r + h * h * P)
        assert now.gains[k, 0, 0] == pytest.approx(gain, rel=1e-12)
        P = (1.0 + h * (0.3 + gain)) ** 2 * P + h * r * gain**2 + h * b * b * P


def test_effort_of_the_feedback_is_that_of_simulated_corrections(settled):
    now, about = settled
    rng, paths = np.random.default_rng(9), 200_000
    e = rng.multivariate_normal(np.zeros(N), about.start, size=paths)
    efforts = np.zeros(paths)
    for k, h in enumerate(about.dt):
        v = e @ now.gains[k].T
        efforts += h * np.einsum("ei,ij,ej->e", v, about.R, v)
        e = e @ about.F[k].T + v @ about.B[k].T + about.kicks(rng, k, e)
    predicted = feedback_effort(about.R, about.dt, now.gains, now.Sigma)
    assert abs(predicted - efforts.mean()) < 5.0 * efforts.std() / np.sqrt(paths)
    assert predicted > 0.0


# ------------------------------------------------------------------------------ bounds


@ENGINES
@pytest.mark.parametrize(
    "bounds", [np.array([3.0, 4.0]), np.array([[-1.0, -np.inf], [3.0, 5.0]])], ids=["both", "some"]
)
def test_bounds_leave_room_for_the_correction(compiled, bounds, mass, expected_stakes):
    problem = mass(bounds=bounds, slip=1.5)
    posed = pose(model_of(problem), constraints=True, compiled=compiled)
    model, (x, u) = posed.model, wander(posed)
    for saturation, terminal in ((2.0, 1.0), (3.0, 1.0), (2.0, 1e5)):
        stakes = expected_stakes(problem, price=2.0, soft=True, feedback=True, terminal=terminal)
        now = believe(posed, dataclasses.replace(stakes, saturation=saturation), x, u)
        spread = np.sqrt(np.einsum("kmi,kij,kmj->km", now.gains, now.Sigma[:-1], now.gains))
        width = model.upper - model.lower
        margin = np.minimum(saturation * spread, 0.45 * width)
        np.testing.assert_allclose(now.upper, model.upper - margin, rtol=1e-12)
        np.testing.assert_allclose(now.lower, model.lower + margin, rtol=1e-12)
        assert (now.upper > now.lower).all()
        assert (margin[0] == 0.0).all()  # the start is certain
    assert (saturation * spread > 0.45 * width).any(), "the last case was to be capped"

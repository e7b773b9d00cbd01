"""Covariance, adjoint weights and gains against simulation, differences and Riccati's recursion.

The system is a point mass whose noise grows with its speed, with rows that are affine in the state:
then nothing is neglected, and every relation of :mod:`slipcar.planner.moments.belief` is exact.
"""

import dataclasses
import types

import numpy as np
import pytest

from slipcar.planner.expected import loop
from slipcar.planner.expected.guarded import posed
from slipcar.planner.moments import belief
from slipcar.planner.moments.gains import lqr_gains
from slipcar.planner.moments.losses import deviations, loss
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.model import evaluate

N, M = 4, 2


def mass(bounds=None, slip=0.4, curved=True, walls=True):
    """State (p_x, p_y, v_x, v_y); uneven grid; a wall with a cost and a wall with a price."""
    shape = np.diag([0.2, 0.1, 0.4, 0.3]) + 0.05
    gaps = 0.1 * np.array([1.0, 1.4, 0.7, 1.0, 1.2, 0.9, 1.0, 1.1, 0.8, 1.3, 1.0, 1.0])

    def drift(t, x, u):
        return np.concatenate([x[..., 2:], u], axis=-1)

    def diffusion(t, x):
        noise = np.zeros((*x.shape, 2), dtype=x.dtype)
        noise[..., 0, 0], noise[..., 1, 1] = slip * x[..., 3], slip * x[..., 2]
        noise[..., 0, 1] = 0.05
        return noise

    members = {
        "start": np.zeros(N),
        "times": np.concatenate([[0.0], np.cumsum(gaps)]),
        "control_weight": np.array([[1.0, 0.2], [0.2, 0.6]]),
        "drift": drift,
        "diffusion": diffusion,
        "terminal": lambda x: x - np.array([1.0, 0.7, 0.0, 0.0]),
        "control_bounds": bounds,
    }
    if walls:
        members |= {
            "penalty": lambda t, x: x[..., 1:2] - 0.8 * x[..., :1] - 0.02,
            "penalty_weight": np.array([40.0]),
            "constraint": lambda t, x: np.stack([x[..., 0] - 1.15, -0.1 - x[..., 1]], axis=-1),
        }
    if curved:
        members["state_cost"] = lambda t, x: np.einsum("...i,ij,...j", x, shape, x)
    return types.SimpleNamespace(**members), shape


def stakes_of(ready, *, price=2.0, soft=True, feedback=True, w=0.3, damping=0.5, terminal=30.0):
    guarded = ready.guarded
    return Stakes(
        weight=np.where(guarded.is_constraint, price, guarded.penalty_weight),
        tail=guarded.is_constraint,
        terminal=np.full(N, terminal),
        soft=soft,
        feedback=feedback,
        variance_weight=w,
        damping=damping,
    )


@pytest.fixture(scope="module")
def settled():
    """An iterate somewhere, and its belief when weights and gains have found each other."""
    problem, shape = mass()
    ready = posed(problem)
    model = ready.model
    x, u = model.guess()
    stakes = stakes_of(ready)
    functions = ready.functions(x, u, native=False)
    found = loop.iterate(model, functions, stakes, x, u, tolerance=1e-12, max_iterations=200)
    assert found.status.ok
    at = evaluate(model, functions, 0.0, found.x, found.u)
    now = belief.propagate(model, functions, at, stakes, found.gains, None, 1.0)
    for _ in range(200):
        now = belief.propagate(model, functions, at, stakes, now.gains, now.held, 0.5)
    return model, stakes, at, now, shape


def mean_square_noise(model, k, x, S):
    """E σσᵀ where the state has mean x and covariance S: exact, as σ is affine in it."""
    t = model.times[k]
    sigma = model.diffusion(t, x)
    slopes = np.array([model.diffusion(t, x + e) - sigma for e in np.eye(N)])
    return sigma @ sigma.T + np.einsum("iad,ij,jbd->ab", slopes, S, slopes)


def closed_covariance(at, model, gains, extra=None):
    """Σ by the recursion written out; `extra` (K, n, n) is injected on arrival."""
    lin = at.lin
    S = [np.zeros((N, N))]
    for k, dt in enumerate(model.dt):
        F = lin.A[k] + lin.B[k] @ gains[k]
        arrives = dt * mean_square_noise(model, k, lin.x[k], S[k])
        S.append(F @ S[k] @ F.T + arrives + (0.0 if extra is None else extra[k]))
    return np.array(S)


def held_cost(model, stakes, at, held, gains, shape, extra=None):
    """What spread costs with the rows' weights held."""
    lin, dt = at.lin, model.dt
    S = closed_covariance(at, model, gains, extra)
    value = 0.0
    for k in range(len(dt)):
        for o in range(lin.C.shape[1]):
            value += held[k, o] * lin.C[k, o] @ S[k + 1] @ lin.C[k, o]
        value += dt[k] * np.trace((stakes.variance_weight * np.eye(N) + shape) @ S[k + 1])
        value += dt[k] * np.trace(gains[k] @ S[k] @ gains[k].T @ model.R)
    return value + np.trace(np.diag(stakes.terminal) @ lin.G @ S[-1] @ lin.G.T)


def whole_cost(model, stakes, at, gains, shape, extra=None):
    """The same with what rows really cost."""
    none = np.zeros(at.lin.c.shape)
    S = closed_covariance(at, model, gains, extra)
    s = deviations(at.lin.C, S[1:])
    weight = stakes.weight * np.where(stakes.tail, 1.0, model.dt[:, None])
    rows = loss(at.lin.c, s, weight, stakes.tail).value.sum()
    return rows + held_cost(model, stakes, at, none, gains, shape, extra)


def kicks(rng, model, at, k, e):
    """What noise adds on the way from node k: its strength is that where each path is, (P, n)."""
    sigma = model.diffusion(model.times[k], at.lin.x[k] + e)
    drawn = rng.standard_normal((len(e), sigma.shape[-1]))
    return np.sqrt(model.dt[k]) * np.einsum("eid,ed->ei", sigma, drawn)


def test_the_covariance_is_that_of_simulated_deviations(settled):
    model, _, at, now, _ = settled
    rng, paths = np.random.default_rng(0), 200_000
    e = np.zeros((paths, N))
    for k in range(len(model.dt)):
        F = at.lin.A[k] + at.lin.B[k] @ now.gains[k]
        e = e @ F.T + kicks(rng, model, at, k, e)
        S, squares = now.covariance[k + 1], e * e
        # Not Gaussian any more: the standard errors are the paths' own.
        error = np.sqrt((squares.T @ squares / paths - S**2).clip(0.0) / paths)
        assert (np.abs(e.T @ e / paths - S) <= 5.0 * error + 1e-15).all()
    # Without the noise of noisy states it would be another.
    plain = np.zeros((N, N))
    for k, dt in enumerate(model.dt):
        F, sigma = at.lin.A[k] + at.lin.B[k] @ now.gains[k], at.lin.sigma[k]
        plain = F @ plain @ F.T + dt * sigma @ sigma.T
    assert (np.abs(plain - S) > 10.0 * error).any()
    # And to rounding, by the recursion itself.
    np.testing.assert_allclose(
        now.covariance, closed_covariance(at, model, now.gains), atol=1e-15, rtol=1e-12
    )


def test_deviations_of_rows_are_those_of_the_closed_loop(settled):
    _, _, at, now, _ = settled
    np.testing.assert_allclose(now.s, deviations(at.lin.C, now.covariance[1:]), rtol=1e-12)


def test_weights_are_the_derivative_by_the_noise_that_arrives(settled):
    """P at node k+1 is ∂cost/∂(noise injected there): with weights held, and of the whole.

    Noise that arrives makes later noise larger: that is in the derivative.
    """
    model, stakes, at, now, shape = settled
    rng = np.random.default_rng(3)
    # At a fixed point the weights that are held are those the spread asks for.
    wanted = belief.loss_at(model, stakes, at.lin.c, now.s).by_variance
    # (None is held below 1e-9 of the largest.)
    np.testing.assert_allclose(now.held, wanted, rtol=1e-6, atol=2e-9 * wanted.max())
    for k in range(len(model.dt)):
        F = rng.normal(size=(N, 2))
        extra, h = np.zeros((len(model.dt), N, N)), 1e-6
        extra[k] = h * F @ F.T
        predicted = np.trace(now.P[k] @ F @ F.T)
        for cost in (
            lambda e: held_cost(model, stakes, at, now.held, now.gains, shape, e),
            lambda e: whole_cost(model, stakes, at, now.gains, shape, e),
        ):
            slope = (cost(extra) - cost(-extra)) / (2 * h)
            assert slope == pytest.approx(predicted, rel=2e-5)


def test_the_noise_costs_its_trace_against_the_weights(settled):
    model, stakes, at, now, shape = settled
    value = sum(
        dt * np.trace(P @ sigma @ sigma.T)
        for dt, P, sigma in zip(model.dt, now.P, at.lin.sigma, strict=True)
    )
    assert value == pytest.approx(
        held_cost(model, stakes, at, now.held, now.gains, shape), rel=1e-12
    )
    assert now.noise.value == pytest.approx(value, rel=1e-12)


def test_the_noise_is_a_quadratic_with_the_right_slope(settled):
    """Of Σ dt tr(P σσᵀ) in the states, P held; exact here, where σ is affine."""
    model, _, at, now, _ = settled
    rng = np.random.default_rng(4)

    def cost(x):
        sigma = model.diffusion(model.times[:-1], x)
        return np.einsum("k,kij,kid,kjd", model.dt, now.P, sigma, sigma)

    x = at.lin.x[:-1]
    for _ in range(5):
        d = rng.normal(size=x.shape)
        model_value = (
            now.noise.value
            + np.vdot(now.noise.gradient, d)
            + 0.5 * np.einsum("ki,kij,kj", d, now.noise.hessian, d)
        )
        assert cost(x + d) == pytest.approx(model_value, rel=1e-10)


def test_no_gains_are_better(settled):
    model, stakes, at, now, shape = settled
    rng = np.random.default_rng(5)
    best = held_cost(model, stakes, at, now.held, now.gains, shape)
    whole = whole_cost(model, stakes, at, now.gains, shape)
    for size in (1e-3, 0.1, 1.0):
        for _ in range(10):
            other = now.gains + size * rng.normal(size=now.gains.shape)
            assert held_cost(model, stakes, at, now.held, other, shape) > best
            # A stationary point of the whole, so no better nearby either.
            if size < 0.01:
                assert whole_cost(model, stakes, at, other, shape) > whole
    d, h = rng.normal(size=now.gains.shape), 1e-4
    up = whole_cost(model, stakes, at, now.gains + h * d, shape)
    down = whole_cost(model, stakes, at, now.gains - h * d, shape)
    curvature = (up + down - 2 * whole) / h**2
    assert abs(up - down) / (2 * h) < 1e-6 * curvature
    assert np.abs(now.gains[1:]).max() > 0.1
    assert best < held_cost(model, stakes, at, now.held, 0.0 * now.gains, shape)


def test_open_loop_has_no_gains_but_the_same_weights_by_differences():
    problem, shape = mass()
    ready = posed(problem)
    model = ready.model
    x, u = model.guess()
    rng = np.random.default_rng(6)
    u = u + rng.normal(size=u.shape)
    for k, dt in enumerate(model.dt):
        x[k + 1] = x[k] + dt * model.drift(model.times[k], x[k], u[k])
    functions = ready.functions(x, u, native=False)
    at = evaluate(model, functions, 0.0, x, u)
    stakes = stakes_of(ready, feedback=False, soft=False)
    zero = np.zeros((len(u), M, N))
    now = belief.propagate(model, functions, at, stakes, zero, None, 1.0)
    assert not now.gains.any()
    for k in range(len(u)):
        F, extra = rng.normal(size=(N, 1)), np.zeros((len(u), N, N))
        extra[k] = 1e-6 * F @ F.T
        up, down = (whole_cost(model, stakes, at, zero, shape, e) for e in (extra, -extra))
        tail_above = (at.lin.c[k:, stakes.tail] > -0.5 * now.s[k:, stakes.tail]).any()
        if not tail_above:  # where Φ is no longer what is charged its slope by s is not believed
            assert (up - down) / 2e-6 == pytest.approx(np.trace(now.P[k] @ F @ F.T), rel=1e-4)
    assert (now.lower == -np.inf).all()
    assert (now.upper == np.inf).all()


@pytest.mark.parametrize("w", [0.0, 0.7])
def test_gains_of_a_linear_quadratic_problem_are_the_regulators(w):
    problem, shape = mass(walls=False, slip=0.0)  # additive noise: certainty equivalence
    problem.times = np.linspace(0.0, 1.5, 16)  # lqr_gains charges the interval that begins
    ready = posed(problem)
    model = ready.model
    x, u = model.guess()
    functions = ready.functions(x, u, native=False)
    at = evaluate(model, functions, 0.0, x, u)
    stakes = stakes_of(ready, w=w)
    zero = np.zeros((len(u), M, N))
    now = belief.propagate(model, functions, at, stakes, zero, None, 1.0)
    Q = shape + w * np.eye(N)
    end = np.diag(stakes.terminal) + model.dt[-1] * Q
    known = lqr_gains(at.lin.A, at.lin.B, model.dt, Q, model.R, end)
    np.testing.assert_allclose(now.gains, known, rtol=1e-10, atol=1e-12)


def test_gains_where_noise_grows_with_the_state_are_more_than_the_regulators():
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
    ready = posed(problem)
    model = ready.model
    x, u = model.guess()
    functions = ready.functions(x, u, native=False)
    at = evaluate(model, functions, 0.0, x, u)
    stakes = Stakes(
        weight=np.zeros(0),
        tail=np.zeros(0, dtype=bool),
        terminal=np.full(1, w_end),
        soft=True,
        feedback=True,
        variance_weight=0.0,
    )
    now = belief.propagate(model, functions, at, stakes, np.zeros((K, 1, 1)), None, 1.0)
    P = w_end
    for k in range(K - 1, -1, -1):
        h = model.dt[k]
        assert now.P[k, 0, 0] == pytest.approx(P, rel=1e-12)
        gain = -h * P * (1.0 + 0.3 * h) / (h * r + h * h * P)
        assert now.gains[k, 0, 0] == pytest.approx(gain, rel=1e-12)
        P = (1.0 + h * (0.3 + gain)) ** 2 * P + h * r * gain**2 + h * b * b * P


def test_damping_mixes_weights_of_tails_by_their_logarithms(settled):
    model, stakes, at, now, _ = settled
    problem, _ = mass()
    ready = posed(problem)
    functions = ready.functions(at.lin.x, at.lin.u, native=False)
    zero = np.zeros_like(now.gains)
    fresh = belief.propagate(model, functions, at, stakes, zero, None, 1.0).held
    before = 3.0 * fresh + 1e-3
    for damping in (0.25, 1.0):
        held = belief.propagate(model, functions, at, stakes, zero, before, damping).held
        tails = before[:, stakes.tail] ** (1 - damping) * fresh[:, stakes.tail] ** damping
        big = fresh[:, stakes.tail] > 1e-6 * fresh.max()
        np.testing.assert_allclose(held[:, stakes.tail][big], tails[big], rtol=1e-9)
        # Penalties are not exponential: nothing is mixed.
        np.testing.assert_allclose(held[:, ~stakes.tail], fresh[:, ~stakes.tail], rtol=1e-12)


def test_bounds_leave_room_for_the_correction():
    problem, _ = mass(bounds=np.array([3.0, 4.0]), slip=1.5)
    ready = posed(problem)
    model = ready.model
    x, u = model.guess()
    u = u + 1.5
    for k, dt in enumerate(model.dt):
        x[k + 1] = x[k] + dt * model.drift(model.times[k], x[k], u[k])
    functions = ready.functions(x, u, native=False)
    at = evaluate(model, functions, 0.0, x, u)
    zero = np.zeros((len(u), M, N))
    for saturation, terminal in ((2.0, 1.0), (3.0, 1.0), (2.0, 1e5)):
        stakes = stakes_of(ready, terminal=terminal)
        stakes = dataclasses.replace(stakes, saturation=saturation)
        now = belief.propagate(model, functions, at, stakes, zero, None, 1.0)
        spread = np.sqrt(np.einsum("kmi,kij,kmj->km", now.gains, now.covariance[:-1], now.gains))
        width = model.upper - model.lower
        margin = np.minimum(saturation * spread, 0.45 * width)
        np.testing.assert_allclose(now.upper, model.upper - margin, rtol=1e-12)
        np.testing.assert_allclose(now.lower, model.lower + margin, rtol=1e-12)
        assert (now.upper > now.lower).all()
        assert (margin[0] == 0.0).all()  # the start is certain
    assert (saturation * spread > 0.45 * width).any(), "the last case was to be capped"


def test_effort_of_the_feedback_is_that_of_simulated_corrections(settled):
    model, _, at, now, _ = settled
    rng, paths = np.random.default_rng(9), 200_000
    e, efforts = np.zeros((paths, N)), np.zeros(paths)
    for k, dt in enumerate(model.dt):
        v = e @ now.gains[k].T
        efforts += dt * np.einsum("ei,ij,ej->e", v, model.R, v)
        e = e @ at.lin.A[k].T + v @ at.lin.B[k].T + kicks(rng, model, at, k, e)
    predicted = belief.feedback_effort(model, now.gains, now.covariance)
    assert abs(predicted - efforts.mean()) < 5.0 * efforts.std() / np.sqrt(paths)
    assert predicted > 0.0

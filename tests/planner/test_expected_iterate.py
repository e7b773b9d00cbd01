"""The iteration on expected costs: is what it settles at stationary, and the same on every path?

The reference is a single shooting written here: rollout, closed-loop covariance, rows and ends of
the non-linear problem, as a function of controls and gains alone.
"""

import dataclasses
import importlib.util
import types

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status, plan
from slipcar.planner.derivatives import complex_step_jacobian
from slipcar.planner.expected import loop
from slipcar.planner.expected.field import expected_cost, priced, value
from slipcar.planner.expected.guarded import posed
from slipcar.planner.expected.losses import loss
from slipcar.planner.expected.stakes import Stakes

NUMBA = importlib.util.find_spec("numba") is not None
needs_numba = pytest.mark.skipif(not NUMBA, reason="needs numba")


# ------------------------------------------------------------------------------ tools


def stakes_of(ready, *, price, soft, feedback, terminal=None, w=0.0, damping=0.5):
    """What to charge; the end at 100, or at `terminal`, if it is charged at all."""
    guarded = ready.guarded
    q = len(ready.model.terminal(ready.model.start))
    given = 100.0 if soft or feedback else 0.0
    stakes = Stakes(
        weight=guarded.penalty_weight,
        tail=guarded.is_constraint,
        terminal=np.full(q, given if terminal is None else terminal),
        soft=soft,
        feedback=feedback,
        variance_weight=w,
        damping=damping,
    )
    return priced(stakes, price)


def nominal(problem):
    """A plan of the mean, where the iteration begins."""
    found = plan(problem, variance_weight=0.0, compiled=False)
    return found.mean, found.controls


def settle(problem, *, native=False, start=None, warm=None, tolerance=1e-14, limit=300, **asked):
    """(posed problem, stakes, answer)."""
    ready = posed(problem)
    stakes = stakes_of(ready, **asked)
    x, u = nominal(problem) if start is None else start
    functions = ready.functions(x, u, native=native)
    iterate = loop.iterate
    if native:
        from slipcar.planner.expected import run

        assert functions.kernels is not None, functions.reason
        iterate = run.iterate
    found = iterate(
        ready.model, functions, stakes, x, u, tolerance=tolerance, max_iterations=limit, warm=warm
    )
    return ready, stakes, found


class Shooting:
    """The expected cost of controls u (K, m) and gains (K, m, n), from the problem's functions."""

    def __init__(self, ready, stakes, hessian=None):
        self.model, self.stakes, self.hessian = ready.model, stakes, hessian

    def __call__(self, u, gains):
        """Expected cost and g at the end."""
        model, stakes = self.model, self.stakes
        t, dt, n = model.times, model.dt, model.state_dim
        x = np.empty((len(t), n))
        x[0] = model.start
        for k in range(len(dt)):
            x[k + 1] = x[k] + dt[k] * model.drift(t[k], x[k], u[k])
        A, B = model.drift_jacobian(t[:-1], x[:-1], u)
        sigma = model.diffusion(t[:-1], x[:-1])
        S = np.zeros((len(t), n, n))
        for k in range(len(dt)):
            F = np.eye(n) + dt[k] * (A[k] + B[k] @ gains[k])
            S[k + 1] = F @ S[k] @ F.T + dt[k] * sigma[k] @ sigma[k].T
        c, C = model.penalty(t[1:], x[1:]), model.penalty_jacobian(t[1:], x[1:])
        s = np.sqrt(np.einsum("kpi,kij,kpj->kp", C, S[1:], C))
        s = np.maximum(s, 0.02 * s.max(axis=0, initial=0.0) + 1e-9)
        if self.hessian is not None:  # rows' expectations: all that spread does to curved rows
            c = c + 0.5 * np.einsum("kpij,kij->kp", self.hessian(t[1:], x[1:]), S[1:])
        weight = stakes.weight * np.where(stakes.tail, 1.0, dt[:, None])
        total = loss(c, s, weight, stakes.tail).value.sum()
        total += np.einsum("k,ki,ij,kj", dt, u, model.R, u)
        total += np.einsum("k,kmi,kij,klj,lm", dt, gains, S[:-1], gains, model.R)
        if model.state_cost is not None:
            H = model.state_cost_derivatives(t[1:], x[1:])[1]
            total += dt @ model.state_cost(t[1:], x[1:])
            total += 0.5 * np.einsum("k,kij,kij", dt, H, S[1:])
        total += stakes.variance_weight * np.einsum("k,kii", dt, S[1:])
        g, G = model.terminal(x[-1]), model.terminal_jacobian(x[-1])
        total += stakes.terminal @ np.diag(G @ S[-1] @ G.T)
        return total + (stakes.terminal @ (g * g) if stakes.soft else 0.0), g

    def by_controls(self, found, h=1e-6):
        """Gradient (K·m,) and terminal Jacobian (q, K·m) by differences."""
        gradient, J = [], []
        for e in np.eye(found.u.size).reshape(-1, *found.u.shape):
            up, g_up = self(found.u + h * e, found.gains)
            down, g_down = self(found.u - h * e, found.gains)
            gradient.append((up - down) / (2 * h))
            J.append((g_up - g_down) / (2 * h))
        return np.array(gradient), np.array(J).T


def tangential(gradient, J):
    """The part of a gradient along which the end stays where it is."""
    return gradient - J.T @ np.linalg.lstsq(J.T, gradient, rcond=None)[0]


def row_hessian(model):
    """∂²c/∂x² by differences of the Jacobian, (K, p, n, n)."""

    def hessian(t, x):
        n, h = x.shape[1], 1e-4
        columns = [
            model.penalty_jacobian(t, x + h * e) - model.penalty_jacobian(t, x - h * e)
            for e in np.eye(n)
        ]
        return np.stack(columns, axis=-1) / (2 * h)

    return hessian


def mass(*, bounds=None, slip=0.4, walls=True, curved=True, additive=0.05, nodes=13):
    """A point mass (p, v) whose noise grows with its speed, between affine rows, unevenly timed."""
    shape = np.diag([0.2, 0.1, 0.4, 0.3]) + 0.05
    gaps = 0.1 * (1.0 + 0.3 * np.sin(3.0 * np.arange(nodes - 1)))

    def diffusion(t, x):
        noise = np.zeros((*x.shape, 2), dtype=x.dtype)
        noise[..., 0, 0], noise[..., 1, 1] = slip * x[..., 3], slip * x[..., 2]
        noise[..., 0, 1] = additive
        return noise

    members = {
        "start": np.array([0.0, 0.0, 0.1, -0.1]),
        "times": np.concatenate([[0.0], np.cumsum(gaps)]),
        "control_weight": np.array([[1.0, 0.2], [0.2, 0.6]]),
        "drift": lambda t, x, u: np.concatenate([x[..., 2:], u], axis=-1),
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
    return types.SimpleNamespace(**members)


# ------------------------------------------------------------------------------ stationarity

KINDS = {
    "open": {"soft": False, "feedback": False, "price": 0.0},
    "open priced": {"soft": False, "feedback": False, "price": 3.0},
    "soft priced": {"soft": True, "feedback": False, "price": 3.0},
    "feedback": {"soft": True, "feedback": True, "price": 0.0},
    "feedback priced": {"soft": True, "feedback": True, "price": 3.0},
    "feedback exact": {"soft": False, "feedback": True, "price": 3.0},
    "spread": {"soft": False, "feedback": False, "price": 1.0, "w": 2.0},
}


@pytest.mark.parametrize("kind", KINDS)
def test_where_nothing_is_neglected_the_expected_cost_is_stationary(kind):
    """Affine dynamics and rows: zero slope in the controls and in the gains, to differences."""
    ready, stakes, found = settle(mass(), tolerance=1e-18, **KINDS[kind])
    assert found.status is Status.CONVERGED
    shooting = Shooting(ready, stakes)
    cost, g = shooting(found.u, found.gains)
    assert value(ready.model, stakes, found) == pytest.approx(cost, rel=1e-9)
    gradient, J = shooting.by_controls(found)
    if not stakes.soft:
        np.testing.assert_allclose(g, 0.0, atol=1e-9)
        gradient = tangential(gradient, J)
    scale = np.linalg.norm(2.0 * ready.model.dt[:, None] * found.u @ ready.model.R)
    assert np.linalg.norm(gradient) < 2e-5 * scale
    if stakes.feedback:
        rng = np.random.default_rng(0)
        for _ in range(5):
            d = rng.normal(size=found.gains.shape)
            costs = [shooting(found.u, found.gains + h * d)[0] for h in (1e-4, -1e-4)]
            assert abs(costs[0] - costs[1]) / 2e-4 < 1e-5 * scale
            assert min(costs) > cost
    else:
        assert not found.gains.any()


@pytest.mark.parametrize(
    "kind",
    [
        {"soft": False, "feedback": False, "price": 0.0},
        {"soft": False, "feedback": False, "price": 30.0},
        {"soft": True, "feedback": True, "price": 30.0},
    ],
    ids=["open", "open priced", "feedback priced"],
)
def test_what_is_neglected_on_the_paper_case_is_worth_next_to_nothing(paper, kind):
    """How ∂b/∂x and the rows turn is left out: a Newton step along what remains gains < 0.2 %."""
    ready, stakes, found = settle(paper, **kind)
    assert found.status is Status.CONVERGED
    shooting = Shooting(ready, stakes, row_hessian(ready.model))
    cost, g = shooting(found.u, found.gains)
    assert value(ready.model, stakes, found) == pytest.approx(cost, rel=1e-6)
    gradient, J = shooting.by_controls(found)
    # The curvature of effort and end alone: less than there is, so the gain is an upper estimate.
    curvature = np.repeat(2.0 * ready.model.dt, 2) * np.ones(gradient.size)
    H = np.diag(curvature)
    if stakes.soft:
        H += 2.0 * J.T @ (stakes.terminal[:, None] * J)
    else:
        np.testing.assert_allclose(g, 0.0, atol=1e-6)
        gradient = tangential(gradient, J)
    gain = 0.5 * gradient @ np.linalg.solve(H, gradient)
    assert gain < 2e-3 * cost
    # The plan of the mean is another matter.
    x, u = nominal(paper)
    before = dataclasses.replace(found, x=x, u=u)
    slope, J = shooting.by_controls(before)
    if not stakes.soft:
        slope = tangential(slope, J)
    assert 0.5 * slope @ np.linalg.solve(H, slope) > 5.0 * gain
    assert shooting(u, found.gains)[0] > cost


def test_a_dearer_risk_is_a_smaller_one_and_costs_more():
    known = None
    before = (np.inf, -np.inf)
    for price in (0.0, 0.3, 1.0, 3.0, 10.0, 100.0):
        ready, stakes, found = settle(mass(), soft=True, feedback=True, price=price)
        assert found.status.ok
        cost = expected_cost(ready.model, stakes, found)
        # Optimality at two prices implies both, for global optima of the same objective.
        assert cost.risk <= before[0] * (1.0 + 1e-3)
        assert cost.total >= before[1] * (1.0 - 1e-6)
        before = (cost.risk, cost.total)
        known = known or before
    assert before[0] < 0.1 * known[0]


# ------------------------------------------------------------------------------ closed forms


def additive(*, nodes=16):
    """A linear system with a quadratic cost and additive noise; the end at the origin."""
    problem = mass(walls=False, slip=0.0, nodes=nodes)
    problem.terminal = lambda x: 1.0 * x
    problem.start = np.array([1.0, -0.5, 0.3, 0.8])
    return problem


@pytest.mark.parametrize("feedback", [True, False])
def test_additive_noise_leaves_the_regulators_mean(feedback):
    """Certainty equivalence, E J = x₀ᵀP₀x₀ + Σ dt tr(Pσσᵀ), and the same by simulation."""
    ready, stakes, found = settle(additive(), soft=True, feedback=feedback, price=0.0)
    assert found.status.ok
    model = ready.model
    dt, t, n = model.dt, model.times, 4
    A, B = model.drift_jacobian(t[:-1], found.x[:-1], found.u)
    sigma, shape = model.diffusion(t[:-1], found.x[:-1]), np.diag([0.2, 0.1, 0.4, 0.3]) + 0.05
    # Riccati's recursion written out, H charged at nodes 1..K with the dt that ends there.
    V = dt[-1] * shape + np.diag(stakes.terminal)
    W = V.copy()  # of deviations
    laws, noise = [None] * len(dt), 0.0
    for k in range(len(dt) - 1, -1, -1):
        noise += dt[k] * np.trace(W @ sigma[k] @ sigma[k].T)
        F, G = np.eye(n) + dt[k] * A[k], dt[k] * B[k]
        laws[k] = -np.linalg.solve(dt[k] * model.R + G.T @ V @ G, G.T @ V @ F)
        closed = F + G @ laws[k]
        here = dt[k - 1] * shape if k else 0.0
        V = closed.T @ V @ closed + dt[k] * laws[k].T @ model.R @ laws[k] + here
        W = V if feedback else F.T @ W @ F + here
    x = model.start
    for k, law in enumerate(laws):
        np.testing.assert_allclose(found.u[k], law @ x, atol=1e-7)
        np.testing.assert_allclose(found.gains[k], law if feedback else 0.0, atol=1e-9)
        x = x + dt[k] * model.drift(t[k], x, found.u[k])
    expected = model.start @ V @ model.start + noise
    assert value(model, stakes, found) == pytest.approx(expected, rel=1e-9)
    total = expected_cost(model, stakes, found).total
    assert total == pytest.approx(expected, rel=1e-9)
    # By simulation.
    rng, paths = np.random.default_rng(1), 100_000
    x, costs = np.tile(model.start, (paths, 1)), np.zeros(paths)
    for k in range(len(dt)):
        u = found.u[k] + (x - found.x[k]) @ found.gains[k].T
        costs += dt[k] * np.einsum("ei,ij,ej->e", u, model.R, u)
        x = x + dt[k] * model.drift(t[k], x, u)
        x += np.sqrt(dt[k]) * rng.standard_normal((paths, 2)) @ sigma[k].T
        costs += dt[k] * np.einsum("ei,ij,ej->e", x, shape, x)
    costs += np.einsum("ei,i,ei->e", x, stakes.terminal, x)
    assert abs(costs.mean() - total) < 5.0 * costs.std() / np.sqrt(paths)


def test_least_effort_to_an_exact_end_is_the_least_norm_solution():
    problem = mass(walls=False, slip=0.0, curved=False)
    ready, _, found = settle(problem, soft=False, feedback=False, price=0.0)
    model = ready.model
    K, m, n = len(model.dt), 2, 4
    A, B = model.drift_jacobian(model.times[:-1], found.x[:-1], found.u)
    reach, free = np.zeros((n, K * m)), model.start
    for k in range(K):
        F = np.eye(n) + model.dt[k] * A[k]
        reach, free = F @ reach, F @ free
        reach[:, k * m : (k + 1) * m] = model.dt[k] * B[k]
    weight = np.linalg.inv(np.kron(np.diag(model.dt), model.R))
    goal = -model.terminal(np.zeros(n))
    u = weight @ reach.T @ np.linalg.solve(reach @ weight @ reach.T, goal - free)
    np.testing.assert_allclose(found.u, u.reshape(K, m), atol=1e-8)


def test_multipliers_at_a_solution_are_the_marginal_cost_of_the_end():
    """Moving the goal by g changes the least expected cost by νᵀg (or by 2Wg where it is soft)."""
    problem, h = mass(), 1e-5
    goal = np.array([1.0, 0.7, 0.0, 0.0])
    start = nominal(problem)
    asked = {"soft": False, "feedback": False, "price": 2.0, "tolerance": 1e-18, "start": start}
    _, _, found = settle(problem, **asked)
    for i in range(4):
        costs = []
        for sign in (1.0, -1.0):
            moved = mass()
            to = goal + sign * h * np.eye(4)[i]
            moved.terminal = lambda x, to=to: x - to
            ready, stakes, there = settle(moved, **asked)
            costs.append(value(ready.model, stakes, there))
        # L = J + νᵀg with g = x − goal: dJ/dgoal = −ν.
        assert (costs[0] - costs[1]) / (2 * h) == pytest.approx(-found.terminal[i], rel=1e-3)


# ------------------------------------------------------------------------------ bounds


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("factor", [0.97, 0.85, 0.75])
def test_bounds_are_respected_and_those_that_bind_are_worth_it(feedback, factor):
    asked = {"soft": True, "feedback": feedback, "price": 1.0, "terminal": 30.0}
    _, _, free = settle(mass(), **asked)
    bound = factor * np.abs(free.u).max(axis=0)
    ready, stakes, found = settle(mass(bounds=bound), **asked)
    assert found.status.ok
    assert (np.abs(found.u) <= bound * (1.0 + 1e-9)).all()
    spread = np.einsum("kmi,kij,kmj->km", found.gains, found.covariance[:-1], found.gains)
    margin = np.minimum(2.0 * np.sqrt(spread), 0.9 * bound)
    assert (np.abs(found.u) <= bound - margin + 1e-6 * bound).all()
    at_bound = np.abs(found.u) >= bound - margin - 1e-6 * bound
    assert at_bound.any()
    gradient, _ = Shooting(ready, stakes).by_controls(found)
    gradient = gradient.reshape(found.u.shape)
    scale = np.linalg.norm(2.0 * ready.model.dt[:, None] * free.u)
    # Where no bound binds the slope vanishes; where one does it points outwards.
    assert np.abs(gradient[~at_bound]).max() < 1e-4 * scale
    assert (gradient * np.sign(found.u))[at_bound].max() < 1e-4 * scale


# ------------------------------------------------------------------------------ paths


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
def test_compiled_steps_are_those_of_numpy_on_the_paper_case(paper, kind):
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
def test_compiled_steps_are_those_of_numpy_in_random_worlds(seed):
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
@pytest.mark.parametrize("kind", KINDS)
def test_compiled_steps_are_those_of_numpy_for_a_traced_problem(kind):
    problem = mass()
    start = nominal(problem)
    asked = {"start": start, "tolerance": 1e-8, **KINDS[kind]}
    _, _, slow = settle(problem, **asked)
    _, _, fast = settle(problem, native=True, **asked)
    _same(fast, slow, atol=1e-7)


@needs_numba
@pytest.mark.parametrize("feedback", [False, True])
def test_compiled_steps_are_those_of_numpy_at_bounds(feedback):
    asked = {"soft": True, "feedback": feedback, "price": 1.0, "terminal": 30.0, "tolerance": 1e-8}
    _, _, free = settle(mass(), **asked)
    problem = mass(bounds=0.9 * np.abs(free.u).max(axis=0))
    asked["start"] = nominal(problem)
    _, _, slow = settle(problem, **asked)
    _, _, fast = settle(problem, native=True, **asked)
    _same(fast, slow, atol=1e-7)


def test_a_warm_start_at_a_solution_stays_there(paper):
    asked = {"soft": True, "feedback": True, "price": 10.0}
    _, _, found = settle(paper, tolerance=1e-14, **asked)
    _, _, again = settle(paper, tolerance=1e-8, start=(found.x, found.u), warm=found, **asked)
    assert again.status.ok
    assert again.iterations <= 3
    np.testing.assert_allclose(again.u, found.u, atol=1e-4)


def test_a_solution_does_not_depend_on_damping_or_on_where_it_came_from():
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


def test_a_guess_where_the_model_is_not_finite_is_refused():
    problem = mass()
    ready = posed(problem)
    x, u = ready.model.guess()
    functions = ready.functions(x, u, native=False)
    x = x.copy()
    x[3] = np.nan
    stakes = stakes_of(ready, soft=True, feedback=True, price=1.0)
    with pytest.raises(ValueError, match="finite"):
        loop.iterate(
            ready.model, functions, stakes, x, u, tolerance=1e-6, max_iterations=5, warm=None
        )


def test_rows_of_both_kinds_are_kept_apart(paper):
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

"""The iteration on expected costs: is what it settles at stationary, and within bounds?

The reference is a single shooting written here: rollout, closed-loop covariance, rows and ends of
the non-linear problem, as a function of controls and gains alone.
"""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.stats import norm

from slipcar.planner import Status
from slipcar.planner.moments.losses import loss
from slipcar.planner.newton.posing import pose
from slipcar.planner.newton.running import solve_noise
from slipcar.planner.problem.model import model_of
from slipcar.planner.search.field import charged, expected_cost

# ------------------------------------------------------------------------------ tools


class Shooting:
    """The expected cost of controls u (K, m) and gains (K, m, n), from the problem's functions.

    Rows are the penalties and, where they have a price, the constraints; they are taken to be
    affine unless `curved`.
    """

    def __init__(self, posed, stakes, curved=False):
        self.model, self.stakes, self.curved = posed.model, stakes, curved
        self.names = [("penalty", stakes.penalties, False)] if len(stakes.penalties) else []
        if stakes.price > 0.0:
            price = np.full(stakes.constraints, stakes.price)
            self.names.append(("constraint", price, True))

    def __call__(self, u, gains):
        """Expected cost and g at the end."""
        model, stakes = self.model, self.stakes
        t, dt, n = model.times, model.dt, model.state_dim
        x = np.empty((len(t), n))
        x[0] = model.start
        for k in range(len(dt)):
            x[k + 1] = x[k] + dt[k] * model.drift(t[k], x[k], u[k])
        A, B = model.drift_jacobian(t[:-1], x[:-1], u)
        sigma, slopes = model.diffusion(t[:-1], x[:-1]), self.slopes(t[:-1], x[:-1])
        S = np.zeros((len(t), n, n))
        S[0] = getattr(model.problem, "start_covariance", 0.0)
        for k in range(len(dt)):
            F = np.eye(n) + dt[k] * (A[k] + B[k] @ gains[k])
            spread = np.einsum("iad,ij,jbd->ab", slopes[:, k], S[k], slopes[:, k])
            S[k + 1] = F @ S[k] @ F.T + dt[k] * (sigma[k] @ sigma[k].T + spread)
        total = sum(self.rows(*row, x, S) for row in self.names)
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

    def rows(self, name, weight, tail, x, S):
        """What the rows of one function are charged."""
        t, dt, n, h = self.model.times[1:], self.model.dt, x.shape[1], 1e-4

        def slopes(y):
            return self.model.jacobians.state(name, t, y)

        c, C = getattr(self.model.problem, name)(t, x[1:]), slopes(x[1:])
        s = np.sqrt(np.einsum("kpi,kij,kpj->kp", C, S[1:], C))
        s = np.maximum(s, 0.02 * s.max(axis=0, initial=0.0) + 1e-9)
        if self.curved:  # rows' expectations: all that spread does to curved rows
            bend = [(slopes(x[1:] + h * e) - slopes(x[1:] - h * e)) / (2 * h) for e in np.eye(n)]
            c = c + 0.5 * np.einsum("jkpi,kij->kp", np.array(bend), S[1:])
        per_node = weight if tail else dt[:, None] * weight
        return loss(c, s, per_node, np.full(len(weight), tail)).value.sum()

    def slopes(self, t, x):
        """σ's columns by each state, (n, K, n, d): exact, as it is affine in each by itself."""
        sigma = self.model.diffusion
        return np.array([0.5 * (sigma(t, x + e) - sigma(t, x - e)) for e in np.eye(x.shape[1])])

    def by_controls(self, answer, h=1e-6):
        """Gradient (K·m,) and terminal Jacobian (q, K·m) by differences."""
        gradient, J = [], []
        for e in np.eye(answer.u.size).reshape(-1, *answer.u.shape):
            up, g_up = self(answer.u + h * e, answer.gains)
            down, g_down = self(answer.u - h * e, answer.gains)
            gradient.append((up - down) / (2 * h))
            J.append((g_up - g_down) / (2 * h))
        return np.array(gradient), np.array(J).T


def tangential(gradient, J):
    """The part of a gradient along which the end stays where it is."""
    return gradient - J.T @ np.linalg.lstsq(J.T, gradient, rcond=None)[0]


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


@pytest.mark.parametrize(
    ("kind", "spread"),
    [*((kind, 0.0) for kind in KINDS), ("open priced", 0.15), ("feedback priced", 0.15)],
)
def test_where_nothing_is_neglected_the_expected_cost_is_stationary(kind, spread, settle, mass):
    """Affine dynamics and rows: zero slope in the controls and in the gains, to differences."""
    posed, stakes, answer = settle(mass(spread=spread), tolerance=1e-18, **KINDS[kind])
    assert answer.status is Status.CONVERGED
    shooting = Shooting(posed, stakes)
    cost, g = shooting(answer.u, answer.gains)
    assert charged(posed.model, stakes, answer) == pytest.approx(cost, rel=1e-9)
    gradient, J = shooting.by_controls(answer)
    if not stakes.soft:
        np.testing.assert_allclose(g, 0.0, atol=1e-9)
        gradient = tangential(gradient, J)
    scale = np.linalg.norm(2.0 * posed.model.dt[:, None] * answer.u @ posed.model.R)
    assert np.linalg.norm(gradient) < 2e-5 * scale
    if stakes.feedback:
        rng = np.random.default_rng(0)
        for _ in range(5):
            d = rng.normal(size=answer.gains.shape)
            costs = [shooting(answer.u, answer.gains + h * d)[0] for h in (1e-4, -1e-4)]
            assert abs(costs[0] - costs[1]) / 2e-4 < 1e-5 * scale
            assert min(costs) > cost
    else:
        assert not answer.gains.any()


@pytest.mark.parametrize(
    "kind",
    [
        {"soft": False, "feedback": False, "price": 0.0},
        {"soft": False, "feedback": False, "price": 30.0},
        {"soft": True, "feedback": True, "price": 30.0},
    ],
    ids=["open", "open priced", "feedback priced"],
)
def test_what_is_neglected_on_the_paper_case_is_worth_next_to_nothing(paper, kind, settle, nominal):
    """How ∂b/∂x and the rows turn is left out: a Newton step along what remains gains < 0.2 %."""
    posed, stakes, answer = settle(paper, **kind)
    assert answer.status is Status.CONVERGED
    shooting = Shooting(posed, stakes, curved=True)
    cost, g = shooting(answer.u, answer.gains)
    assert charged(posed.model, stakes, answer) == pytest.approx(cost, rel=1e-6)
    gradient, J = shooting.by_controls(answer)
    # The curvature of effort and end alone: less than there is, so the gain is an upper estimate.
    curvature = np.repeat(2.0 * posed.model.dt, 2) * np.ones(gradient.size)
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
    before = dataclasses.replace(answer, x=x, u=u)
    slope, J = shooting.by_controls(before)
    if not stakes.soft:
        slope = tangential(slope, J)
    assert 0.5 * slope @ np.linalg.solve(H, slope) > 5.0 * gain
    assert shooting(u, answer.gains)[0] > cost


def test_a_dearer_risk_is_a_smaller_one_and_costs_more(settle, mass):
    problem = mass()
    guarded = pose(model_of(problem), constraints=True)
    risks, costs = [], []
    for price in (0.0, 0.3, 1.0, 3.0, 10.0, 100.0):
        posed, stakes, answer = settle(problem, soft=True, feedback=True, price=price)
        assert answer.status.ok
        c, s = guarded.row_moments(answer.x, answer.covariance)
        risks.append(norm.cdf(c[:, 1:] / s[:, 1:]).sum())  # after the one penalty
        costs.append(expected_cost(posed.model, stakes, answer).total)
    # Optimality at two prices implies both, for global optima of the same objective.
    for before, after in itertools.pairwise(risks):
        assert after <= before * (1.0 + 1e-3)
    for before, after in itertools.pairwise(costs):
        assert after >= before * (1.0 - 1e-6)
    assert risks[-1] < 0.1 * risks[0]


# ------------------------------------------------------------------------------ bounds


def room(answer, bound, saturation):
    """Bounds ±bound (m,) less what the correction by an answer's gains needs of them, (K, m)."""
    S = answer.covariance[:-1]
    spread = np.sqrt(np.einsum("kmi,kij,kmj->km", answer.gains, S, answer.gains))
    return bound - np.minimum(saturation * spread, 0.9 * bound)


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("factor", [0.97, 0.85, 0.75])
def test_bounds_are_respected_and_those_that_bind_are_worth_it(feedback, factor, settle, mass):
    asked = {"soft": True, "feedback": feedback, "price": 1.0, "terminal": 30.0, "tolerance": 1e-18}
    _, _, free = settle(mass(), **asked)
    bound = factor * np.abs(free.u).max(axis=0)
    posed, stakes, answer = settle(mass(bounds=bound), **asked)
    assert answer.status.ok
    # The last step is confined to the bounds of the gains that it was computed with ...
    _, _, before = settle(mass(bounds=bound), limit=answer.iterations - 1, **asked)
    limits = room(before, bound, stakes.saturation)
    assert (np.abs(answer.u) <= limits * (1.0 + 1e-12)).all()
    # ... which have settled, so those of the answer's own gains are as good as met.
    limits = room(answer, bound, stakes.saturation)
    assert (np.abs(answer.u) <= limits + 1e-8 * bound).all()
    assert (limits[1:] < bound).all() == feedback
    at_bound = np.abs(answer.u) >= limits - 1e-8 * bound
    assert at_bound.any()
    assert not at_bound.all()
    gradient, _ = Shooting(posed, stakes).by_controls(answer)
    gradient = gradient.reshape(answer.u.shape)
    scale = np.linalg.norm(2.0 * posed.model.dt[:, None] * free.u)
    # Where no bound binds the slope vanishes; where one does it points outwards.
    assert np.abs(gradient[~at_bound]).max() < 1e-4 * scale
    outwards = -(gradient * np.sign(answer.u))[at_bound]
    assert outwards.min() > -1e-4 * scale
    assert outwards.max() > 1e-2 * scale


def test_bounds_follow_saturation(mass, nominal, expected_stakes):
    """More deviations of room for the correction: nearer to zero, and dearer."""
    costs, bound = [], np.array([2.0, 2.4])
    problem = mass(bounds=bound)
    posed, start = pose(model_of(problem), constraints=True), nominal(problem)
    for saturation in (0.0, 0.5, 1.0):
        stakes = expected_stakes(problem, price=1.0, soft=True, feedback=True, terminal=30.0)
        stakes = dataclasses.replace(stakes, saturation=saturation)
        answer = solve_noise(posed, stakes, *start, tolerance=1e-16, max_iterations=300)
        assert answer.status.ok
        limits = room(answer, bound, saturation)
        assert (np.abs(answer.u) <= limits + 1e-7).all()
        assert (np.abs(answer.u) >= limits - 1e-7).any()
        costs.append(charged(posed.model, stakes, answer))
    assert costs[0] < costs[1] < costs[2]


@pytest.mark.parametrize("feedback", [False, True])
def test_controls_of_a_guess_outside_the_bounds_are_confined_first(feedback, settle, mass, nominal):
    bound = np.array([2.5, 3.0])
    problem = mass(bounds=bound)
    asked = {"soft": True, "feedback": feedback, "price": 1.0, "terminal": 30.0}
    x, u = nominal(problem)
    _, _, known = settle(problem, start=(x, u), **asked)
    outside = np.where(np.arange(u.size).reshape(u.shape) % 2, 3.0, -3.0) * bound
    _, _, one = settle(problem, start=(x, outside), limit=1, **asked)
    assert (np.abs(one.u) <= bound).all()
    _, _, answer = settle(problem, start=(x, outside), **asked)
    assert answer.status is Status.CONVERGED
    np.testing.assert_allclose(answer.u, known.u, atol=1e-5)


# ------------------------------------------------------------------------------ where it begins


def test_a_warm_start_at_a_solution_stays_there(paper, settle):
    asked = {"soft": True, "feedback": True, "price": 10.0}
    _, _, answer = settle(paper, tolerance=1e-14, **asked)
    _, _, again = settle(paper, tolerance=1e-8, start=(answer.x, answer.u), warm=answer, **asked)
    assert again.status.ok
    assert again.iterations <= 3
    np.testing.assert_allclose(again.u, answer.u, atol=1e-4)


def test_a_solution_does_not_depend_on_renewal_or_on_where_it_came_from(settle, mass):
    answers = []
    for renewal, price in ((0.3, None), (0.7, None), (0.5, 30.0)):
        warm, start = None, None
        if price is not None:  # by way of another price
            _, _, warm = settle(mass(), soft=True, feedback=True, price=price)
            start = (warm.x, warm.u)
        _, _, answer = settle(
            mass(), soft=True, feedback=True, price=3.0, renewal=renewal, start=start, warm=warm
        )
        assert answer.status.ok
        answers.append(answer)
    for other in answers[1:]:
        np.testing.assert_allclose(other.u, answers[0].u, atol=1e-5)
        np.testing.assert_allclose(other.gains, answers[0].gains, atol=1e-4)


@pytest.mark.parametrize("compiled", [None, False])
def test_a_guess_where_a_function_is_not_finite_is_refused(compiled, mass, nominal, settle):
    problem = mass()
    x, u = nominal(problem)
    x = x.copy()
    x[3] = np.nan
    with pytest.raises(ValueError, match="not finite along the guess"):
        settle(problem, start=(x, u), compiled=compiled, soft=True, feedback=True, price=1.0)

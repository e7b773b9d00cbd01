"""A diffusion of noisy states, which the paper's class leaves out: refused only where it matters.

Expected costs and covariances count how σ spreads with the states it depends on.
"""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize

from slipcar.envs import car
from slipcar.planner import Feedback, OpenLoop, RecedingHorizon, Status, plan, plan_batch

# ------------------------------------------------------------------------------ a stock


@dataclasses.dataclass(frozen=True)
class Stock:
    """dx = (u − a x) dt + s x dB: its second moment is known, its noise feeds on itself."""

    decay: float = 0.3
    volatility: float = 0.6
    spread: float = 0.0

    start = np.array([2.0])
    times = np.linspace(0.0, 1.5, 16)
    control_weight = np.array([[0.5]])

    @property
    def start_covariance(self):
        return np.array([[self.spread]])

    def drift(self, t, x, u):
        return u - self.decay * x

    def diffusion(self, t, x):
        return self.volatility * x[..., None]

    def terminal(self, x):
        return x - 1.0

    def state_cost(self, t, x):
        return 1.5 * x[..., 0] ** 2

    def moments(self, u, gains=None):
        """Means and variances at every node, exactly, of u + gains (x − mean)."""
        mean, variance, dt = [2.0], [self.spread], 0.1
        for k in range(15):
            pull = 1.0 + dt * ((0.0 if gains is None else gains[k]) - self.decay)
            square = mean[-1] ** 2 + variance[-1]
            variance.append(pull**2 * variance[-1] + dt * self.volatility**2 * square)
            mean.append(mean[-1] + dt * (u[k] - self.decay * mean[-1]))
        return np.array(mean), np.array(variance)

    def cost(self, u, gains, goal):
        mean, variance = self.moments(u, gains)
        value = 0.1 * (0.5 * u**2 + 1.5 * (mean[1:] ** 2 + variance[1:])).sum()
        value += 0.1 * (0.5 * gains**2 * variance[:-1]).sum()
        return value + goal * ((mean[-1] - 1.0) ** 2 + variance[-1])


@pytest.mark.parametrize("options", [{}, {"compiled": False}, {"method": "convex"}], ids=str)
@pytest.mark.parametrize("spread", [0.0, 0.2])
def test_the_covariance_of_a_plan_of_the_mean_counts_it(options, spread):
    stock = Stock(spread=spread)
    p = plan(stock, variance_weight=0.0, tolerance=1e-12, **options)
    assert p.status is Status.CONVERGED
    mean, variance = stock.moments(p.controls[:, 0])
    np.testing.assert_allclose(p.mean[:, 0], mean, atol=1e-7)
    np.testing.assert_allclose(p.covariance[:, 0, 0], variance, rtol=1e-6)


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("compiled", [None, False])
def test_what_is_expected_is_known_and_least(feedback, compiled):
    """Affine in the state: nothing is neglected, so the plan is the optimum of a known sum."""
    stock, goal = Stock(spread=0.1), 3.0
    options = {"feedback": True} if feedback else {"expected": True}
    p = plan(stock, terminal_weight=goal, tolerance=1e-14, compiled=compiled, **options)
    u = p.controls[:, 0]
    K = p.gains[:, 0, 0] if feedback else np.zeros(15)
    assert p.expected.total == pytest.approx(stock.cost(u, K, goal), rel=1e-9)
    best = minimize(lambda z: stock.cost(z, K, goal), np.zeros(15), options={"gtol": 1e-8})
    np.testing.assert_allclose(u, best.x, atol=1e-5)
    if feedback:
        least = minimize(lambda z: stock.cost(u, z, goal), K, options={"gtol": 1e-8})
        np.testing.assert_allclose(K, least.x, atol=1e-4)
    # Certainty equivalence would miss it by much.
    certain = plan(stock, variance_weight=0.0, guess=p, cold_start="never")
    assert stock.cost(certain.controls[:, 0], K, goal) > 1.02 * best.fun


def test_what_cannot_be_charged_is_refused_with_both_ways_out():
    stock = Stock()
    ways = r"noise → x\[0\].*expected=True.*variance_weight=0"
    for call in (plan, lambda p: plan_batch([p]), lambda p: plan(p, variance_weight=2.0)):
        with pytest.raises(ValueError, match=r"diffusion\[0, 0\] depends on x\[0\].*" + ways):
            call(stock)
    assert plan(stock, variance_weight=0.0).status.ok
    assert plan(stock, expected=True, variance_weight=2.0).status.ok
    assert plan_batch([stock], variance_weight=0.0)[0].status.ok
    with pytest.raises(ValueError, match="depends on"):  # though the object has passed before
        plan(stock)


def test_states_whose_start_is_uncertain_count_as_noisy(paper):
    class Car(Unsteady):
        process = ()

    with pytest.raises(ValueError, match=r"diffusion\[0, 0\] depends on x\[3\].*start → x\[3\]"):
        plan(Car(paper, start_deviation=[0.0, 0.0, 0.0, 0.01, 0.0]))
    elsewhere = plan(Car(paper, start_deviation=[0.05, 0.05, 0.05, 0.0, 0.0]))
    assert elsewhere.status.ok  # neither v nor ω: the slip stays as it was
    assert elsewhere.variance > 1.5 * plan(paper).variance


# ------------------------------------------------------------------------------ the car


class Unsteady:
    """The car, whose motors push unevenly: process noise on v and ω."""

    process = ((3, 0.03), (4, 0.04))

    def __init__(self, scenario, start_deviation=(0.0,) * 5):
        self.scenario = scenario
        self.start_covariance = np.diag(np.square(start_deviation))
        for name in (
            "start", "times", "control_weight", "control_bounds", "drift", "drift_jacobian",
            "terminal", "terminal_weight", "penalty", "penalty_weight", "constraint", "angles",
            "initial_guess", "guesses", "homotopy_class",
        ):  # fmt: skip
            if hasattr(scenario, name):
                setattr(self, name, getattr(scenario, name))

    def diffusion(self, t, x):
        slip = car.diffusion(x, self.scenario.slip)
        process = np.zeros((*x.shape, len(self.process)), dtype=x.dtype)
        for column, (i, deviation) in enumerate(self.process):
            process[..., i, column] = deviation
        return np.concatenate([slip, process], axis=-1)


def drive(problem, controller, paths, seed):
    """States (N, paths, 5), penalty, effort and goal of each path, and whether it collides."""
    rng, t = np.random.default_rng(seed), problem.times
    deviation = np.sqrt(np.diag(problem.start_covariance))
    x = problem.start + deviation * rng.standard_normal((paths, 5))
    states, costs, hit = [x], np.zeros((3, paths)), np.zeros(paths, dtype=bool)
    for k, dt in enumerate(np.diff(t)):
        u = np.broadcast_to(controller.control(t[k], x), (paths, 2))
        costs[0] += dt * (u * u).sum(axis=1)
        noise = rng.standard_normal((paths, 3 + len(problem.process)))
        noise = np.sqrt(dt) * np.einsum("bij,bj->bi", problem.diffusion(t[k], x), noise)
        x = x + dt * car.drift(x, u) + noise
        then = np.full(paths, t[k + 1])
        c = np.maximum(problem.penalty(then, x), 0.0)
        costs[1] += dt * c**2 @ problem.penalty_weight
        hit |= (problem.constraint(then, x) > 0.0).any(axis=1)
        states.append(x)
    costs[2] = problem.terminal(x) ** 2 @ problem.terminal_weight
    return np.array(states), costs.mean(axis=1), hit.mean()


@pytest.mark.parametrize(
    ("options", "player"),
    [
        ({"expected": True, "terminal_weight": 100.0}, OpenLoop),
        ({"feedback": True}, Feedback),
    ],
    ids=["open loop", "feedback"],
)
def test_a_car_with_noise_on_its_speeds_drives_as_expected(paper, options, player):
    problem = Unsteady(paper, start_deviation=[0.02, 0.02, 0.02, 0.02, 0.02])
    p = plan(problem, **options)
    assert p.status is Status.CONVERGED
    states, (effort, penalty, goal), _ = drive(problem, player(p), 20_000, seed=5)
    for k in (1, 15, 40):
        sampled = np.cov(states[k].T)
        size = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
        np.testing.assert_allclose(p.covariance[k] / size, sampled / size, atol=0.06)
    assert p.expected.effort + p.expected.feedback == pytest.approx(effort, rel=0.01)
    assert p.expected.goal == pytest.approx(goal, rel=0.05)
    assert p.expected.total == pytest.approx(effort + penalty + goal, rel=0.03)
    # Slip alone would explain too little of it.
    slip = plan(paper, **options)
    share = np.trace(slip.covariance[20]) / np.trace(p.covariance[20])
    assert share < (0.9 if "feedback" in options else 0.3)


def test_a_risk_is_kept_where_the_speeds_are_noisy(paper):
    problem, delta, paths = Unsteady(paper, start_deviation=[0.03] * 5), 0.02, 20_000
    p = plan(problem, feedback=True, risk=delta, risk_episodes=paths)
    assert p.status is Status.CONVERGED
    assert p.risk.verified <= delta
    hit = drive(problem, Feedback(p), paths, seed=6)[2]
    slack = 4.0 * np.sqrt(delta * (1.0 - delta) / paths)
    assert hit <= delta + slack
    assert abs(hit - p.risk.verified) < 1.5 * slack
    assert p.risk.price == 0.0 or hit > 0.2 * delta


def test_a_receding_horizon_corrects_noise_on_the_speeds(paper):
    """From observed states (x, t)."""
    problem, paths = Unsteady(paper, start_deviation=[0.03] * 5), 128
    controller = RecedingHorizon(problem)
    memory = None

    class Player:
        def control(self, t, x):
            nonlocal memory
            u, memory = controller.predict(np.column_stack([x, np.full(len(x), t)]), memory)
            return u

    _, costs, _ = drive(problem, Player(), paths, seed=7)
    assert controller.failures == 0
    assert costs.sum() < 1.05 * plan(problem, feedback=True).expected.total

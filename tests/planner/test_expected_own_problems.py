"""Risk and feedback for systems that are not the car, judged by a simulation written here."""

import dataclasses
import types

import numpy as np
import pytest

from slipcar.planner import Feedback, OpenLoop, Status, plan
from slipcar.planner.moments.gains import lqr_gains


@dataclasses.dataclass(frozen=True, eq=False)
class Puck:
    """A puck on a plane, pushed; it drifts across its course the faster it goes.

    State (p_x, p_y, v_x, v_y), control (a_x, a_y). A disc stands in the way.
    """

    disc: np.ndarray = dataclasses.field(default_factory=lambda: np.array([1.0, 0.05, 0.3]))
    slip: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.06]))
    reach: np.ndarray = dataclasses.field(default_factory=lambda: np.array([2.0, 0.0]))
    control_bounds: np.ndarray | None = None

    times = np.linspace(0.0, 2.0, 21)
    start = np.zeros(4)
    control_weight = np.eye(2)
    terminal_weight = np.array([50.0, 50.0, 5.0, 5.0])

    def drift(self, t, x, u):
        return np.concatenate([x[..., 2:], u], axis=-1)

    def diffusion(self, t, x):
        slow = 0.02 + 0.0 * x[..., 0]
        rows = [
            np.stack([self.slip * x[..., 3:4], slow[..., None]], axis=-1)[..., 0, :],
            np.stack([self.slip * x[..., 2:3], 0.0 * slow[..., None]], axis=-1)[..., 0, :],
            np.stack([0.0 * slow, 0.0 * slow], axis=-1),
            np.stack([0.0 * slow, 0.0 * slow], axis=-1),
        ]
        return np.stack(rows, axis=-2)

    def terminal(self, x):
        return np.concatenate([x[..., :2] - self.reach, x[..., 2:]], axis=-1)

    def constraint(self, t, x):
        dx, dy = x[..., 0:1] - self.disc[0], x[..., 1:2] - self.disc[1]
        return self.disc[2] - np.sqrt(dx * dx + dy * dy)

    def state_cost(self, t, x):
        return 0.05 * (x[..., 2] ** 2 + x[..., 3] ** 2)

    def initial_guess(self):
        path = np.zeros((len(self.times), 4))
        s = self.times / self.times[-1]
        path[:, 0], path[:, 1] = self.reach[0] * s, -0.6 * np.sin(np.pi * s)
        path[:, 2:] = np.gradient(path[:, :2], self.times, axis=0)
        path[0] = self.start
        return path, np.zeros((len(self.times) - 1, 2))


class TunedPuck(Puck):
    """The same, with numbers that the planner may change without tracing it again."""

    def parameters(self):
        return {"disc": self.disc, "slip": self.slip, "reach": self.reach}

    def with_parameters(self, parameters):
        return dataclasses.replace(self, **parameters)


def simulate(problem, control, paths, seed):
    """Violated (paths,), effort (paths,), states at the end (paths, n); Euler–Maruyama."""
    rng, t = np.random.default_rng(seed), problem.times
    x = np.tile(problem.start, (paths, 1))
    hit, effort = np.zeros(paths, bool), np.zeros(paths)
    for k in range(len(t) - 1):
        dt, now = t[k + 1] - t[k], np.full(paths, t[k])
        u = np.broadcast_to(control(now, x), (paths, len(problem.control_weight)))
        effort += dt * np.einsum("ei,ij,ej->e", u, problem.control_weight, u)
        sigma = problem.diffusion(now, x)
        noise = rng.standard_normal((paths, sigma.shape[-1]))
        x = x + dt * problem.drift(now, x, u)
        x += np.sqrt(dt) * np.einsum("eij,ej->ei", sigma, noise)
        hit |= (problem.constraint(np.full(paths, t[k + 1]), x) > 0.0).any(axis=-1)
    return hit, effort, x


@pytest.mark.parametrize(("kind", "feedback"), [(Puck, True), (TunedPuck, True), (Puck, False)])
def test_a_puck_keeps_clear_of_a_disc_as_often_as_asked(kind, feedback):
    problem, delta, paths = kind(), 0.05, 10_000
    p = plan(problem, risk=delta, feedback=feedback, risk_episodes=paths)
    assert p.status is Status.CONVERGED
    assert p.risk.reached
    controller = Feedback(p) if feedback else OpenLoop(p)
    hit, effort, end = simulate(problem, controller.control, paths, seed=8)
    slack = 4.0 * np.sqrt(delta * (1.0 - delta) / paths)
    assert hit.mean() <= delta + slack
    assert abs(hit.mean() - p.risk.verified) < 1.5 * slack
    # Safety is bought, not given away: the chance constraint binds, or nothing was to pay.
    assert p.risk.price == 0.0 or hit.mean() > 0.2 * delta
    assert p.risk.predicted > 0.8 * hit.mean()
    cost = p.expected
    assert cost.effort + cost.feedback == pytest.approx(effort.mean(), rel=0.02)
    if feedback:
        g = problem.terminal(end)
        goal = (g**2 @ problem.terminal_weight).mean()
        assert cost.goal == pytest.approx(goal, rel=0.1)
    else:
        np.testing.assert_allclose(problem.terminal(p.mean[-1]), 0.0, atol=1e-5)
    # The mean without a price cuts it finer.
    free = plan(problem, risk_price=0.0, feedback=feedback)
    assert free.expected.total <= cost.total * (1.0 + 1e-6)
    assert free.expected.risk >= cost.risk * (1.0 - 1e-6)


def test_a_problem_with_and_without_parameters_is_one_problem():
    plans = [plan(kind(), risk_price=3.0, feedback=True) for kind in (Puck, TunedPuck)]
    np.testing.assert_allclose(plans[0].controls, plans[1].controls, atol=1e-6)
    np.testing.assert_allclose(plans[0].gains, plans[1].gains, atol=1e-5)
    # Other numbers, not those of the trace before.
    moved = np.array([1.0, 0.25, 0.3])
    others = [plan(kind(disc=moved), risk_price=3.0, feedback=True) for kind in (Puck, TunedPuck)]
    np.testing.assert_allclose(others[0].controls, others[1].controls, atol=1e-6)
    assert np.abs(others[1].controls - plans[1].controls).max() > 0.01


@pytest.mark.parametrize("feedback", [False, True])
def test_compiled_and_numpy_agree_on_a_puck(feedback):
    fast, slow = (
        plan(TunedPuck(), risk_price=3.0, feedback=feedback, compiled=c) for c in (None, False)
    )
    assert slow.status.ok
    np.testing.assert_allclose(fast.controls, slow.controls, atol=1e-10)


def pendulum(**members):
    """A pendulum pushed from rest, with little noise on its angle and rate."""
    known = {
        "start": np.array([0.0, 0.3]),
        "times": np.linspace(0.0, 1.0, 9),
        "control_weight": np.eye(1),
        "drift": lambda t, x, u: np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0])], axis=-1),
        "diffusion": lambda t, x: np.broadcast_to(np.array([[0.1], [0.05]]), (*x.shape, 1)),
        "terminal": lambda x: x - np.array([1.0, 0.0]),
        "constraint": lambda t, x: np.stack([x[..., 0] - 1.3, x[..., 1] ** 2 - 4.0], axis=-1),
    }
    return types.SimpleNamespace(**known | members)


ODD = {
    "no end": {"terminal": lambda x: x[..., :0], "state_cost": lambda t, x: (x[..., 0] - 1.0) ** 2},
    "no noise": {"diffusion": lambda t, x: np.zeros((*x.shape, 0))},
    "noise of zero": {"diffusion": lambda t, x: np.zeros((*x.shape, 1))},
    "no penalties": {"penalty": lambda t, x: x[..., :0], "penalty_weight": np.zeros(0)},
    "free penalties": {"penalty": lambda t, x: x[..., :1], "penalty_weight": np.zeros(1)},
    "one bound": {"control_bounds": np.array([[-np.inf], [2.5]])},
    "cost with saddles": {"state_cost": lambda t, x: np.cos(3.0 * x[..., 0]) + x[..., 1] ** 2},
    "cost of controls": {"control_cost": lambda t, x: 0.3 * x[..., :1]},
    "an end of no weight": {"terminal_weight": np.zeros(2)},
}


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("odd", ODD)
def test_what_is_empty_zero_or_not_convex_is_planned_alike_by_both_engines(odd, feedback):
    problem = pendulum(**ODD[odd])
    fast, slow = (
        plan(problem, risk_price=2.0, feedback=feedback, compiled=c) for c in (None, False)
    )
    assert fast.status is slow.status is Status.CONVERGED
    np.testing.assert_allclose(fast.controls, slow.controls, atol=1e-9)
    np.testing.assert_allclose(fast.covariance, slow.covariance, atol=1e-12)
    if feedback:
        np.testing.assert_allclose(fast.gains, slow.gains, atol=1e-9)
    # The mean is where the controls lead, and noise spreads by the closed loop.
    x, S, sigma = problem.start, np.zeros((2, 2)), problem.diffusion(0.0, problem.start)
    for k, dt in enumerate(np.diff(problem.times)):
        np.testing.assert_allclose(fast.mean[k], x, atol=1e-4)
        np.testing.assert_allclose(fast.covariance[k], S, atol=1e-6)
        A = np.eye(2) + dt * np.array([[0.0, 1.0], [-np.cos(x[0]), 0.0]])
        if feedback:
            A = A + dt * np.array([[0.0], [1.0]]) @ fast.gains[k]
        x = x + dt * problem.drift(0.0, x, fast.controls[k])
        S = A @ S @ A.T + dt * sigma @ sigma.T


def test_feedback_is_safer_and_cheaper_than_none():
    laws = [plan(Puck(), feedback=f, risk_price=5.0, terminal_weight=50.0) for f in (False, True)]
    assert laws[1].expected.total < laws[0].expected.total
    hits = [
        simulate(Puck(), control, 10_000, seed=4)[0].mean()
        for control in (OpenLoop(laws[0]).control, Feedback(laws[1]).control)
    ]
    assert hits[1] < hits[0]


def compass(turns=0):
    """A heading θ (period 2π) that is to be turned by one radian, and its rate, noisily."""
    return types.SimpleNamespace(
        start=np.array([2.0 * np.pi * turns, 0.0]),
        times=np.linspace(0.0, 1.0, 11),
        control_weight=np.eye(1),
        drift=lambda t, x, u: np.concatenate([x[..., 1:], u], axis=-1),
        diffusion=lambda t, x: np.broadcast_to(np.array([[0.2], [0.1]]), (*x.shape, 1)),
        terminal=lambda x: x - np.array([2.0 * np.pi * turns + 1.0, 0.0]),
        terminal_weight=np.array([20.0, 2.0]),
        angles=(0,),
    )


def test_feedback_of_an_angle_does_not_count_turns():
    p = plan(compass(), feedback=True)
    assert p.status.ok
    controller, k = Feedback(p), 6
    x = p.mean[k] + np.array([0.1, -0.2])
    known = p.controls[k] + p.gains[k] @ np.array([0.1, -0.2])
    for turns in (0, 1, -3):
        seen = x + np.array([2.0 * np.pi * turns, 0.0])
        np.testing.assert_allclose(controller.control(p.times[k], seen), known, atol=1e-9)


def test_the_compass_is_a_linear_regulator():
    """Additive noise: the gains are those of the certain problem, the end is not exact."""
    problem = compass()
    p = plan(problem, feedback=True, tolerance=1e-12)
    known = lqr_gains(p.A, p.B, np.diff(p.times), np.zeros((2, 2)), np.eye(1), np.diag([20.0, 2.0]))
    np.testing.assert_allclose(p.gains, known, rtol=1e-8, atol=1e-10)
    x = problem.start - np.array([1.0, 0.0])
    for k, K in enumerate(known):
        np.testing.assert_allclose(p.controls[k], K @ x, atol=1e-6)
        x = p.A[k] @ x + p.B[k] @ p.controls[k]


def test_a_problem_without_a_terminal_weight_keeps_its_end_exact():
    problem = compass()
    del problem.terminal_weight
    p = plan(problem, feedback=True)
    assert p.status.ok
    np.testing.assert_allclose(problem.terminal(p.mean[-1]), 0.0, atol=1e-6)
    # What is charged then is the spread alone, or feedback would have nothing to do.
    assert p.gains.any()
    assert p.expected.goal == pytest.approx(100.0 * np.trace(p.covariance[-1]), rel=1e-9)
    known = lqr_gains(p.A, p.B, np.diff(p.times), np.zeros((2, 2)), np.eye(1), 100.0 * np.eye(2))
    np.testing.assert_allclose(p.gains, known, rtol=1e-8, atol=1e-10)
    assert plan(problem, expected=True).expected.goal == 0.0


def test_bounds_of_one_sign_hold_with_feedback():
    """Brakes that cannot push: 0 ≤ u, and margins on both sides of a narrow range."""
    puck = Puck(control_bounds=np.array([[-4.0, -2.5], [3.0, 4.0]]))
    p = plan(puck, feedback=True, risk_price=1.0)
    assert (p.controls >= puck.control_bounds[0] - 1e-9).all()
    assert (p.controls <= puck.control_bounds[1] + 1e-9).all()
    u = Feedback(p).control(p.times[5], p.mean[5] + 100.0)
    assert (u >= puck.control_bounds[0]).all()
    assert (u <= puck.control_bounds[1]).all()


def test_a_disc_that_cannot_be_passed_is_no_answer():
    """The start lies in it."""
    inside = Puck(disc=np.array([0.05, 0.0, 0.5]))
    p = plan(inside, risk=0.1, risk_episodes=500, max_iterations=40)
    assert p.status in (Status.RISK_UNREACHABLE, Status.SOLVER_FAILED)
    assert p.message
    if p.risk is not None:
        assert p.risk.verified > 0.1

"""`plan(s, feedback=True)`: gains that are worth their effort, with and without a risk."""

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.planner import Feedback, OpenLoop, Plan, Status, plan
from slipcar.planner.search.risk import wilson_interval

FEW = 20_000


@pytest.fixture(scope="module")
def steered(paper):
    return plan(paper, feedback=True)


@pytest.fixture(scope="module")
def careful(paper):
    """With a risk of 0.2 %."""
    return plan(paper, feedback=True, risk=0.002, risk_episodes=FEW)


def judged(controller, scenario, episodes=FEW):
    return evaluate(controller, scenario, episodes=episodes, seed=91)


def test_the_expected_cost_is_that_of_simulated_paths(paper, steered):
    assert steered.status is Status.CONVERGED
    found = judged(Feedback(steered), paper)
    cost = steered.expected
    assert cost.total == pytest.approx(found.total, rel=0.02)
    assert cost.effort + cost.feedback == pytest.approx(found.effort, rel=0.01)
    assert cost.goal == pytest.approx(found.goal, rel=0.05)
    assert 0.9 * found.obstacle < cost.penalty < 2.0 * found.obstacle
    assert cost.effort == pytest.approx(steered.effort, rel=1e-12)
    parts = cost.effort + cost.feedback + cost.running + cost.penalty + cost.goal
    assert cost.total == pytest.approx(parts, rel=1e-12)
    # Issue 4's bound, with the standard error of fewer paths.
    assert found.total <= 4.98 + 3.0 * found.total_se


def test_feedback_is_worth_more_than_tracking_and_than_no_feedback(paper, steered):
    optimised = judged(Feedback(steered), paper)
    open_loop = judged(OpenLoop(steered), paper)
    tracked = judged(Feedback(plan(paper, variance_weight=0.0)), paper)  # by a regulator
    assert optimised.total < tracked.total < open_loop.total
    assert optimised.collision_rate < tracked.collision_rate


def test_the_gains_are_the_plans_and_are_played(paper, steered):
    K, n, m = len(steered.controls), 5, 2
    assert steered.gains.shape == (K, m, n)
    controller = Feedback(steered)
    np.testing.assert_array_equal(controller.plan.gains, steered.gains)
    rng = np.random.default_rng(0)
    for k in (0, 7, K - 1):
        e = 0.01 * rng.normal(size=n)
        u = controller.control(steered.times[k], steered.mean[k] + e)
        expected = steered.controls[k] + steered.gains[k] @ e
        bound = np.asarray(paper.control_bounds)
        np.testing.assert_allclose(u, np.clip(expected, -bound, bound), atol=1e-12)
    # Weights for a regulator have nothing to say about gains that are given.
    other = Feedback(steered, Q=1.0)
    np.testing.assert_array_equal(other.plan.gains, steered.gains)


def test_the_covariance_is_that_of_simulated_closed_loops(paper, steered):
    rng, paths = np.random.default_rng(3), 20_000
    controller, x = Feedback(steered), np.tile(paper.start, (20_000, 1))
    for k, t in enumerate(steered.times[:-1]):
        dt = steered.times[k + 1] - t
        u = controller.control(np.full(paths, t), x)
        sigma = paper.diffusion(np.full(paths, t), x)
        noise = rng.standard_normal((paths, sigma.shape[-1]))
        x = x + dt * paper.drift(np.full(paths, t), x, u)
        x += np.sqrt(dt) * np.einsum("eij,ej->ei", sigma, noise)
        if k % 8 == 7:
            found, known = np.cov(x.T), steered.covariance[k + 1]
            scale = np.sqrt(np.outer(np.diag(known), np.diag(known)))
            assert np.abs(found - known).max() < 0.2 * scale.max()
            # The predicted mean, within standard errors and the bias of the second order.
            spread = np.sqrt(np.diag(known))
            assert (np.abs(x.mean(axis=0) - steered.mean[k + 1]) < 0.3 * spread + 1e-3).all()


def test_a_risk_with_feedback_is_kept_and_cheaper_than_without(paper, careful):
    risk = careful.risk
    assert careful.status is Status.CONVERGED
    assert risk.reached
    assert risk.verified <= 0.002
    assert risk.interval == wilson_interval(round(risk.verified * FEW), FEW)
    assert risk.predicted >= 0.5 * risk.verified
    found = judged(Feedback(careful), paper)
    assert found.collision_rate <= 0.002 + 4.0 * np.sqrt(0.002 / FEW)
    assert found.effort <= 4.70  # open loop needs 5.2
    assert careful.expected.total > 4.9
    assert careful.expected.total == pytest.approx(found.total, rel=0.02)


def test_a_safer_law_costs_more_in_expectation(steered, careful):
    assert careful.expected.total > steered.expected.total
    assert careful.expected.risk < steered.expected.risk


def test_saved_gains_come_back(careful, tmp_path):
    back = Plan.load(careful.save(tmp_path / "law.npz"))
    np.testing.assert_array_equal(back.gains, careful.gains)
    assert back.risk == careful.risk
    assert back.expected == careful.expected
    assert Feedback(back).fingerprint() == Feedback(careful).fingerprint()


def test_a_law_has_no_certificate_of_the_mean(steered):
    with pytest.raises(ValueError, match="leave risk, risk_price, feedback and"):
        _ = steered.certificate


def test_the_same_call_gives_the_same_bits(paper, steered):
    again = plan(paper, feedback=True)
    np.testing.assert_array_equal(again.controls, steered.controls)
    np.testing.assert_array_equal(again.gains, steered.gains)
    assert again.expected == steered.expected


def test_numpy_finds_what_compiled_code_finds(paper, steered):
    slow = plan(paper, feedback=True, compiled=False)
    np.testing.assert_allclose(slow.controls, steered.controls, atol=1e-6)
    np.testing.assert_allclose(slow.gains, steered.gains, atol=1e-5)


def test_without_noise_there_is_nothing_to_correct(paper):
    world = paper.replace(slip=(0.0, 0.0))
    p = plan(world, feedback=True)
    assert p.status.ok
    assert p.expected.feedback == 0.0
    assert not p.covariance.any()
    exact = plan(world, feedback=True, terminal_weight=1e6)
    np.testing.assert_allclose(exact.mean[-1], world.goal, atol=1e-3)


def test_terminal_weights_trade_the_end_for_effort(paper, steered):
    loose, tight = (plan(paper, feedback=True, terminal_weight=w) for w in (10.0, 1000.0))
    errors = [np.linalg.norm(p.mean[-1] - paper.goal) for p in (loose, steered, tight)]
    assert errors[0] > errors[1] > errors[2]
    efforts = [p.expected.effort + p.expected.feedback for p in (loose, steered, tight)]
    assert efforts[0] < efforts[1] < efforts[2]
    # A weight for each condition: what is not charged is not paid for.
    free = plan(paper, feedback=True, terminal_weight=[100.0, 100.0, 0.0, 0.0, 0.0])
    assert free.status.ok
    assert free.expected.total < steered.expected.total
    assert np.abs(free.mean[-1, 2:]).max() > 0.05
    known = plan(paper, feedback=True, terminal_weight=np.full(5, 100.0))
    np.testing.assert_array_equal(known.controls, steered.controls)


def test_open_loop_with_a_soft_end(paper):
    p = plan(paper, expected=True, terminal_weight=100.0)
    assert p.status.ok
    assert p.gains is None
    found = judged(OpenLoop(p), paper, episodes=20_000)
    assert p.expected.goal == pytest.approx(found.goal, rel=0.1)
    assert p.expected.total == pytest.approx(found.total, rel=0.05)


# ------------------------------------------------------------------------------ bounds


@pytest.mark.parametrize("bounds", [(1.2, 2.5), (1.0, 2.0), (0.9, 1.6)])
def test_tight_bounds_are_kept_with_room_for_corrections(paper, bounds):
    """What the optimum wants uses (0.8, 1.5): margins bind, and yet a plan is found."""
    world = paper.replace(control_bounds=bounds)
    p = plan(world, feedback=True)
    assert p.status is Status.CONVERGED
    spread = np.sqrt(np.einsum("kmi,kij,kmj->km", p.gains, p.covariance[:-1], p.gains))
    assert (np.abs(p.controls) <= np.asarray(bounds) * (1.0 + 1e-9)).all()
    room = np.asarray(bounds) - np.abs(p.controls)
    assert (room > -1e-6).all()
    assert (room >= 0.1 * spread).mean() > 0.9
    found = judged(Feedback(p), world, episodes=10_000)
    assert found.total < 6.0


def test_unbounded_controls_need_no_room(paper, steered):
    p = plan(paper.replace(control_bounds=None), feedback=True)
    np.testing.assert_allclose(p.controls, steered.controls, atol=1e-3)


# ------------------------------------------------------------------------------ many worlds


@pytest.mark.parametrize("seed", range(4))
def test_random_worlds_converge_and_their_costs_are_met(seed):
    world = Scenario.random(100 + seed, turned=seed % 2 == 1)
    p = plan(world, feedback=True)
    assert p.status is Status.CONVERGED
    found = judged(Feedback(p), world, episodes=5_000)
    assert p.expected.total == pytest.approx(found.total, rel=0.15)
    assert found.total < judged(OpenLoop(p), world, episodes=5_000).total


class Noisy:
    """dx = (Ax + Bu) dt + σ dW, a mass in two axes that is pushed hard for its bounds."""

    start, times = np.array([1.0, -0.5, 0.0, 0.3]), np.linspace(0.0, 2.0, 21)
    control_weight, control_bounds = np.eye(2), np.array([1.6, 1.0])
    terminal_weight = np.full(4, 20.0)

    def drift(self, t, x, u):
        return np.concatenate([x[..., 2:], u], axis=-1)

    def diffusion(self, t, x):
        return np.broadcast_to(0.25 * np.eye(4)[:, 2:], (*x.shape[:-1], 4, 2))

    def terminal(self, x):
        return x


def test_the_clipped_part_of_the_controls_is_that_of_simulated_paths():
    p = plan(Noisy(), feedback=True)
    assert p.status is Status.CONVERGED
    rng, paths = np.random.default_rng(5), 50_000
    x, beyond = np.tile(p.mean[0], (paths, 1)), []
    for k, dt in enumerate(np.diff(p.times)):
        u = p.controls[k] + (x - p.mean[k]) @ p.gains[k].T  # not clipped: exactly Gaussian
        beyond.append((np.abs(u) > Noisy.control_bounds).mean())
        noise = rng.normal(size=(paths, 2)) * np.sqrt(dt)
        x = x + dt * np.hstack([x[:, 2:], u]) + 0.25 * noise @ np.eye(4)[2:]
    assert p.expected.clipped == pytest.approx(np.mean(beyond), abs=2e-3)
    assert p.expected.clipped > 0.01
    assert "beyond their bounds" in p.message
    assert plan(Noisy(), expected=True).expected.clipped == 0.0  # no feedback, nothing to clip

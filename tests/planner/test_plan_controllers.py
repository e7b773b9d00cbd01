"""OpenLoop and Feedback as controllers: what they see and what they answer."""

import gymnasium as gym
import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.envs.observation import observe
from slipcar.planner import Feedback, OpenLoop, plan


@pytest.fixture(scope="module")
def planned(paper):
    return plan(paper)


@pytest.fixture(scope="module", params=[OpenLoop, Feedback])
def controller(request, planned):
    return request.param(planned)


def states(p, count, spread, seed=0):
    """Times at nodes and states around the plan there."""
    rng = np.random.default_rng(seed)
    k = rng.integers(0, len(p.controls), size=count)
    return p.times[k], p.mean[k] + spread * rng.normal(size=(count, p.mean.shape[1])), k


def test_open_loop_plays_each_control_in_its_interval(planned, paper):
    c = OpenLoop(planned)
    for k in range(40):
        for late in (0.0, 0.3, 0.99):
            obs = observe(paper, "state", planned.times[k] + late * paper.dt, np.zeros(5))
            action, state = c.predict(obs)
            np.testing.assert_allclose(
                action * paper.control_bounds, planned.controls[k], rtol=1e-6
            )
            assert state is None
            assert action.dtype == np.float32
    # On the last observation nothing is left to do; an answer is due all the same.
    assert c.predict(observe(paper, "state", 5.0, np.zeros(5)))[0].shape == (2,)


@pytest.mark.parametrize("kind", ["state", "features"])
def test_every_node_time_survives_its_rounding(planned, kind):
    # 0.1 s steps are no binary fractions, and observations are float32.
    s = Scenario.named("paper").replace(horizon=7.3, nodes=74)
    p = plan(s)
    c = OpenLoop(p)
    for k in range(73):
        action, _ = c.predict(observe(s, kind, p.times[k], p.mean[k]))
        np.testing.assert_allclose(action * s.control_bounds, p.controls[k], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("N", [41, 4001, 400_001])
@pytest.mark.parametrize("kind", ["state", "features"])
def test_however_many_nodes_each_time_is_in_its_interval(planned, paper, kind, N):
    """Of 400 001 nodes in 5 s, float32 knows each to a twentieth of an interval."""
    many = planned.replace(times=np.linspace(0.0, 5.0, N), controls=np.zeros((N - 1, 2)))
    k = np.arange(N - 1)
    seen = observe(paper, kind, many.times[:-1], np.tile(planned.mean[0], (N - 1, 1)))
    t, _ = paper.decode_observation(seen)
    np.testing.assert_array_equal(OpenLoop(many)._interval(t), k)
    np.testing.assert_array_equal(OpenLoop(many)._interval(t + 0.8 * 5.0 / (N - 1)), k)


def test_both_observation_kinds_get_the_same_answer(controller, planned, paper):
    t, x, _ = states(planned, 200, 0.05)
    a, _ = controller.predict(observe(paper, "state", t, x))
    b, _ = controller.predict(observe(paper, "features", t, x))
    np.testing.assert_allclose(a, b, atol=2e-5)


@pytest.mark.parametrize("kind", ["state", "features"])
@pytest.mark.parametrize("batch", [1, 2, 7, 64, 1000])
def test_batches_give_the_bits_of_single_observations(controller, planned, paper, kind, batch):
    t, x, _ = states(planned, batch, 0.1)
    obs = observe(paper, kind, t, x)
    together, _ = controller.predict(obs)
    assert together.shape == (batch, 2)
    for i in range(0, batch, max(1, batch // 20)):
        np.testing.assert_array_equal(controller.predict(obs[i])[0], together[i])


def test_batches_may_be_empty_or_have_several_axes(controller, planned, paper):
    t, x, _ = states(planned, 12, 0.1)
    obs = observe(paper, "state", t, x)
    together, _ = controller.predict(obs.reshape(3, 4, 6))
    np.testing.assert_array_equal(together.reshape(12, 2), controller.predict(obs)[0])
    assert controller.predict(obs[:0])[0].shape == (0, 2)


def test_feedback_pushes_back_by_its_gains_and_within_the_bounds(planned, paper):
    c = Feedback(planned)
    t, x, k = states(planned, 300, 0.3)
    wanted = planned.controls[k] + np.einsum("kmn,kn->km", c.plan.gains[k], x - planned.mean[k])
    inside = np.clip(wanted, -paper.control_bounds, paper.control_bounds)
    np.testing.assert_allclose(c.control(t, x), inside, atol=1e-10)
    assert np.any(inside != wanted)
    action, _ = c.predict(observe(paper, "state", t, x))
    assert np.all(np.abs(action) <= 1.0)


def test_feedback_leaves_what_it_is_given_unchanged(planned):
    c = Feedback(planned)
    x = planned.mean[5] + 0.1
    x.setflags(write=False)
    before = x.copy()
    c.control(planned.times[5], x)
    np.testing.assert_array_equal(x, before)


def test_headings_beyond_pi_are_the_same_headings():
    # Turn by 2.5 rad from 2 rad: the heading passes π, features fold it back to (−π, π].
    s = Scenario(
        start=(0.0, 0.0, 2.0, 0.0, 0.0),
        goal=(-1.0, -0.5, 4.5, 0.0, 0.0),
        obstacles=((0.5, 0.5, 0.2),),
    )
    p = plan(s)
    assert p.status.ok
    assert p.mean[:, 2].max() > np.pi
    c = Feedback(p)
    t, x, _ = states(p, 400, 0.02)
    a, _ = c.predict(observe(s, "state", t, x))
    b, _ = c.predict(observe(s, "features", t, x))
    np.testing.assert_allclose(a, b, atol=5e-5)
    turned = x + np.array([0.0, 0.0, 2.0 * np.pi, 0.0, 0.0])
    np.testing.assert_allclose(c.control(t, turned), c.control(t, x), atol=1e-9)
    # A heading error of one radian is not wrapped away.
    off = p.mean[20] + np.array([0.0, 0.0, 1.0, 0.0, 0.0])
    wanted = p.controls[20] + c.plan.gains[20][:, 2]
    np.testing.assert_allclose(
        c.control(p.times[20], off), np.clip(wanted, -s.control_bounds, s.control_bounds)
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda o: np.where(np.arange(6) == 2, np.nan, o), r"observation\[2\] is nan"),
        (lambda o: np.where(np.arange(6) == 0, np.inf, o), r"observation\[0\] is inf"),
        (lambda o: o[:5], "last axis"),
        (lambda o: np.zeros(11), "last axis"),
        (lambda o: 1.0, "last axis"),
        (lambda o: np.stack([o, o * np.nan]), r"observation\[1, 0\] is nan"),
    ],
)
def test_bad_observations_are_errors(controller, paper, spoil, message):
    obs = observe(paper, "state", 1.0, np.zeros(5))
    with pytest.raises(ValueError, match=message):
        controller.predict(spoil(obs))


def test_without_bounds_there_is_no_action_to_scale_to(paper):
    p = plan(paper.replace(control_bounds=None))
    with pytest.raises(ValueError, match="control_bounds is None"):
        OpenLoop(p).predict(np.zeros(6))


def test_what_a_controller_tells_about_itself(planned):
    a, b = OpenLoop(planned), Feedback(planned)
    assert a.observation == b.observation == "state"
    assert a.closed_loop is False
    assert b.closed_loop is True
    assert a.preparation_time == planned.solve_time > 0.0
    assert a.status is b.status is planned.status


def test_fingerprints_tell_behaviour_apart_and_nothing_else(planned, paper):
    prints = {
        OpenLoop(planned).fingerprint(),
        Feedback(planned).fingerprint(),
        Feedback(planned, Q=3.0).fingerprint(),
        OpenLoop(plan(paper, variance_weight=0.0)).fingerprint(),
    }
    assert len(prints) == 4
    again = planned.replace(solve_time=1e9)
    assert OpenLoop(again).fingerprint() == OpenLoop(planned).fingerprint()
    assert Feedback(again).fingerprint() == Feedback(planned).fingerprint()


class Cart:
    """A problem without codecs: observations are (x, t), actions are controls."""

    start, times, control_weight = np.zeros(2), np.linspace(0.0, 2.0, 21), np.eye(1)
    control_bounds = np.array([[-1.4], [1.6]])

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 2, 1), 0.1)

    def terminal(self, x):
        return x - np.array([1.0, 0.0])


@pytest.mark.parametrize("kind", [OpenLoop, Feedback])
def test_a_problem_without_codecs_is_observed_as_state_and_time(kind):
    p = plan(Cart())
    c = kind(p)
    t, x, k = states(p, 50, 0.0)
    actions, _ = c.predict(np.column_stack([x, t]))
    np.testing.assert_allclose(actions, p.controls[k], rtol=1e-6, atol=1e-7)
    assert actions.dtype == np.float32
    with pytest.raises(ValueError, match="no decode_observation"):
        c.predict(np.zeros(2))
    with pytest.raises(ValueError, match="no decode_observation"):
        c.predict(np.zeros((4, 7)))


def test_feedback_keeps_the_bounds_of_a_problem_without_codecs():
    p = plan(Cart())
    far = np.concatenate([p.mean[3] + 100.0, [p.times[3]]])
    np.testing.assert_allclose(Feedback(p).predict(far)[0], -1.4)
    near = np.concatenate([p.mean[3] - 100.0, [p.times[3]]])
    np.testing.assert_allclose(Feedback(p).predict(near)[0], 1.6)


@pytest.mark.parametrize("kind", ["state", "features"])
def test_stable_baselines_evaluates_a_plan(kind, paper):
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    monitor = pytest.importorskip("stable_baselines3.common.monitor")
    still = paper.replace(slip=(0.0, 0.0))  # without noise the return is known
    p = plan(still, tolerance=1e-8)
    env = monitor.Monitor(gym.make("slipcar.envs:SlipCar-v0", scenario=still, observation=kind))
    for controller in (OpenLoop(p), Feedback(p)):
        mean, spread = evaluation.evaluate_policy(controller, env, n_eval_episodes=2)
        assert mean == pytest.approx(-p.cost, rel=1e-4)
        assert spread < 1e-9


def test_feedback_brings_the_car_home_more_often_than_the_clock(paper, planned):
    totals = {}
    for kind in (OpenLoop, Feedback):
        env, c = gym.make("slipcar.envs:SlipCar-v0", scenario=paper), kind(planned)
        returns = []
        for seed in range(40):
            obs, _ = env.reset(seed=seed)
            done, total = False, 0.0
            while not done:
                obs, reward, done, _, _ = env.step(c.predict(obs)[0])
                total += reward
            returns.append(total)
        totals[kind] = np.mean(returns)
    assert totals[Feedback] > totals[OpenLoop] + 1.0

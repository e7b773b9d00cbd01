"""The adapter against Stable-Baselines3's own way of vectorising, and its episode ends."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from slipcar.baselines import Policy, score
from slipcar.baselines.sb3 import SB3VecEnv
from slipcar.envs import Scenario, SlipCarEnv, SlipCarVectorEnv

PAPER = Scenario.named("paper")
SHORT = PAPER.replace(nodes=6)


def adapter(num_envs, scenario=PAPER, reward_scale=1.0, **options):
    env = SlipCarVectorEnv(
        num_envs, scenario, autoreset_mode="SameStep", dtype="float64", **options
    )
    return SB3VecEnv(env, reward_scale)


def random_actions(steps, num_envs, seed=0):
    return np.random.default_rng(seed).uniform(-1.3, 1.3, (steps, num_envs, 2)).astype(np.float32)


def random_policy(seed=0):
    rng = np.random.default_rng(seed)
    return Policy(
        weights=(0.3 * rng.standard_normal((8, 12)), 0.3 * rng.standard_normal((2, 8))),
        biases=(np.zeros(8), np.zeros(2)),
        log_std=np.zeros(2),
        trained_on=PAPER,
    )


@pytest.mark.parametrize("terminate_on_collision", [False, True])
def test_steps_like_dummy_vec_env_over_single_environments(terminate_on_collision):
    n, options = 5, {"terminate_on_collision": terminate_on_collision}
    reference = DummyVecEnv([lambda: Monitor(SlipCarEnv(PAPER, **options))] * n)
    ours = adapter(n, **options)
    reference.seed(11), ours.seed(11)
    np.testing.assert_array_equal(ours.reset(), reference.reset())
    ended = 0
    for actions in random_actions(95, n):  # two whole episodes and the start of a third
        got, wanted = ours.step(actions), reference.step(actions)
        for a, b in zip(got[:3], wanted[:3], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
        for mine, theirs in zip(got[3], wanted[3], strict=True):
            assert mine.get("TimeLimit.truncated", False) is theirs["TimeLimit.truncated"] is False
            assert ("terminal_observation" in mine) == ("terminal_observation" in theirs)
            if "terminal_observation" in mine:
                ended += 1
                last = mine["terminal_observation"]
                np.testing.assert_allclose(last, theirs["terminal_observation"], atol=1e-5)
                assert mine["episode"]["l"] == theirs["episode"]["l"]
                assert mine["episode"]["r"] == pytest.approx(theirs["episode"]["r"], abs=1e-5)
                assert mine["collision"] == theirs["collision"]
                assert mine["clearance"] == pytest.approx(theirs["clearance"])
    assert ended >= 2 * n


def test_episode_end_hands_over_the_observation_before_the_reset():
    n = 7
    ours = adapter(n, SHORT)
    plain = SlipCarVectorEnv(n, SHORT, autoreset_mode="Disabled", dtype="float64")
    ours.seed(3)
    ours.reset(), plain.reset(seed=3)
    for actions in random_actions(5, n):
        observation, _, done, infos = ours.step(actions)
        last, *_ = plain.step(actions)
    assert done.all()
    fresh, _ = plain.reset()
    np.testing.assert_array_equal(observation, fresh)
    np.testing.assert_array_equal([info["terminal_observation"] for info in infos], last)
    assert not np.array_equal(fresh, last)


@pytest.mark.parametrize("scale", [1.0, 0.1, 2.5])
def test_rewards_sum_to_minus_the_scaled_path_cost(scale):
    ours = adapter(4, reward_scale=scale)
    ours.seed(8)
    ours.reset()
    rewards = np.zeros(4)
    for actions in random_actions(40, 4, seed=2):
        _, reward, _, infos = ours.step(actions)
        assert reward.dtype == np.float32
        rewards += reward
    cost = np.array([info["effort"] + info["obstacle"] + info["goal"] for info in infos])
    assert (cost > 1.0).all()
    np.testing.assert_allclose(rewards, -scale * cost, rtol=1e-5)
    np.testing.assert_allclose([info["episode"]["r"] for info in infos], -cost, rtol=1e-12)


def test_a_seed_is_used_once_and_repeats_the_paths():
    ours = adapter(3)

    def returns(seed):
        ours.seed(seed)
        ours.reset()
        for actions in random_actions(40, 3):
            infos = ours.step(actions)[3]
        return [info["episode"]["r"] for info in infos]

    first = returns(5)
    assert returns(5) == first
    assert returns(6) != first
    ours.reset()  # no seed given again: the generators go on
    for actions in random_actions(40, 3):
        infos = ours.step(actions)[3]
    assert [info["episode"]["r"] for info in infos] != returns(6)


def test_evaluate_policy_agrees_with_score():
    n, policy = 16, random_policy()
    env = VecMonitor(adapter(n, reward_scale=1.0))
    env.seed(40)
    mean, _ = evaluate_policy(policy, env, n_eval_episodes=n)
    assert mean == pytest.approx(-score(policy, PAPER, n, seed=40).total, rel=1e-5)


def test_sub_environments_share_attributes():
    ours = adapter(3)
    assert ours.get_attr("scenario", indices=[0, 2]) == [PAPER, PAPER]
    assert ours.env_is_wrapped(Monitor) == [True] * 3
    assert ours.env_is_wrapped(gym.wrappers.TimeLimit) == [False] * 3
    with pytest.raises(AttributeError):
        ours.get_attr("no_such_thing")
    with pytest.raises(NotImplementedError, match="share"):
        ours.set_attr("substeps", 2)
    with pytest.raises(NotImplementedError, match="render"):
        ours.env_method("render")


def test_episode_ends_say_whether_it_succeeded_and_how_often_it_was_inside():
    loose = PAPER.replace(goal_tolerance=50.0, obstacles=((0.3, 0.0, 0.2),))
    ours = adapter(6, loose)
    ours.seed(0), ours.reset()
    singles = [SlipCarEnv(loose) for _ in range(6)]
    for i, env in enumerate(singles):
        env.reset(seed=i)
    inside = np.zeros(6)
    for actions in np.abs(random_actions(40, 6)):
        infos = ours.step(actions)[3]
        last = [env.step(a)[4] for env, a in zip(singles, actions, strict=True)]
        inside += [info["cost"] for info in last]
    assert [info["is_success"] for info in infos] == [info["is_success"] for info in last]
    assert [info["cost"] for info in infos] == inside.tolist()
    assert inside.any()


def test_options_reach_the_sub_environments():
    ours = adapter(3, PAPER)
    slalom = Scenario.named("slalom")
    ours.set_options([{"scenario": PAPER}, {"scenario": slalom}, {"scenario": PAPER}])
    ours.reset()
    assert ours.env.scenarios == [PAPER, slalom, PAPER]
    ours.set_options({"start": np.full(5, 0.1)})
    ours.reset()
    np.testing.assert_array_equal(ours.env.states, np.full((3, 5), 0.1))
    ours.set_options([{}, {"scenario": PAPER}, {}])
    with pytest.raises(ValueError, match=r"'scenario' must be given to all .*\[0, 2\] have none"):
        ours.reset()


def test_families_and_pictures():
    pytest.importorskip("pygame")
    env = SlipCarVectorEnv(
        2, "family:easy", "egocentric", autoreset_mode="SameStep", render_mode="rgb_array"
    )
    ours = SB3VecEnv(env)
    observation = ours.reset()
    assert observation.shape == (2, 15 + 4 * 2)
    first, second = ours.get_images()
    assert first.shape == second.shape
    assert not np.array_equal(first, second)
    assert adapter(2).get_images() == [None, None]


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_other_autoreset_modes_are_refused(mode):
    with pytest.raises(ValueError, match=f"SameStep.*{mode}"):
        SB3VecEnv(SlipCarVectorEnv(2, autoreset_mode=mode))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_bad_reward_scale_is_refused(scale):
    with pytest.raises(ValueError, match="reward_scale must be finite and > 0"):
        adapter(2, reward_scale=scale)


def test_bad_actions_and_options_are_refused():
    ours = adapter(2)
    ours.reset()
    with pytest.raises(ValueError, match=r"action\[1, 0\] is nan"):
        ours.step(np.array([[0.0, 0.0], [np.nan, 0.0]]))
    with pytest.raises(ValueError, match="shape"):
        ours.step(np.zeros((3, 2)))
    ours.set_options({"speed": 3})
    with pytest.raises(ValueError, match="speed"):
        ours.reset()


def test_an_episode_that_is_cut_off_is_told_as_truncated():
    """So that Stable-Baselines3 bootstraps there, and at the horizon it does not."""
    for limit, truncated in ((3, True), (5, False)):
        env = adapter(2, SHORT, max_episode_steps=limit)
        env.reset()
        for _ in range(limit):
            _, _, done, infos = env.step(np.zeros((2, 2), dtype=np.float32))
        assert done.all()
        assert infos[0]["TimeLimit.truncated"] is truncated
        assert infos[0]["episode"]["l"] == limit

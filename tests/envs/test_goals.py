"""What counts beside the cost: collisions as a constraint, success, the sparse reward."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from slipcar.envs import Scenario, SlipCarEnv, SlipCarVectorEnv, SparseSuccess, VectorSparseSuccess

PAPER = Scenario.named("paper")
#: Standing still it arrives; accelerating it does not.
HOME = Scenario(start=np.zeros(5), goal=np.zeros(5), nodes=6, horizon=1.0, goal_tolerance=0.3)
#: Straight ahead through a post.
THROUGH = Scenario(
    start=(0, 0, 0, 1, 0), goal=(4, 0, 0, 1, 0), horizon=4.0, obstacles=((2, 0.1, 0.5),)
)


def drive(env, action):
    infos, rewards, over = [env.reset(seed=0)[1]], [], False
    while not over:
        _, reward, over, _, info = env.step(np.asarray(action))
        infos.append(info)
        rewards.append(reward)
    return rewards, infos


def test_cost_is_charged_at_the_nodes_inside_an_obstacle():
    _, infos = drive(SlipCarEnv(THROUGH), (0.0, 0.0))
    costs = np.array([info["cost"] for info in infos])
    x = np.linspace(0.0, 4.0, 41)
    inside = np.hypot(x - 2.0, 0.1) < 0.5
    np.testing.assert_array_equal(costs, inside.astype(float))
    collided = [info["collision"] for info in infos]
    np.testing.assert_array_equal(collided, np.logical_or.accumulate(inside))
    assert not infos[-1]["is_success"]  # it arrives, but on the way it hit the post


def test_a_start_inside_an_obstacle_is_no_collision_until_a_node_is():
    env = SlipCarEnv(THROUGH)
    _, info = env.reset(options={"start": [2.0, 0.0, 0.0, 0.0, 0.0]})
    assert info["clearance"] < 0.0
    assert not info["collision"]
    assert info["cost"] == 0.0
    _, _, _, _, info = env.step(np.zeros(2))
    assert info["collision"]
    assert info["cost"] == 1.0


@pytest.mark.parametrize(("action", "success"), [((0.0, 0.0), True), ((1.0, 0.0), False)])
def test_success_is_to_arrive_within_the_tolerance(action, success):
    rewards, infos = drive(SlipCarEnv(HOME), action)
    assert [info["is_success"] for info in infos] == [False] * 5 + [success]
    sparse, _ = drive(SparseSuccess(SlipCarEnv(HOME)), action)
    assert sparse == [0.0] * 4 + [float(success)]
    assert sum(rewards) <= 0.0


def test_success_needs_every_component():
    for component, scale in enumerate((0.3, 0.3, 0.3, 0.3, 0.3)):
        for factor, success in ((0.9, True), (1.1, False)):
            tolerance = np.full(5, 10.0)
            tolerance[component] = scale
            start = np.zeros(5)
            start[component] = factor * scale
            still = HOME.replace(goal_tolerance=tolerance, horizon=1e-6)
            env = SlipCarEnv(still)
            env.reset(options={"start": start})
            for _ in range(5):
                *_, info = env.step(np.zeros(2))
            assert info["is_success"] is success


@pytest.mark.parametrize("mode", AutoresetMode)
def test_many_agree_with_one(mode):
    actions = np.array([[0.0, 0.0], [1.0, 0.0], [0.05, 0.0]])
    envs = VectorSparseSuccess(SlipCarVectorEnv(3, HOME, autoreset_mode=mode))
    envs.reset(seed=0)
    total = np.zeros(3)
    for _ in range(5):
        _, reward, over, _, _ = envs.step(actions)
        assert reward.dtype == np.float64
        total += reward
    assert over.all()
    expected = [sum(drive(SparseSuccess(SlipCarEnv(HOME)), a)[0]) for a in actions]
    np.testing.assert_array_equal(total, expected)
    assert total.tolist() == [1.0, 0.0, 1.0]


def test_an_episode_cut_short_by_a_collision_is_no_success():
    env = SlipCarEnv(THROUGH.replace(goal_tolerance=100.0), terminate_on_collision=True)
    rewards, infos = drive(env, (0.0, 0.0))
    assert len(rewards) < 40
    assert not infos[-1]["is_success"]
    assert infos[-1]["cost"] == 1.0


def test_the_vector_wrapper_refuses_other_environments():
    with pytest.raises(ValueError, match="wraps a SlipCarVectorEnv"):
        VectorSparseSuccess(gym.make_vec("CartPole-v1", num_envs=2))

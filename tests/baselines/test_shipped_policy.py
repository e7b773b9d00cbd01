"""The shipped policy drives as the README says, on episodes it has never met."""

import numpy as np
import pytest
from scipy.stats import binomtest

from slipcar.baselines import PPOConfig, load_policy, score
from slipcar.envs import Scenario, SlipCarEnv

EPISODES, SEED = 20_000, 7_000_000_000


@pytest.fixture(scope="module")
def policy():
    return load_policy()


@pytest.fixture(scope="module")
def found(policy):
    return score(policy, policy.scenario, EPISODES, SEED)


def test_cost_collisions_and_parking(found):
    assert found.total - 2.0 * found.total_error <= 5.10
    collisions = round(found.collision_rate * EPISODES)
    assert binomtest(collisions, EPISODES).proportion_ci(0.95, "wilson").low <= 0.010
    assert found.position_rms <= 0.068 * (1.0 + 2.0 / np.sqrt(EPISODES))


def test_its_record_tells_how_it_was_made(policy, found):
    training = policy.training
    assert policy.scenario == Scenario.named("paper")
    assert policy.sizes == (12, 64, 64, 2)
    assert set(training["config"]) == set(PPOConfig().to_dict())
    assert {"torch", "stable-baselines3", "numpy", "python"} <= set(training["versions"])
    assert training["validation"]["total"] == pytest.approx(found.total, abs=0.05)
    assert policy.preparation_time > 10.0


def test_one_episode_in_the_single_environment(policy):
    env = SlipCarEnv()
    observation, _ = env.reset(seed=SEED)
    total, over = 0.0, False
    while not over:
        action, _ = policy.predict(observation)
        observation, reward, over, _, info = env.step(action)
        total -= reward
    assert total == pytest.approx(score(policy, policy.scenario, 1, SEED).total, rel=1e-6)
    assert not info["collision"]

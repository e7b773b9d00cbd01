import numpy as np
import pytest

from slipcar.evaluation import evaluate

pytest.importorskip("stable_baselines3")


@pytest.mark.parametrize("observation", ["features", "state"])
def test_a_stable_baselines_model_is_a_controller(paper, observation):
    import gymnasium as gym
    from stable_baselines3 import PPO

    env = gym.make("slipcar.envs:SlipCar-v0", observation=observation)
    model = PPO("MlpPolicy", env, n_steps=64, seed=0, device="cpu")
    once = evaluate(model, paper, 1500, seed=1)
    parts = evaluate(model, paper, 1500, seed=1, batch_size=1)
    np.testing.assert_array_equal(once.metrics.total, parts.metrics.total)
    # An untrained network's actions are small but not nil.
    assert 0.0 < once.effort < 1.0
    assert once.closed_loop

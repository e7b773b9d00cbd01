"""Under `torch.set_default_dtype(torch.float64)` all is what it is without."""

import contextlib

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch

from slipcar.baselines import (
    CloneConfig,
    PathwiseConfig,
    PPOConfig,
    clone_planner,
    train_pathwise,
    train_ppo,
)
from slipcar.baselines.sb3 import SB3VecEnv
from slipcar.envs import Scenario, SlipCarTorchEnv, SlipCarVectorEnv, path_costs
from slipcar.envs.torch_paths import draw_noise, observed
from slipcar.evaluation import evaluate
from slipcar.evaluation.own.as_controller import as_controller
from slipcar.evaluation.own.sb3_models import load_model

COARSE = Scenario.named("paper").replace(nodes=11)


@contextlib.contextmanager
def default(dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
        assert torch.get_default_dtype() is dtype  # nothing of ours changes it
    finally:
        torch.set_default_dtype(before)


class Agent(torch.nn.Module):
    """As CleanRL's: with a mean action, or only sampled."""

    def __init__(self, mean):
        super().__init__()
        self.net = torch.nn.Linear(12, 2)
        if mean:
            self.actor_mean = self.net

    def get_action_and_value(self, x):
        mean = self.net(x)
        chosen = torch.distributions.Normal(mean, torch.ones_like(mean))
        action = chosen.sample()
        return action, chosen.log_prob(action), chosen.entropy(), mean[:, :1]


NETWORKS = {
    "sequential": lambda: torch.nn.Sequential(torch.nn.Linear(12, 2), torch.nn.Tanh()),
    "agent": lambda: Agent(mean=True),
    "no parameters": lambda: torch.nn.AdaptiveAvgPool1d(2),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_own_networks_drive_in_their_own_dtype(name):
    torch.manual_seed(0)
    network = NETWORKS[name]()
    wanted = evaluate(as_controller(network, COARSE), COARSE, 64).total
    with default(torch.float64):
        same = evaluate(as_controller(network, COARSE), COARSE, 64).total
        double = evaluate(as_controller(network.double(), COARSE), COARSE, 64).total
    assert same == wanted
    assert double == pytest.approx(wanted, rel=1e-5)


def test_agents_that_are_sampled_drive():
    with default(torch.float64):
        agent = Agent(mean=False)
        totals = [evaluate(as_controller(agent, COARSE), COARSE, 64).total for _ in range(2)]
    assert agent.net.weight.dtype is torch.float64
    assert totals[0] == totals[1]


TRAININGS = {
    "ppo": lambda: train_ppo(
        COARSE,
        PPOConfig(
            total_steps=80, environments=4, minibatches=1, epochs=1, hidden=(4,),
            validation_episodes=4,
        ),
        progress=False,
    ),
    "pathwise": lambda: train_pathwise(
        COARSE,
        PathwiseConfig(
            iterations=3, paths=8, warm_up=1, hidden=(4,), evaluate_every=1, validation_episodes=4
        ),
        progress=False,
    ),
    "cloning": lambda: clone_planner(
        COARSE, CloneConfig(worlds=1, episodes=8, epochs=1, batch=8, validation_episodes=4)
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TRAININGS)
def test_trainings_end_in_the_same_policy(name):
    wanted = TRAININGS[name]().fingerprint()
    with default(torch.float64):
        assert TRAININGS[name]().fingerprint() == wanted


def test_stored_models_drive_as_they_did(tmp_path):
    env = SB3VecEnv(SlipCarVectorEnv(2, COARSE, autoreset_mode="SameStep"))
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", env, n_steps=10, batch_size=10, seed=0, device="cpu")
    model.save(tmp_path / "model.zip")
    seen = np.random.default_rng(0).normal(size=(5, 12)).astype(np.float32)
    wanted = model.predict(seen, deterministic=True)[0]
    with default(torch.float64):
        again = load_model(tmp_path / "model.zip", trust=True).predict(seen)[0]
    np.testing.assert_array_equal(again, wanted)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_environments_of_tensors_step_alike(dtype):
    def episode():
        env = SlipCarTorchEnv(3, COARSE, dtype=dtype, seed=5)
        observation, _ = env.reset()
        rewards = [env.step(torch.full((3, 2), 0.3, dtype=torch.float32))[1] for _ in range(9)]
        return observation, torch.stack(rewards)

    wanted = episode()
    with default(torch.float64):
        found = episode()
    for a, b in zip(found, wanted, strict=True):
        assert a.dtype is b.dtype
        assert torch.equal(a, b)


@pytest.mark.parametrize("noise", ["float32", "float64"])
def test_paths_are_driven_and_differentiated_by_networks_of_either_dtype(noise):
    torch.manual_seed(0)
    network = torch.nn.Linear(12, 2)
    variates = draw_noise(COARSE, 16, seed=1, dtype=noise)
    wanted = path_costs(COARSE, observed(COARSE, network), variates).total
    with default(torch.float64):
        costs = path_costs(COARSE, observed(COARSE, network.double()), variates).total
        costs.mean().backward()
    assert costs.dtype is getattr(torch, noise)
    assert torch.allclose(costs, wanted, rtol=1e-4)
    assert torch.isfinite(network.weight.grad).all()

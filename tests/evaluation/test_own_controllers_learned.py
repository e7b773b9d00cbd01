"""Networks and trained models that others bring: torch, CleanRL's agents, Stable-Baselines3."""

import json
import pickle
import zipfile

import numpy as np
import pytest

from slipcar.evaluation import evaluate
from slipcar.evaluation.own.as_controller import as_controller
from slipcar.evaluation.own.load import load_controller
from slipcar.evaluation.own.sb3_models import algorithm_of

torch = pytest.importorskip("torch")


def network(inputs=12, outputs=2):
    torch.manual_seed(0)
    first, last = torch.nn.Linear(inputs, 8), torch.nn.Linear(8, outputs)
    return torch.nn.Sequential(first, torch.nn.Tanh(), torch.nn.Dropout(0.5), last)


class Agent(torch.nn.Module):
    """As CleanRL's ppo_continuous_action has it."""

    def __init__(self, mean=True, discrete=False):
        super().__init__()
        self.discrete = discrete
        net = network()
        if mean:
            self.actor_mean = net
        else:
            self.actor = net

    def get_action_and_value(self, x, action=None):
        mean = self.actor_mean(x) if hasattr(self, "actor_mean") else self.actor(x)
        if self.discrete:
            chosen = torch.distributions.Categorical(logits=mean)
        else:
            chosen = torch.distributions.Normal(mean, 0.3)
        action = chosen.sample()
        return action, chosen.log_prob(action), chosen.entropy(), mean[:, :1]


class SoftActor(torch.nn.Module):
    """As CleanRL's sac_continuous_action has it: forward gives mean and deviation."""

    def __init__(self):
        super().__init__()
        self.net = network()

    def forward(self, x):
        return self.net(x), torch.zeros(len(x), 2)

    def get_action(self, x):
        mean, log_std = self(x)
        action = torch.tanh(mean + log_std.exp() * torch.randn_like(mean))
        return action, log_std.sum(1, keepdim=True), torch.tanh(mean)


def test_a_network_is_shown_what_its_first_layer_takes(paper):
    module = network(22)
    controller = as_controller(module, paper)
    assert (controller.observation, controller.obstacle_slots) == ("state", 4)
    observed = np.random.default_rng(0).normal(size=(5, 22)).astype(np.float32)
    with torch.no_grad():
        expected = module.eval()(torch.from_numpy(observed)).numpy()
    module.train()
    np.testing.assert_array_equal(controller.predict(observed)[0], expected)  # no dropout
    assert module.training  # as it was found
    with pytest.raises(ValueError, match="takes 7 numbers in its first layer, and no observation"):
        as_controller(network(7), paper)
    with pytest.raises(ValueError, match=r"must return shape \(3, 2\), not \(3, 3\)"):
        as_controller(network(outputs=3), paper)


def test_cleanrl_agents_give_their_mean_action(paper):
    observed = np.random.default_rng(0).normal(size=(5, 12)).astype(np.float32)
    for agent, mean in (
        (Agent().eval(), lambda agent, o: agent.actor_mean(o)),
        (SoftActor().eval(), lambda agent, o: torch.tanh(agent.net(o))),
    ):
        with torch.no_grad():
            expected = mean(agent, torch.from_numpy(observed)).numpy()
        action = as_controller(agent, paper).predict(observed)[0]
        np.testing.assert_array_equal(action, expected)


def test_agents_without_a_mean_are_sampled_the_same_for_the_same_paths(paper):
    controller = as_controller(Agent(mean=False), paper)
    torch.manual_seed(7)
    once = evaluate(controller, paper, 1500, seed=1).metrics.total
    state = torch.random.get_rng_state()
    again = evaluate(controller, paper, 1500, seed=1, batch_size=1).metrics.total
    np.testing.assert_array_equal(once, again)
    assert torch.equal(state, torch.random.get_rng_state())  # the user's own numbers go on
    observed = np.zeros((2, 12), dtype=np.float32)
    assert np.ptp(controller.predict(observed)[0], axis=0).min() > 0.0  # sampled all the same


def test_discrete_agents_are_refused(paper):
    with pytest.raises(ValueError, match="int64 numbers: discrete actions"):
        as_controller(Agent(mean=False, discrete=True), paper, "mine")


def test_fingerprints_of_networks_are_of_their_weights_and_layers(paper):
    one, same = as_controller(network(), paper), as_controller(network(), paper)
    assert one.fingerprint() == same.fingerprint() is not None
    with torch.no_grad():
        same.function[0].bias[0] += 1e-6
    assert one.fingerprint() != same.fingerprint()
    other = network()
    other[1] = torch.nn.ReLU()
    assert as_controller(other, paper).fingerprint() != one.fingerprint()


# ------------------------------------------------------------------ Stable-Baselines3

sb3 = pytest.importorskip("stable_baselines3")


def save(path, algorithm, env, **options):
    small = {"policy_kwargs": {"net_arch": [4]}, "device": "cpu", "seed": 0}
    model = algorithm(options.pop("policy", "MlpPolicy"), env, **small, **options)
    model.save(path)
    return model


@pytest.fixture
def car():
    import gymnasium as gym

    return lambda **options: gym.make("slipcar.envs:SlipCar-v0", **options)


KINDS = {
    "PPO": {"n_steps": 4, "batch_size": 4, "n_epochs": 1},
    "A2C": {"n_steps": 1},
    "SAC": {"buffer_size": 8, "learning_starts": 0, "batch_size": 1},
    "TD3": {"buffer_size": 8, "learning_starts": 0, "batch_size": 1},
    "DDPG": {"buffer_size": 8, "learning_starts": 0, "batch_size": 1},
    "TQC": {"buffer_size": 8, "learning_starts": 0, "batch_size": 1},
}


@pytest.mark.parametrize("name", KINDS)
def test_trained_models_drive_as_they_did_before_they_were_stored(name, paper, car, tmp_path):
    package = sb3 if hasattr(sb3, name) else pytest.importorskip("sb3_contrib")
    path = tmp_path / "model.zip"
    env = car(observation="egocentric", obstacle_slots=4)
    model = save(path, getattr(package, name), env, **KINDS[name])
    model.learn(1)
    model.save(path)
    assert algorithm_of(path) == name
    row, controller = load_controller(str(path), paper, trust=True)
    assert row == "model"
    observed = np.random.default_rng(0).normal(size=(5, 31)).astype(np.float32)
    np.testing.assert_array_equal(
        controller.predict(observed)[0], model.predict(observed, deterministic=True)[0]
    )
    if name == "SAC":  # one of them through everything
        back = pickle.loads(pickle.dumps(controller))
        assert back.fingerprint() == controller.fingerprint()
        assert evaluate(back, paper, 20).total == evaluate(controller, paper, 20).total


class Loud:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def test_a_model_is_not_unpickled_without_trust(paper, car, tmp_path):
    path, trace = tmp_path / "model.zip", tmp_path / "trace"
    options = {**KINDS["PPO"], "policy_kwargs": {"net_arch": [4], "activation_fn": torch.nn.Tanh}}
    model = sb3.PPO("MlpPolicy", car(), device="cpu", **options)
    model.loud = Loud(str(trace))
    model.save(path)
    with pytest.raises(ValueError, match=r"PPO model .* runs the code .*--trust"):
        load_controller(str(path), paper)
    assert not trace.exists()
    load_controller(str(path), paper, trust=True)
    assert trace.exists()  # the danger is real


def test_models_of_other_worlds_are_refused_with_both_shapes(paper, tmp_path):
    import gymnasium as gym

    class Other(gym.Env):
        def __init__(self, observation, action):
            self.observation_space, self.action_space = observation, action

        def reset(self, *, seed=None, options=None):
            return self.observation_space.sample(), {}

    box = gym.spaces.Box
    car_actions, car_sees = box(-1.0, 1.0, (2,)), box(-1.0, 1.0, (12,))
    path = tmp_path / "model.zip"
    for observation, action, message in (
        (box(-1.0, 1.0, (7,)), car_actions, r"observations of shape \(7,\), .* \(12,\) features"),
        (car_sees, box(-2.0, 2.0, (2,)), r"actions Box\(-2.0, 2.0, .*Box\(-1.0, 1.0, \(2,\)\)"),
        (car_sees, gym.spaces.Discrete(3), r"actions Discrete\(3\)"),
    ):
        save(path, sb3.PPO, Other(observation, action), **KINDS["PPO"])
        with pytest.raises(ValueError, match=message):
            load_controller(str(path), paper, trust=True)
    save(path, sb3.DQN, Other(car_sees, gym.spaces.Discrete(3)), buffer_size=8)
    with pytest.raises(ValueError, match="discrete actions, which the car has not"):
        load_controller(str(path), paper, trust=True)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (None, "no model of Stable-Baselines3"),
        ({}, "say nothing of a policy"),
        ({"policy_class": {"__module__": "mine.policies"}}, "not known here .*mine.policies"),
    ],
)
def test_other_zips_are_refused(paper, tmp_path, data, message):
    path = tmp_path / "other.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data" if data is not None else "readme", json.dumps(data))
    with pytest.raises(ValueError, match=message):
        load_controller(str(path), paper, trust=True)
    with pytest.raises(FileNotFoundError):
        load_controller(str(tmp_path / "none.zip"), paper, trust=True)


def test_missing_packages_are_named(paper, car, tmp_path, monkeypatch):
    path = tmp_path / "model.zip"
    save(path, sb3.PPO, car(), **KINDS["PPO"])
    monkeypatch.setitem(__import__("sys").modules, "stable_baselines3", None)
    with pytest.raises(
        ImportError, match=r"PPO model, which needs stable_baselines3 .*pip install 'torch>="
    ):
        load_controller(str(path), paper, trust=True)

"""The shipped policies drive as the documentation says, on episodes they have never met."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import binomtest

from slipcar.baselines import (
    CloneConfig,
    PathwiseConfig,
    PPOConfig,
    load_policy,
    score,
    shipped_methods,
    shipped_runs,
)
from slipcar.envs import Family, Scenario, SlipCarEnv

EPISODES, SEED = 20_000, 7_000_000_000
CONFIGURATIONS = {"ppo": PPOConfig, "pathwise": PathwiseConfig, "cloned": CloneConfig}
#: Mean total cost that every run stays below, over 4000 episodes, whose error is 0.01.
MOST = {"ppo": 5.12, "pathwise": 5.03, "cloned": 5.03}
SHIPPED = [(world, method) for world in ("paper", "random") for method in shipped_methods(world)]


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
    assert {"torch", "stable-baselines3", "numpy", "python"} <= set(training["versions"])
    assert training["validation"]["total"] == pytest.approx(found.total, abs=0.05)
    assert policy.preparation_time > 10.0


def test_it_is_what_the_default_training_makes(policy):
    """`make train` makes these weights, on the versions in the record."""
    assert policy.fingerprint() == "a47397b0486a432f"
    assert policy.training["config"] == PPOConfig().to_dict()


@pytest.mark.parametrize(("world", "method"), SHIPPED)
def test_runs_differ_in_their_seed_alone(world, method):
    runs = shipped_runs(method, world)
    assert len(runs) >= 3
    assert [run.training["seed"] for run in runs] == list(range(len(runs)))
    assert len({run.fingerprint() for run in runs}) == len(runs)
    assert len({repr(run.training["config"]) for run in runs}) == 1
    if method in CONFIGURATIONS:
        fields = {field.name for field in dataclasses.fields(CONFIGURATIONS[method])}
        assert set(runs[0].training["config"]) == fields
    trained_on = Scenario.named("paper") if world == "paper" else Family.named(world)
    for run in runs:
        assert run.trained_on == trained_on
        history = run.training["history"]
        steps, seconds = ([entry[name] for entry in history] for name in ("steps", "seconds"))
        assert steps == sorted(steps)
        assert seconds == sorted(seconds)
        assert run.training["validation"]["total"] in {entry["total"] for entry in history}


@pytest.mark.parametrize("method", shipped_methods("paper"))
def test_every_run_drives_well(method):
    for run in shipped_runs(method, "paper"):
        found = score(run, "paper", 4000, SEED)
        assert found.total < MOST[method]
        assert found.collision_rate < 0.03


@pytest.mark.parametrize("method", shipped_methods("random"))
def test_runs_of_the_family_arrive_in_worlds_held_out(method):
    """They do not avoid obstacles as a planner does, but they arrive: standing costs 1300."""
    worlds = Family.named("random").held_out()
    for run in shipped_runs(method, "random"):
        found = score(run, worlds, 1000, SEED)
        assert found.total < 9.0
        assert found.position_rms < 0.15


def test_what_is_not_shipped_is_named():
    with pytest.raises(ValueError, match=r"no policies of method 'magic'.*'ppo'"):
        shipped_runs("magic")
    with pytest.raises(ValueError, match=r"no policies are shipped for world 'moon'.*'paper'"):
        shipped_runs("ppo", "moon")
    with pytest.raises(ValueError, match="world 'moon'"):
        shipped_methods("moon")
    with pytest.raises(ValueError, match=r"world '\.\.'"):
        shipped_methods("..")


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

"""Learning from plans: what is shown, what is copied from it, and how PPO goes on from there."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch

from slipcar.baselines import (
    CloneConfig,
    PPOConfig,
    clone_planner,
    load_policy,
    score,
    train_ppo,
    train_warm_started,
)
from slipcar.baselines.critic import adopt
from slipcar.baselines.demonstrations import TEACHING_SEED, demonstrate
from slipcar.baselines.learner import actor, make_learner
from slipcar.envs import Family, Scenario
from slipcar.envs.observation import Layout, decode
from slipcar.planner import Feedback, plan

PAPER = Scenario.named("paper")
FAMILY = Family.named("easy")
TINY = CloneConfig(episodes=40, epochs=1, hidden=(8, 8), validation_episodes=4)
SHORT = PPOConfig(
    total_steps=4 * 8 * 40,
    environments=8,
    minibatches=2,
    epochs=2,
    hidden=(8, 8),
    evaluate_every=2,
    validation_episodes=4,
    checkpoint_every=1,
)


class PowerCutError(Exception):
    pass


def power_cut(progress):
    if progress.iteration == 3:
        raise PowerCutError


def test_the_examples_are_what_planned_feedback_does():
    layout = Layout("features", 0)
    examples = demonstrate(PAPER, layout, worlds=1, episodes=20, noise=0.2, seed=3)
    assert examples.observations.shape == (20 * 40, 12)
    assert (examples.steps, examples.failures) == (800, 0)
    teacher = Feedback(plan(PAPER, feedback=True))
    wanted, _ = teacher.predict(examples.observations)
    np.testing.assert_allclose(examples.actions, wanted, atol=2e-4)
    assert decode(PAPER, examples.observations)[1][:, 1].std() > 0.1  # they go off the plan


def test_a_familys_examples_come_from_worlds_of_their_own():
    layout = Layout("state", 0)
    examples = demonstrate(FAMILY, layout, worlds=2, episodes=4, noise=0.0, seed=1)
    starts = examples.observations[:4]
    headings = [FAMILY.sample(TEACHING_SEED + 2 + i % 2).start[2] for i in range(4)]
    np.testing.assert_allclose(starts[:, 2], headings, rtol=1e-6)


def test_a_clone_drives_almost_as_well_as_its_teacher():
    """Seconds of imitation: within 1 % of the planned feedback it has seen."""
    policy = clone_planner(PAPER, CloneConfig(episodes=1000, epochs=5), seed=0)
    ours = score(policy, PAPER, 4000, seed=5)
    theirs = score(Feedback(plan(PAPER, feedback=True)), PAPER, 4000, seed=5)
    assert ours.total < 1.03 * theirs.total
    assert policy.training["history"][-1]["steps"] == 1000 * 40


def test_cloning_is_repeatable(tmp_path):
    runs = [clone_planner(PAPER, TINY, seed=seed, folder=tmp_path) for seed in (1, 0, 0)]
    assert runs[1].fingerprint() == runs[2].fingerprint() != runs[0].fingerprint()
    assert load_policy(tmp_path).fingerprint() == runs[2].fingerprint()


def test_ppo_starts_from_the_actor_with_a_critic_that_knows_it():
    config = CloneConfig(episodes=400, epochs=3, validation_episodes=4)
    initial = clone_planner(PAPER, config, seed=0)
    learner = make_learner(PAPER, PPOConfig(environments=64, log_std_init=-2.0), seed=0)
    adopt(learner, initial)
    for mine, theirs in zip(actor(learner, PAPER).weights, initial.weights, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    env = learner.get_env()
    env.seed(5)
    observation = torch.from_numpy(np.asarray(env.reset()))
    with torch.no_grad():
        expected = learner.policy.predict_values(observation)[:, 0].numpy()
    earned = np.zeros(64)
    for _ in range(40):
        action, _ = learner.predict(np.asarray(observation), deterministic=False)
        observation, reward, _, _ = env.step(action)
        earned += reward
    assert earned.mean() == pytest.approx(expected.mean(), rel=0.2)


def test_an_actor_of_another_shape_is_refused():
    initial = clone_planner(PAPER, dataclasses.replace(TINY, hidden=(9,)), seed=0)
    with pytest.raises(ValueError, match=r"layers \(12, 9, 2\).*\(12, 8, 8, 2\)"):
        train_ppo(PAPER, SHORT, initial=initial, progress=False)


@pytest.mark.parametrize("source", [PAPER, FAMILY])
def test_a_warm_started_run_resumes_to_the_bit(source, tmp_path):
    tiny = dataclasses.replace(TINY, worlds=2)
    options = {"cloning": tiny, "progress": False}
    whole = train_warm_started(source, SHORT, **options)
    with pytest.raises(PowerCutError):
        train_warm_started(source, SHORT, folder=tmp_path, callback=power_cut, **options)
    clone = (tmp_path / "clone.safetensors").stat().st_mtime_ns
    resumed = train_warm_started(source, SHORT, folder=tmp_path, **options)
    assert resumed.fingerprint() == whole.fingerprint()
    assert (tmp_path / "clone.safetensors").stat().st_mtime_ns == clone  # not made again
    steps = [entry["steps"] for entry in resumed.training["history"]]
    before = 40 * 40 + 4 * 8 * 40  # demonstrations, and what the critic was fitted to
    assert steps == [before, before + 640, before + 1280]
    seconds = [entry["seconds"] for entry in resumed.training["history"]]
    assert seconds[0] >= load_policy(tmp_path / "clone").training["seconds"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 0}, "episodes must be an integer >= 1"),
        ({"action_noise": -0.1}, "action_noise must be finite and >= 0"),
        ({"learning_rate": 0.0}, "learning_rate must be finite and > 0"),
    ],
)
def test_bad_configurations(changes, message):
    with pytest.raises(ValueError, match=message):
        CloneConfig(**changes)

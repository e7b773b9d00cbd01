"""The lighter goal at first: where it begins, where it ends, and that nothing else changes."""

import dataclasses

import numpy as np
import pytest

from slipcar.baselines import PathwiseConfig, PPOConfig
from slipcar.baselines.easing import eased
from slipcar.envs import Family, Scenario

PAPER, FAMILY = Scenario.named("paper"), Family.named("easy")


def weight(source):
    return (source.base if isinstance(source, Family) else source).goal_weight


@pytest.mark.parametrize("source", [PAPER, FAMILY])
def test_the_goal_weight_rises_geometrically_over_the_first_half(source):
    weights = np.array([weight(eased(source, 0.04, i, 8)) for i in range(8)])
    np.testing.assert_allclose(weights[0], 0.04 * weight(source))
    np.testing.assert_allclose(weights[1:5] / weights[:4], 0.04**-0.25)
    np.testing.assert_allclose(weights[4:], np.broadcast_to(weight(source), (4, 5)))


def test_nothing_else_changes():
    lighter = eased(FAMILY, 0.1, 0, 10)
    same_weight = lighter.replace(base=lighter.base.replace(goal_weight=weight(FAMILY)))
    assert same_weight == FAMILY
    assert eased(FAMILY, 1.0, 0, 10) is eased(FAMILY, 0.1, 5, 10) is FAMILY


@pytest.mark.parametrize("config", [PPOConfig, PathwiseConfig])
def test_shares_are_checked(config):
    for bad in (0.0, 1.01, -1.0, float("nan")):
        with pytest.raises(ValueError, match=r"goal_share must be in \(0, 1\]"):
            dataclasses.replace(config(), goal_share=bad)


def test_ppo_drives_for_the_lighter_goal():
    pytest.importorskip("stable_baselines3")
    from slipcar.baselines.learner import make_learner
    from slipcar.baselines.session import training_session

    config = PPOConfig(
        total_steps=2 * 8 * 40,
        environments=8,
        minibatches=2,
        epochs=1,
        hidden=(8,),
        goal_share=0.01,
    )
    seen = []
    with training_session():
        learner = make_learner(PAPER, config, seed=0)
        learner.after_iteration = lambda: seen.append(learner.rollout_buffer.rewards[-1].mean())
        learner.learn(config.total_steps)
    light, heavy = seen  # the last rewards of an episode, where the goal is paid for
    assert heavy == pytest.approx(100.0 * light, rel=0.3)

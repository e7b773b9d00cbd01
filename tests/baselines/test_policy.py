"""The actor in NumPy: what it computes, on what, and what it refuses."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slipcar.baselines import Policy, PPOConfig
from slipcar.envs import Family, Scenario

PAPER = Scenario.named("paper")


def make(seed=0, sizes=(12, 16, 8, 2), scale=0.4, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "weights": tuple(scale * rng.standard_normal((m, n)) for n, m in itertools.pairwise(sizes)),
        "biases": tuple(0.1 * rng.standard_normal(m) for m in sizes[1:]),
        "log_std": np.full(2, -1.0),
        "trained_on": PAPER,
    }
    return Policy(**{**fields, **changes})


def observations(n, seed=0):
    return np.random.default_rng(seed).standard_normal((n, 12)).astype(np.float32)


def test_two_layers_by_hand():
    W1, W2 = np.zeros((2, 12)), np.array([[1.0, 1.0], [0.5, 0.0]])
    W1[0, 0], W1[1, 4] = 1.0, -2.0
    policy = make(weights=(W1, W2), biases=(np.array([0.0, 1.0]), np.array([0.1, 0.0])))
    o = np.zeros((3, 12))
    o[0, 0] = 0.4  # hidden (0.4, 1.0)
    o[1, [0, 4]] = -3.0, 1.0  # both hidden units below zero: ReLU cuts them
    o[2, 0] = 5.0  # too large: clipped
    action, state = policy.predict(o)
    np.testing.assert_allclose(action, [[1.0, 0.2], [0.1, 0.0], [1.0, 1.0]], atol=1e-7)
    np.testing.assert_allclose(policy.mean(o)[0], [1.5, 0.2], atol=1e-7)
    assert action.dtype == np.float32
    assert state is None


def test_equals_the_torch_actor():
    torch = pytest.importorskip("torch")
    pytest.importorskip("stable_baselines3")
    from slipcar.baselines.learner import actor, make_learner

    learner = make_learner(PAPER, PPOConfig(environments=4), seed=1)
    with torch.no_grad():  # the last layer starts near zero, which would hide everything
        learner.policy.action_net.weight.mul_(60.0)
        for parameter in learner.policy.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    policy = actor(learner, PAPER)
    o = observations(2000)
    ours, _ = policy.predict(o)
    theirs, _ = learner.predict(o, deterministic=True)
    assert policy.sizes == (12, 64, 64, 2)
    assert 0.2 < np.mean(np.abs(theirs) < 1.0) < 1.0
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    np.testing.assert_array_equal(policy.log_std, learner.policy.log_std.detach().numpy())


@settings(max_examples=50, deadline=None)
@given(start=st.integers(0, 90), length=st.integers(0, 60))
def test_an_action_does_not_depend_on_the_batch_to_the_last_bit(start, length):
    policy, o = make(sizes=(12, 64, 64, 2)), observations(150)
    whole = policy.mean(o)
    np.testing.assert_array_equal(policy.mean(o[start : start + length]), whole[start:][:length])
    np.testing.assert_array_equal(policy.mean(o[start]), whole[start])


def test_any_leading_axes():
    policy, o = make(), observations(24)
    flat, _ = policy.predict(o)
    nested, state = policy.predict(o.reshape(2, 3, 4, 12), state="kept")
    np.testing.assert_array_equal(nested.reshape(24, 2), flat)
    assert state == "kept"
    assert policy.predict(np.zeros((0, 12)))[0].shape == (0, 2)
    assert policy.predict(list(map(float, o[0])))[0].shape == (2,)


def test_samples_scatter_as_log_std_says():
    policy = make(scale=0.05, log_std=np.log([0.1, 0.02]))
    o = np.repeat(observations(1), 20_000, axis=0)
    sample, _ = policy.predict(o, deterministic=False)
    mean, _ = policy.predict(o[0])
    error = sample - mean
    np.testing.assert_allclose(error.std(axis=0), [0.1, 0.02], rtol=0.03)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.004)


def test_what_an_evaluator_asks_for():
    policy = make(training={"seconds": 12.5})
    assert (policy.observation, policy.closed_loop) == ("features", True)
    assert policy.preparation_time == 12.5
    assert make().fingerprint() == make().fingerprint() == policy.fingerprint()
    changed = np.array(policy.biases[1])
    changed[0] = np.nextafter(changed[0], np.float32(1.0), dtype=np.float32)
    biases = (policy.biases[0], changed, policy.biases[2])
    assert make(biases=biases).fingerprint() != policy.fingerprint()


def test_it_knows_what_it_was_trained_on():
    assert make().knows(PAPER)
    assert not make().knows(PAPER.replace(clearance=0.2))
    family = Family.named("random")
    wide = make(trained_on=family)
    world = family.sample(3)
    assert wide.knows(world)
    assert wide.knows(PAPER)  # one that the family might have drawn
    for other in (
        world.replace(slip=(0.3, 0.03)),
        world.replace(nodes=21),
        world.replace(goal_weight=10.0),
        Family.named("crowded").sample(0),
    ):
        assert not wide.knows(other)


def test_is_read_only():
    policy = make()
    with pytest.raises(ValueError, match="read-only"):
        policy.weights[0][0, 0] = 1.0
    with pytest.raises(AttributeError):
        policy.log_std = np.zeros(2)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.zeros(6), r"12 entries on the last axis, not shape \(6,\)"),
        (np.zeros((4, 13)), r"not shape \(4, 13\)"),
        (0.0, r"not shape \(\)"),
        (np.where(np.arange(24).reshape(2, 12) == 15, np.nan, 0.0), r"observation\[1, 3\] is nan"),
        (np.full(12, np.inf), r"observation\[0\] is inf"),
        ("left", "array of 12 features, not str"),
        ({"features": 1}, "array of 12 features, not dict"),
    ],
)
def test_bad_observations(observation, message):
    with pytest.raises(ValueError, match=message):
        make().predict(observation)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": (), "biases": ()}, "at least one"),
        ({"biases": (np.zeros(16),)}, "as many weight matrices as biases"),
        ({"weights": (np.zeros((2, 6)),), "biases": (np.zeros(2),)}, r"\(2, 12\), not \(2, 6\)"),
        ({"weights": (np.zeros((3, 12)),), "biases": (np.zeros(2),)}, r"\(2, 12\), not \(3, 12\)"),
        ({"weights": (np.zeros((2, 12)),), "biases": (np.zeros(3),)}, r"\(2,\), not \(3,\)"),
        ({"log_std": np.zeros(3)}, r"log_std must have shape \(2,\)"),
        ({"log_std": np.array([0.0, np.nan])}, "log_std must be finite; 1 entries"),
    ],
)
def test_layers_that_do_not_fit(changes, message):
    with pytest.raises(ValueError, match=message):
        make(**changes)

"""The configuration: the measured numbers, and what it refuses."""

import dataclasses
import json
import re

import numpy as np
import pytest

from slipcar.baselines import CloneConfig, PathwiseConfig, PPOConfig


def test_defaults_are_the_measured_configuration():
    config = PPOConfig()
    rollout = config.environments * 40
    assert (config.environments, rollout // config.minibatches, config.epochs) == (256, 2560, 5)
    assert (config.learning_rate, config.gamma, config.gae_lambda) == (1e-3, 1.0, 0.95)
    assert (config.clip_range, config.entropy_weight, config.adam_epsilon) == (0.2, 0.0, 1e-5)
    assert (config.log_std_init, config.hidden, config.reward_scale) == (-1.0, (64, 64), 0.1)
    assert (config.total_steps, config.device) == (3_000_000, "cpu")


def test_iterations_are_whole_and_enough():
    assert PPOConfig(total_steps=10_240).iterations(40) == 1
    assert PPOConfig(total_steps=10_241).iterations(40) == 2


@pytest.mark.parametrize("kind", [PPOConfig, PathwiseConfig, CloneConfig])
def test_numpy_scalars_are_numbers(kind):
    """Also in what is kept of a training, which is JSON."""
    plain = kind()
    scalars = {
        name: np.array(value)[()] for name, value in vars(plain).items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    } | {"hidden": np.array(plain.hidden)}  # fmt: skip
    assert len(scalars) >= 7
    config = kind(**scalars)
    assert config == plain
    assert json.loads(json.dumps(config.to_dict())) == json.loads(json.dumps(plain.to_dict()))


def test_every_field_has_a_line_of_help():
    documented = set(re.findall(r"^        ([a-z_]+): \S", PPOConfig.__doc__, re.MULTILINE))
    assert documented == {field.name for field in dataclasses.fields(PPOConfig)}


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        ("total_steps", 0, "an integer >= 1"),
        ("environments", 2.5, "an integer >= 1"),
        ("epochs", True, "an integer >= 1"),
        ("checkpoint_every", -1, "an integer >= 1"),
        ("learning_rate", 0.0, "finite and > 0"),
        ("learning_rate", float("nan"), "finite and > 0"),
        ("reward_scale", -0.1, "finite and > 0"),
        ("entropy_weight", -1.0, "finite and >= 0"),
        ("gamma", 1.01, r"in \(0, 1\]"),
        ("gae_lambda", -0.1, r"in \[0, 1\]"),
        ("clip_range", 1.0, r"in \(0, 1\)"),
        ("log_std_init", float("inf"), r"in \[-10, 2\]"),
        ("log_std_init", "small", r"in \[-10, 2\]"),
        ("minibatches", 3, "must divide environments = 256"),
    ],
)
def test_bad_values(field, value, allowed):
    with pytest.raises(ValueError, match=rf"{field} must .*{allowed}|{field} {allowed}"):
        PPOConfig(**{field: value})


def test_bad_hidden_layers():
    with pytest.raises(ValueError, match=r"hidden\[1\] must be an integer >= 1, not 0"):
        PPOConfig(hidden=(64, 0))

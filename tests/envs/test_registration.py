"""The module-prefixed id works wherever an environment is made, in fresh processes too."""

import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest

from slipcar.envs import Scenario, SlipCarEnv, SlipCarVectorEnv

ENV_ID = "slipcar.envs:SlipCar-v0"


def test_make_gives_the_environment_and_passes_arguments_on():
    scenario = Scenario.named("gap")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(ENV_ID, scenario=scenario, observation="state", substeps=2)
        observation, _ = env.reset(seed=0)
        for _ in range(scenario.nodes - 1):
            observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        env.close()
    assert isinstance(env.unwrapped, SlipCarEnv)
    assert env.unwrapped.scenario is scenario
    assert env.unwrapped.substeps == 2
    assert observation.shape == (6,)
    assert terminated
    assert not truncated  # no TimeLimit: the horizon belongs to the problem


def test_make_vec_gives_the_native_vector_environment():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs = gym.make_vec(
            ENV_ID, num_envs=4, vectorization_mode="vector_entry_point", scenario="slalom"
        )
        envs.reset(seed=0)
        observations, *_ = envs.step(envs.action_space.sample())
    assert isinstance(envs.unwrapped, SlipCarVectorEnv)
    assert envs.unwrapped.scenario == Scenario.named("slalom")
    assert observations.shape == (4, 12)


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_gymnasiums_own_vector_environments_agree_with_the_native_one(mode):
    """`async` starts its workers with spawn, which imports everything afresh."""
    vector_kwargs = {"context": "spawn"} if mode == "async" else {}
    theirs = gym.make_vec(ENV_ID, 2, vectorization_mode=mode, vector_kwargs=vector_kwargs)
    ours = gym.make_vec(ENV_ID, 2, vectorization_mode="vector_entry_point", dtype="float64")
    try:
        rng = np.random.default_rng(0)
        np.testing.assert_array_equal(theirs.reset(seed=8)[0], ours.reset(seed=8)[0])
        for _ in range(5):
            actions = rng.uniform(-1, 1, (2, 2)).astype(np.float32)
            step, reference = theirs.step(actions), ours.step(actions)
            np.testing.assert_allclose(step[0], reference[0], rtol=1e-6, atol=1e-7)
            np.testing.assert_allclose(step[1], reference[1], rtol=1e-12)
    finally:
        theirs.close()


def test_the_id_needs_no_import_first():
    program = (
        "import gymnasium as gym\n"
        f"env = gym.make({ENV_ID!r}, scenario='paper', observation='features')\n"
        "print(env.reset(seed=0)[0].shape)\n"
        f"envs = gym.make_vec({ENV_ID!r}, num_envs=3, vectorization_mode='vector_entry_point')\n"
        "print(envs.reset(seed=0)[0].shape)\n"
    )
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split("\n")[:2] == ["(12,)", "(3, 12)"]


def test_a_process_that_only_drives_loads_neither_torch_nor_pygame():
    program = (
        "import sys, slipcar.envs\n"
        "slipcar.envs.SlipCarEnv().reset(seed=0)\n"
        "print({'torch', 'pygame', 'matplotlib'} & set(sys.modules))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert result.stdout.strip() == "set()", result.stderr

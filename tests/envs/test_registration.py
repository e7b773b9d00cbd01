"""The module-prefixed id works wherever an environment is made, in fresh processes too."""

import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from slipcar.envs import Family, Scenario, SlipCarEnv, SlipCarVectorEnv

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


@pytest.mark.parametrize(
    "arguments",
    [
        {"scenario": Scenario.named("gap"), "substeps": np.int64(2)},
        {"scenario": Family.named("random"), "observation": "egocentric"},
        {"scenario": "paper", "observation": "state", "obstacle_slots": np.int32(4)},
    ],
)
def test_the_spec_of_an_environment_is_json_that_makes_it_again(arguments):
    env = gym.make(ENV_ID, **arguments)
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    again = gym.make(spec)
    assert again.unwrapped.source == env.unwrapped.source
    assert again.unwrapped.layout == env.unwrapped.layout
    assert again.unwrapped.substeps == env.unwrapped.substeps
    np.testing.assert_array_equal(again.reset(seed=3)[0], env.reset(seed=3)[0])


def test_the_spec_of_a_vector_environment_is_json_that_makes_it_again():
    world = Scenario.named("gap")
    mode = AutoresetMode.SAME_STEP
    envs = gym.make_vec(ENV_ID, 3, scenario=world, autoreset_mode=mode, dtype=np.float64)
    again = gym.make_vec(gym.envs.registration.EnvSpec.from_json(envs.spec.to_json()))
    assert isinstance(again.unwrapped, SlipCarVectorEnv)
    assert (again.num_envs, again.unwrapped.scenario) == (3, world)
    assert again.metadata["autoreset_mode"] is mode
    np.testing.assert_array_equal(again.reset(seed=3)[0], envs.reset(seed=3)[0])


@pytest.mark.parametrize("limit", [10, 40, 100])
def test_a_vector_environment_is_cut_off_where_gymnasiums_own_is(limit):
    """`TimeLimit` in each of Gymnasium's sub-environments, over two episodes and their resets."""
    make = {"num_envs": 2, "max_episode_steps": limit}
    theirs = gym.make_vec(ENV_ID, vectorization_mode="sync", **make)
    ours = gym.make_vec(ENV_ID, vectorization_mode="vector_entry_point", dtype="float64", **make)
    theirs.reset(seed=1)
    ours.reset(seed=1)
    rng = np.random.default_rng(0)
    cut = 0
    for _ in range(84):
        actions = rng.uniform(-1, 1, (2, 2)).astype(np.float32)
        step, reference = ours.step(actions), theirs.step(actions)
        np.testing.assert_allclose(step[1], reference[1], rtol=1e-12)
        np.testing.assert_array_equal(step[2], reference[2])
        np.testing.assert_array_equal(step[3], reference[3])
        np.testing.assert_allclose(step[4]["goal"], reference[4]["goal"], rtol=1e-12)
        cut += int(step[3].sum())
    assert cut == {10: 14, 40: 4, 100: 0}[limit]


def test_episodes_that_are_cut_off_begin_again_at_once_with_same_step():
    envs = SlipCarVectorEnv(2, autoreset_mode="SameStep", max_episode_steps=5)
    envs.reset(seed=0)
    for _ in range(5):
        observation, _, terminated, truncated, info = envs.step(np.zeros((2, 2)))
    assert truncated.all()
    assert not terminated.any()
    assert info["_final_obs"].all()
    assert info["final_obs"][0][6] == pytest.approx(2 * 5 / 40 - 1)
    np.testing.assert_array_equal(observation[:, 6], -1.0)


@pytest.mark.parametrize("limit", [0, -2, 2.5])
def test_a_limit_that_is_none_is_refused(limit):
    with pytest.raises(ValueError, match=r"max_episode_steps must be .*at least 1"):
        SlipCarVectorEnv(2, max_episode_steps=limit)

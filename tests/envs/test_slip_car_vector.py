"""The vector environment is many single ones, in all three autoreset modes."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from slipcar.envs import Family, Scenario, SlipCarEnv, SlipCarVectorEnv
from slipcar.envs.observation import KINDS

PAPER = Scenario.named("paper")
# Four nodes an episode are too few to collide; twelve are enough and keep the tests short.
SHORT = PAPER.replace(nodes=13, control_bounds=(4.0, 4.0))


def random_actions(steps, num_envs, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform([-0.2, -0.7], 1, size=(steps, num_envs, 2)).astype(np.float32)


#: Tolerances of observations, and of what is computed in float64 from end to end.
TOLERANCES = {
    "float64": ({"rtol": 1e-6, "atol": 1e-7}, {"rtol": 1e-9, "atol": 1e-12}),
    "float32": ({"rtol": 1e-5, "atol": 5e-5}, {"rtol": 1e-6, "atol": 5e-5}),
}


def assert_same_info(ours, theirs, dtype):
    """Equal keys and masks, and equal values wherever the mask holds."""
    assert set(ours) == set(theirs)
    for key in theirs:
        if key.startswith("_"):
            np.testing.assert_array_equal(ours[key], theirs[key], err_msg=key)
        elif isinstance(theirs[key], dict):
            assert_same_info(ours[key], theirs[key], dtype)
        elif key == "final_obs":
            for i in np.flatnonzero(theirs["_final_obs"]):
                np.testing.assert_allclose(ours[key][i], theirs[key][i], **TOLERANCES[dtype][0])
        else:
            for i in np.flatnonzero(theirs[f"_{key}"]):
                np.testing.assert_allclose(
                    ours[key][i], theirs[key][i], err_msg=key, **TOLERANCES[dtype][1]
                )


def assert_same_step(ours, theirs, dtype):
    for mine, reference, tolerance in zip(ours, theirs[:-1], [0, 1, 1, 1], strict=False):
        assert mine.dtype == reference.dtype
        assert mine.shape == reference.shape
        np.testing.assert_allclose(mine, reference, **TOLERANCES[dtype][tolerance])
    assert_same_info(ours[-1], theirs[-1], dtype)


#: One scenario; the same with every kind of noise; and worlds that differ.
SOURCES = {
    "short": {"scenario": SHORT},
    "noisy": {
        "scenario": SHORT.replace(
            process_noise=(0.05, 0.0, 0.0, 0.2, 0.1), start_deviation=(0.1, 0.1, 0.05, 0.0, 0.1)
        ),
        "substeps": 2,
        "obstacle_slots": 5,
    },
    "family": {
        "scenario": Family(base=SHORT.replace(obstacles=None), slip=(0.0, 0.3), horizon=(4, 6)),
        "obstacle_slots": 8,
    },
}


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("terminate", [False, True])
@pytest.mark.parametrize(
    ("source", "kind", "dtype"),
    [
        ("short", "features", "float64"),
        ("short", "state", "float32"),
        ("noisy", "features", "float32"),
        ("noisy", "egocentric", "float64"),
        ("family", "state", "float64"),
        ("family", "egocentric", "float32"),
    ],
)
def test_agrees_with_gymnasiums_sync_vector_env(mode, terminate, source, kind, dtype):
    num_envs, steps = 6, 60
    options = {
        "observation": kind,
        "terminate_on_collision": terminate,
        **SOURCES[source],
    }
    ours = SlipCarVectorEnv(num_envs, autoreset_mode=mode, dtype=dtype, **options)
    theirs = SyncVectorEnv([lambda: SlipCarEnv(**options)] * num_envs, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert_same_step(ours.reset(seed=42), theirs.reset(seed=42), dtype)
    ends, collisions = np.zeros((steps, num_envs), dtype=bool), np.zeros(num_envs, dtype=bool)
    for k, actions in enumerate(random_actions(steps, num_envs)):
        mine = ours.step(actions)
        assert_same_step(mine, theirs.step(actions), dtype)
        ends[k] = over = mine[2]
        assert not mine[3].any()
        collisions |= mine[4]["collision"]
        if mode is AutoresetMode.DISABLED and over.any():
            again = [env.reset(options={"reset_mask": over.copy()}) for env in (ours, theirs)]
            # On a masked reset Gymnasium reports the others as not there; so do we.
            assert_same_step(*again, dtype)
    assert (ends.sum(axis=0) >= 3).all()
    together = all(row.all() or not row.any() for row in ends)
    assert together is not terminate  # with it, sub-environments are at different times
    if not terminate and source != "family":
        assert collisions.any()


@pytest.mark.parametrize("mode", AutoresetMode)
def test_final_observations_and_infos_are_those_of_the_episode_that_ended(mode):
    envs = SlipCarVectorEnv(3, SHORT, observation="state", autoreset_mode=mode)
    start, _ = envs.reset(seed=1)
    for actions in random_actions(SHORT.nodes - 1, 3):
        observation, _, terminated, _, info = envs.step(actions)
    assert terminated.all()
    if mode is AutoresetMode.SAME_STEP:
        np.testing.assert_array_equal(observation, start)  # of the next episode
        last = np.stack(info["final_obs"])
        assert (info["final_info"]["goal"] > 0).all()
        assert (info["goal"] == 0).all()
    else:
        last = observation
        assert "final_obs" not in info
        assert (info["goal"] > 0).all()
    np.testing.assert_allclose(last[:, 5], SHORT.horizon)


@pytest.mark.parametrize("kind", KINDS)
def test_each_path_is_the_single_environments(kind):
    num_envs, seed = 5, 100
    envs = SlipCarVectorEnv(num_envs, PAPER, observation=kind, dtype="float64")
    actions = random_actions(PAPER.nodes - 1, num_envs)
    observations = [envs.reset(seed=seed)[0]]
    rewards = []
    for a in actions:
        observation, reward, *_ = envs.step(a)
        observations.append(observation)
        rewards.append(reward)
    for i in range(num_envs):
        env = SlipCarEnv(PAPER, observation=kind)
        alone = [env.reset(seed=seed + i)[0]]
        for k, a in enumerate(actions[:, i]):
            observation, reward, *_ = env.step(a)
            alone.append(observation)
            assert reward == pytest.approx(rewards[k][i], rel=1e-12, abs=1e-12)
        np.testing.assert_allclose(np.array(observations)[:, i], alone, rtol=1e-6, atol=1e-7)


def test_a_path_does_not_depend_on_how_many_run_beside_it():
    actions = random_actions(30, 9)
    few, many = SlipCarVectorEnv(2, SHORT), SlipCarVectorEnv(9, SHORT)
    few.reset(seed=5)
    many.reset(seed=5)
    for a in actions:  # over more than two episodes
        np.testing.assert_array_equal(few.step(a[:2])[0], many.step(a)[0][:2])


def test_seeds_may_be_given_one_by_one_and_none_goes_on():
    one = SlipCarVectorEnv(2, SHORT, autoreset_mode="Disabled")
    other = SlipCarVectorEnv(2, SHORT, autoreset_mode="Disabled")
    one.reset(seed=[7, 3])
    other.reset(seed=np.array([3, 7]).tolist())
    a = random_actions(1, 1)[0].repeat(2, axis=0)
    for _ in range(2):  # from standstill the first step has no noise
        mine, crossed = one.step(a)[0], other.step(a)[0]
    np.testing.assert_array_equal(mine, crossed[::-1])
    assert not np.array_equal(mine[0], mine[1])
    one.reset()
    for _ in range(2):
        second_episode = one.step(a)[0]
    assert not np.array_equal(second_episode, mine)


def test_what_reset_and_step_return_is_the_callers_to_keep():
    envs = SlipCarVectorEnv(2, SHORT)
    kept = [envs.reset(seed=0)]
    copies = [(kept[0][0].copy(), {k: v.copy() for k, v in kept[0][1].items()})]
    for actions in random_actions(20, 2):
        observation, reward, terminated, truncated, info = envs.step(actions)
        kept.append((observation, {**info, "r": reward, "t": terminated, "u": truncated}))
        copies.append((observation.copy(), {k: v.copy() for k, v in kept[-1][1].items()}))
    for (observation, info), (o, i) in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(observation, o)
        for key in info:
            np.testing.assert_array_equal(info[key], i[key])


def test_gymnasiums_vector_wrappers_work():
    envs = RecordEpisodeStatistics(SlipCarVectorEnv(3, SHORT, autoreset_mode="SameStep"))
    envs.reset(seed=0)
    total = np.zeros(3)
    for actions in random_actions(SHORT.nodes - 1, 3):
        _, reward, *_, info = envs.step(actions)
        total += reward
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-6)
    np.testing.assert_array_equal(info["episode"]["l"], SHORT.nodes - 1)


# ------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs must be at least 1, not 0"),
        ({"num_envs": -3}, "num_envs must be at least 1, not -3"),
        ({"num_envs": 2.0}, "num_envs must be an integer at least 1, not 2.0"),
        ({"scenario": "papre"}, r"unknown scenario 'papre'; the named ones are \['paper'"),
        ({"observation": "pixels"}, r"unknown observation 'pixels'; the kinds are \['features'"),
        ({"substeps": 0}, "substeps must be at least 1, not 0"),
        ({"autoreset_mode": "now"}, r"unknown autoreset_mode 'now'; allowed are \['NextStep'"),
        (
            {"scenario": PAPER.replace(control_bounds=None)},
            "control_bounds is None: .* need bounds",
        ),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        SlipCarVectorEnv(**{"num_envs": 2, **arguments})


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((2, 2)), r"action must have shape \(3, 2\), not \(2, 2\)"),
        (np.zeros(2), r"action must have shape \(3, 2\), not \(2,\)"),
        (np.zeros((3, 1)), r"action must have shape \(3, 2\), not \(3, 1\)"),
        (np.array([[0, 0], [0, 0], [0, np.nan]]), r"action\[2, 1\] is nan; actions must be fin"),
        (np.array([[0, 0], [np.inf, 0], [0, 0]]), r"action\[1, 0\] is inf; actions must be fin"),
    ],
)
def test_bad_actions(actions, message):
    envs = SlipCarVectorEnv(3)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        envs.step(actions)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"options": {"begin": 1}},
            ValueError,
            r"unknown reset options \['begin'\]; known are \['reset_mask', 'scenario', 'start', 'n",
        ),
        ({"options": {"reset_mask": np.ones(2, bool)}}, ValueError, r"shape \(3,\).*not bool.*2"),
        ({"options": {"reset_mask": np.zeros(3, bool)}}, ValueError, "at least one True"),
        ({"options": {"reset_mask": np.ones(3)}}, ValueError, "bool array .* not float64"),
        ({"seed": [1, 2]}, ValueError, r"seed must be None, an int or 3 of them, not \[1, 2\]"),
        ({"seed": 1.5}, ValueError, "seed must be None, an int or 3 of them, not 1.5"),
        ({"seed": -5}, gym.error.Error, "greater or equal to zero, actual value: -5"),
    ],
)
def test_bad_resets(arguments, error, message):
    with pytest.raises(error, match=message):
        SlipCarVectorEnv(3).reset(**arguments)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_steps_need_a_reset(mode):
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before step\(\)"):
        SlipCarVectorEnv(3, autoreset_mode=mode).step(np.zeros((3, 2)))


def test_without_autoreset_a_finished_episode_takes_no_step():
    envs = SlipCarVectorEnv(3, SHORT, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=0)
    for actions in random_actions(SHORT.nodes - 1, 3):
        envs.step(actions)
    with pytest.raises(ResetNeeded, match=r"\[0, 1, 2\] are over: reset them"):
        envs.step(actions)
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(ResetNeeded, match=r"\[1\] are over: reset them"):
        envs.step(actions)
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    envs.step(actions)


def test_a_partial_first_reset_leaves_the_others_at_the_start():
    envs = SlipCarVectorEnv(3, observation="state")
    observation, info = envs.reset(seed=0, options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_allclose(observation, np.tile([*PAPER.start, 0.0], (3, 1)))
    np.testing.assert_array_equal(info["_clearance"], [False, True, False])

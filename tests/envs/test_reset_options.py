"""Another world, start or noise at reset, in one environment and in many."""

import gymnasium as gym
import numpy as np
import pytest

from slipcar.envs import Family, Scenario, SlipCarEnv, SlipCarVectorEnv
from slipcar.envs.transition import transition

PAPER = Scenario.named("paper")
SLALOM = Scenario.named("slalom")
NOISY = PAPER.replace(nodes=13, process_noise=(0.1, 0, 0, 0.2, 0), start_deviation=0.05)
RNG = np.random.default_rng(0)


def test_a_scenario_stays_until_another_is_given():
    env = SlipCarEnv()
    for given, expected in ((None, PAPER), ("slalom", SLALOM), (None, SLALOM), (PAPER, PAPER)):
        env.reset(seed=0, options=None if given is None else {"scenario": given})
        assert env.scenario == expected
        steps = 0
        while not env.step(np.zeros(2))[2]:
            steps += 1
        assert steps + 1 == expected.nodes - 1


@pytest.mark.parametrize("given", [SLALOM.to_json(), SLALOM.to_dict(), "slalom"])
def test_a_scenario_may_be_given_as_data(given):
    env = SlipCarEnv()
    env.reset(options={"scenario": given})
    assert env.scenario == SLALOM


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_each_sub_environment_may_have_its_own(mode):
    """Of other lengths, noises and numbers of obstacles; each goes as it would alone."""
    worlds = [PAPER.replace(nodes=9), NOISY, Scenario.named("open").replace(nodes=7, slip=(1, 1))]
    envs = SlipCarVectorEnv(3, observation="egocentric", obstacle_slots=4, autoreset_mode=mode)
    alone = [SlipCarEnv(w, observation="egocentric", obstacle_slots=4) for w in worlds]
    observation, _ = envs.reset(seed=7, options={"scenario": worlds})
    assert envs.scenarios == worlds
    expected = [env.reset(seed=7 + i)[0] for i, env in enumerate(alone)]
    np.testing.assert_allclose(observation, expected, atol=2e-5)
    over = np.zeros(3, dtype=bool)
    for _ in range(30):
        actions = RNG.uniform(-1, 1, (3, 2)).astype(np.float32)
        if mode == "Disabled" and over.any():
            observation, _ = envs.reset(options={"reset_mask": over.copy()})
            for i in np.flatnonzero(over):
                np.testing.assert_allclose(observation[i], alone[i].reset()[0], atol=2e-5)
        observation, reward, terminated, _, info = envs.step(actions)
        for i, env in enumerate(alone):
            if mode == "NextStep" and over[i]:
                seen, paid, ends = env.reset()[0], 0.0, False
            else:
                seen, paid, ends, *_ = env.step(actions[i])
                if mode == "SameStep" and ends:
                    np.testing.assert_allclose(info["final_obs"][i], seen, atol=2e-4)
                    seen = env.reset()[0]
            np.testing.assert_allclose(observation[i], seen, atol=2e-4)
            assert reward[i] == pytest.approx(paid, rel=1e-5, abs=1e-4)
            assert terminated[i] == ends
        over = terminated.copy()
    envs.reset(seed=1, options={"scenario": "paper"})  # and together again
    assert envs.scenarios == [PAPER] * 3


ON_SPEED = Scenario.named("open").replace(process_noise=(0, 0, 0, 0.3, 0))
ON_POSITION = Scenario.named("open").replace(process_noise=(0.3, 0, 0, 0, 0))


@pytest.mark.parametrize("worlds", [[ON_SPEED, ON_POSITION], [ON_POSITION, ON_SPEED]])
def test_each_world_has_its_own_process_noise(worlds):
    envs = SlipCarVectorEnv(2, "open", dtype="float64")
    envs.reset(seed=5, options={"scenario": worlds})
    for _ in range(10):
        envs.step(np.zeros((2, 2)))
    for i, world in enumerate(worlds):
        env = SlipCarEnv(world)
        env.reset(seed=5 + i)
        for _ in range(10):
            env.step(np.zeros(2))
        np.testing.assert_allclose(envs.states[i], env.state, rtol=1e-12)
        assert np.abs(env.state).max() > 0.05


def test_a_newcomer_leaves_the_others_on_their_paths():
    newcomers = [ON_POSITION, PAPER.replace(nodes=81), Family.named("easy"), SLALOM]
    for newcomer in newcomers:
        envs, alone = SlipCarVectorEnv(2, ON_SPEED), SlipCarVectorEnv(2, ON_SPEED)
        for each in (envs, alone):
            each.reset(seed=0)
        for k in range(30):
            if k == 5:
                mask = np.array([False, True])
                envs.reset(options={"reset_mask": mask, "scenario": newcomer})
            for each in (envs, alone):
                each.step(np.full((2, 2), 0.1))
        np.testing.assert_array_equal(envs.states[0], alone.states[0])
        assert envs.scenarios[0] == ON_SPEED


def test_a_harder_family_may_follow_an_easy_one():
    easy, hard = Family.named("easy"), Family.named("crowded")
    envs = SlipCarVectorEnv(40, easy, observation="egocentric", obstacle_slots=14)
    envs.reset(seed=0)
    assert max(len(world.obstacles) for world in envs.scenarios) == 2
    observation, _ = envs.reset(options={"scenario": hard})
    counts = [len(world.obstacles) for world in envs.scenarios]
    assert min(counts) == 8
    assert max(counts) == 14
    np.testing.assert_array_equal(observation[:, 18::4].sum(axis=1), counts)


@pytest.mark.parametrize("scenario", [PAPER, NOISY])
def test_noise_and_start_are_followed(scenario):
    steps = scenario.nodes - 1
    noise = RNG.standard_normal((2, steps, 1, scenario.noise_dim))
    starts = scenario.start + 0.1 * RNG.standard_normal((2, 5))
    actions = RNG.uniform(-1, 1, (steps, 2, 2))
    x = starts
    for k in range(steps):
        x = transition(scenario, x, actions[k] * scenario.action_scale, noise[:, k]).state
    options = {"noise": noise, "start": starts}
    envs = SlipCarVectorEnv(2, scenario, dtype="float64", autoreset_mode="Disabled")
    envs.reset(options=options)
    for action in actions:
        envs.step(action)
    np.testing.assert_allclose(envs.states, x, atol=1e-5)  # noise is kept in float32
    for i in range(2):
        env = SlipCarEnv(scenario)
        env.reset(options={"noise": noise[i], "start": starts[i]})
        np.testing.assert_array_equal(env.state, starts[i])
        for action in actions[:, i]:
            env.step(action)
        np.testing.assert_allclose(env.state, x[i], rtol=1e-12)


def test_what_is_given_for_one_episode_is_gone_in_the_next():
    given = {"noise": np.zeros((40, 1, 3)), "start": np.ones(5)}
    env, plain = SlipCarEnv(), SlipCarEnv()
    env.reset(seed=3, options=given)
    plain.reset(seed=3)
    for each in (env, plain):
        each.reset()
        for action in np.full((5, 2), 0.5):
            each.step(action)
    np.testing.assert_array_equal(env.state, plain.state)


# ------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenario": "papre"}, r"unknown scenario 'papre'"),
        ({"scenario": 3}, "expected a Scenario, one of the names"),
        ({"scenario": PAPER.replace(control_bounds=None)}, "control_bounds is None"),
        ({"scenario": Scenario.random(0, 8)}, "8 obstacles and the observation shows 4: pass obst"),
        ({"noise": np.zeros((40, 3))}, r"noise must have shape \(.*40, 1, 3\), not \(40, 3\)"),
        ({"start": [0.0, 1.0]}, r"start must have shape \(.*5\), not \(2,\)"),
        ({"start": np.full((1, 5), np.nan)}, "start"),
        ({"state": np.zeros(5)}, r"unknown reset options \['state'\]"),
    ],
)
@pytest.mark.parametrize("make", [SlipCarEnv, lambda **kw: SlipCarVectorEnv(1, **kw)])
def test_bad_options(make, options, message):
    env = make(obstacle_slots=4)
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)


def test_other_refusals():
    with pytest.raises(ValueError, match=r"scenario has up to 4 obstacles .* shows 2: pass obst"):
        SlipCarEnv(obstacle_slots=2)
    with pytest.raises(ValueError, match=r"family has up to 8 obstacles .* shows 3"):
        SlipCarVectorEnv(2, "family:random", obstacle_slots=3)
    with pytest.raises(ValueError, match="obstacle_slots must be at least 0, not -1"):
        SlipCarEnv(obstacle_slots=-1)
    with pytest.raises(ValueError, match="lasts 12 s, longer than the 5 s"):
        SlipCarEnv(observation="state").reset(options={"scenario": "slalom"})
    with pytest.raises(ValueError, match="one or a list of 3, not of 2"):
        SlipCarVectorEnv(3).reset(options={"scenario": ["paper", "paper"]})
    with pytest.raises(ValueError, match=r"unknown dtype 'float16'; allowed are \['float32'"):
        SlipCarVectorEnv(3, dtype="float16")


REFUSED = [
    {"options": {"foo": 1}},
    {"options": [1]},
    {"options": {"scenario": Scenario.random(0, 8)}},
    {"options": {"scenario": "slalom", "start": np.ones(2)}},
    {"options": {"scenario": "slalom", "noise": np.zeros((3, 1, 3))}},
    {"options": {"start": np.full(5, np.nan)}},
    {"options": {"start": np.full(5, 1e20)}},
    {"seed": -5},
]


@pytest.mark.parametrize("arguments", REFUSED)
@pytest.mark.parametrize(
    "make", [SlipCarEnv, lambda **kw: SlipCarVectorEnv(1, autoreset_mode="SameStep", **kw)]
)
def test_a_refused_reset_changes_nothing(make, arguments):
    env, plain = make(obstacle_slots=4), make(obstacle_slots=4)
    shape = env.action_space.shape
    for each in (env, plain):
        each.reset(seed=0)
        each.step(np.full(shape, 0.3))
    with pytest.raises((ValueError, gym.error.Error)):
        env.reset(**{"seed": 3, **arguments})
    assert env.scenario == PAPER
    for _ in range(5):
        here, there = (each.step(np.full(shape, 0.3)) for each in (env, plain))
        np.testing.assert_array_equal(here[0], there[0])
    for each in (env, plain):  # and the generators stand where they stood
        each.reset()
    for _ in range(5):
        here, there = (each.step(np.full(shape, 0.3)) for each in (env, plain))
    np.testing.assert_array_equal(here[0], there[0])

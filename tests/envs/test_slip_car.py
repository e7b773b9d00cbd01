"""The single environment: its checkers, its return, its randomness, and bad input."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env

from slipcar.envs import Scenario, SlipCarEnv, cost
from slipcar.envs.episode import draw_episode
from slipcar.envs.integrate import euler_maruyama
from slipcar.envs.observation import KINDS

ENV_ID = "slipcar.envs:SlipCar-v0"
PAPER = Scenario.named("paper")


def play(env, actions, seed):
    """Observations, rewards and infos of one episode, from reset to termination."""
    observation, info = env.reset(seed=seed)
    observations, rewards, infos = [observation], [], [info]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        assert truncated is False
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
        if terminated:
            break
    assert terminated
    return np.array(observations), np.array(rewards), infos


def random_actions(scenario, seed, forward=0.0):
    rng = np.random.default_rng(seed)
    return rng.uniform([-1 + forward, -1], 1, size=(scenario.nodes - 1, 2)).astype(np.float32)


def path_of(scenario, controls, seed, substeps):
    """The states (N, 5) that seed and controls must lead to, integrated here."""
    noise = draw_episode(seeding.np_random(seed)[0], scenario, substeps).noise
    states = [scenario.start]
    for u, z in zip(controls, noise, strict=False):
        states.append(euler_maruyama(states[-1], u, scenario.dt, z, scenario.slip))
    return np.array(states)


# -------------------------------------------------------------------------------------- checkers


def ignore_no_bounds():
    """As Gymnasium's own tests do: its checker says "probably too low" of every Box(-inf, inf)."""
    warnings.filterwarnings("ignore", message=r".*space (min|max)imum value is -?infinity")


@pytest.mark.parametrize("kind", KINDS)
def test_gymnasiums_checker_finds_nothing(kind):
    env = gym.make(ENV_ID, observation=kind).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ignore_no_bounds()
        check_env(env, skip_render_check=True)


def test_gymnasiums_checker_finds_nothing_in_rendering(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # the checker tries "human" too
    env = gym.make(ENV_ID, render_mode="rgb_array").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ignore_no_bounds()
        check_env(env)


@pytest.mark.parametrize("kind", KINDS)
def test_stable_baselines3s_checker_finds_nothing(kind):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(SlipCarEnv(observation=kind), warn=True)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scenario", [*Scenario.names(), Scenario.random(11, turned=True)])
def test_a_random_policy_stays_in_the_spaces(kind, scenario):
    env = SlipCarEnv(scenario, observation=kind)
    env.action_space.seed(0)
    for seed in range(5):
        observations, rewards, _ = play(
            env, [env.action_space.sample() for _ in range(env.scenario.nodes - 1)], seed
        )
        assert len(rewards) == env.scenario.nodes - 1
        assert np.isfinite(rewards).all()
        for observation in observations:
            assert env.observation_space.contains(observation)


# ---------------------------------------------------------------------------- what an episode is


# The start lies in a clearance ring: node 0 must not be paid for, the last one must.
HEMMED_IN = PAPER.replace(obstacles=[[0.3, 0.0, 0.25], [-0.5, 0.0, 0.4], [1.5, 0.5, 0.8]])


@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize(
    "scenario", [PAPER, HEMMED_IN, Scenario.random(2, turned=True, goal_weight=7.0)]
)
@pytest.mark.parametrize("seed", range(5))
def test_the_return_is_minus_the_cost_of_the_path(scenario, substeps, seed):
    env = SlipCarEnv(scenario, observation="state", substeps=substeps)
    observations, rewards, infos = play(env, random_actions(scenario, seed, 0.5), seed)
    controls = np.array([info["control"] for info in infos[1:]])
    states = path_of(scenario, controls, seed, substeps)
    np.testing.assert_allclose(observations[:, :5], states, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(observations[:, 5], scenario.times, atol=1e-6)

    dt, after = scenario.dt, states[1:]
    efforts = dt * cost.control_power(controls)
    obstacles = dt * cost.obstacle_power(
        after, scenario.obstacles, scenario.clearance, scenario.obstacle_weight
    )
    for name, values in (("effort", efforts), ("obstacle", obstacles)):
        steps = [info[name] for info in infos]
        np.testing.assert_allclose(steps, [0.0, *values], rtol=1e-9, atol=1e-12)
    effort, obstacle = efforts.sum(), obstacles.sum()
    goal = cost.goal_cost(states[-1], scenario.goal, scenario.goal_weight)
    total = effort + obstacle + goal
    assert abs(-rewards.sum() - total) <= 1e-9 * max(1.0, total)
    for name, value in (("effort", effort), ("obstacle", obstacle), ("goal", goal)):
        assert sum(info[name] for info in infos) == pytest.approx(value, rel=1e-12)
    distance = cost.signed_distance(after, scenario.obstacles)
    assert infos[-1]["clearance"] == pytest.approx(min(distance.min(), infos[0]["clearance"]))
    assert infos[-1]["collision"] == bool((distance < 0.0).any())


def test_random_driving_meets_both_outcomes():
    """Otherwise the collision flags above would not have been tried."""
    outcomes = {
        play(SlipCarEnv(), random_actions(PAPER, seed, 0.5), seed)[2][-1]["collision"]
        for seed in range(30)
    }
    assert outcomes == {False, True}


def test_collision_and_clearance_are_so_far():
    for seed in range(30):
        infos = play(SlipCarEnv(), random_actions(PAPER, seed, 0.5), seed)[2]
        collisions = np.array([info["collision"] for info in infos])
        clearances = np.array([info["clearance"] for info in infos])
        assert (np.diff(collisions.astype(int)) >= 0).all()
        assert (np.diff(clearances) <= 0).all()
        np.testing.assert_array_equal(collisions, clearances < 0.0)


def test_only_the_last_step_pays_for_the_goal():
    _, _, infos = play(SlipCarEnv(), random_actions(PAPER, 0), 0)
    assert all(info["goal"] == 0.0 for info in infos[:-1])
    assert infos[-1]["goal"] > 0.0


def test_terminating_at_a_collision_cuts_the_same_path():
    cut_short = 0
    for seed in range(30):
        actions = random_actions(PAPER, seed, 0.5)
        whole = play(SlipCarEnv(observation="state"), actions, seed)
        cut = play(SlipCarEnv(observation="state", terminate_on_collision=True), actions, seed)
        hits = [info["collision"] for info in whole[2]]
        length = hits.index(True) if True in hits else PAPER.nodes - 1
        assert len(cut[1]) == length
        np.testing.assert_array_equal(cut[0], whole[0][: length + 1])
        np.testing.assert_array_equal(cut[1][:-1], whole[1][: length - 1])
        last = cut[2][-1]
        assert cut[1][-1] == -(last["effort"] + last["obstacle"] + last["goal"])
        assert last["goal"] > 0.0
        cut_short += length < PAPER.nodes - 1
    assert cut_short > 0


def test_the_same_seed_and_actions_give_the_same_path():
    actions = random_actions(PAPER, 0)
    env = SlipCarEnv()
    first, again = play(env, actions, 5), play(env, actions, 5)
    fresh = play(SlipCarEnv(), actions, 5)
    for other in (again, fresh):
        np.testing.assert_array_equal(first[0], other[0])
        np.testing.assert_array_equal(first[1], other[1])


def test_another_seed_gives_another_path_and_so_does_the_next_episode():
    actions = random_actions(PAPER, 0)
    env = SlipCarEnv()
    paths = [play(env, actions, seed)[0] for seed in (5, 6, None, None)]
    for i in range(4):
        for j in range(i):
            assert not np.array_equal(paths[i], paths[j])


def test_the_action_does_not_change_the_noise():
    """Controllers are compared on the same Brownian paths."""
    seed = 3
    ends = []
    for actions in (random_actions(PAPER, 1), random_actions(PAPER, 2)):
        env = SlipCarEnv(observation="state")
        observations, _, infos = play(env, actions, seed)
        controls = np.array([info["control"] for info in infos[1:]])
        states = path_of(PAPER, controls, seed, 1)
        np.testing.assert_allclose(observations[:, :5], states, atol=1e-6)
        ends.append(states[-1])
    assert not np.allclose(*ends)


def test_actions_are_clipped_to_the_bounds():
    env = SlipCarEnv()
    wild = play(env, np.full((40, 2), [3.0, -70.0]), 0)
    tame = play(env, np.full((40, 2), [1.0, -1.0]), 0)
    np.testing.assert_array_equal(wild[0], tame[0])
    np.testing.assert_array_equal(wild[2][1]["control"], PAPER.control_bounds * [1, -1])


# ------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenario": "papre"}, r"unknown scenario 'papre'; the named ones are \['paper'"),
        ({"scenario": 3}, r"a Scenario, one of the names \['paper'.*, not int"),
        ({"observation": "pixels"}, r"unknown observation 'pixels'; the kinds are \['features'"),
        ({"substeps": 0}, "substeps must be at least 1, not 0"),
        ({"substeps": 1.5}, "substeps must be an integer at least 1, not 1.5"),
        ({"render_mode": "ascii"}, r"unknown render_mode 'ascii'; allowed are None and \['rgb"),
        (
            {"scenario": PAPER.replace(control_bounds=None)},
            "control_bounds is None: .* need bounds",
        ),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        SlipCarEnv(**arguments)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([0.0, np.nan], r"action\[1\] is nan; actions must be finite"),
        ([np.inf, 0.0], r"action\[0\] is inf; actions must be finite"),
        ([0.0], r"action must have shape \(2,\), not \(1,\)"),
        ([0.0, 0.0, 0.0], r"action must have shape \(2,\), not \(3,\)"),
        ([[0.0, 0.0]], r"action must have shape \(2,\), not \(1, 2\)"),
        (0.5, r"action must have shape \(2,\), not \(\)"),
        (None, r"action must have shape \(2,\), not \(\)"),
    ],
)
def test_bad_actions_are_refused_and_change_nothing(action, message):
    actions = random_actions(PAPER, 0)
    undisturbed = play(SlipCarEnv(), actions, 0)
    env = SlipCarEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(action)
    observation = [env.step(a)[0] for a in actions][-1]
    np.testing.assert_array_equal(observation, undisturbed[0][-1])


def test_steps_need_a_running_episode():
    env = SlipCarEnv()
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before step\(\)"):
        env.step(np.zeros(2))
    play(env, random_actions(PAPER, 0), 0)
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before step\(\)"):
        env.step(np.zeros(2))


def test_unknown_reset_options_are_refused():
    message = r"unknown reset options \['begin'\]; known are \['scenario', 'start', 'noise'\]"
    with pytest.raises(ValueError, match=message):
        SlipCarEnv().reset(options={"begin": 0})


def test_a_negative_seed_is_refused():
    with pytest.raises(gym.error.Error, match="greater or equal to zero, actual value: -1"):
        SlipCarEnv().reset(seed=-1)

"""Observations carry (t, x), stay in their bounds and say so when they cannot be read."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipcar.envs import Family, Scenario, SlipCarEnv, SlipCarVectorEnv
from slipcar.envs.observation import (
    KINDS,
    LAYOUTS,
    decode,
    describe,
    observation_space,
    observe,
)

PAPER = Scenario.named("paper")
SHAPES = [(), (1,), (6,), (2, 3), (0,)]


def draw(shape, scenario=PAPER, seed=0):
    rng = np.random.default_rng(seed)
    t = scenario.dt * rng.integers(0, scenario.nodes, size=shape)
    return t, rng.uniform(-1, 1, (*shape, 5)) * np.array([5, 5, 10, 3, 6])


def wrapped(angle):
    return np.abs(np.angle(np.exp(1j * angle)))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scenario", [PAPER, Scenario.random(4, turned=True, horizon=3.7)])
def test_decode_inverts_observe(shape, kind, scenario):
    t, x = draw(shape, scenario)
    observation = observe(scenario, kind, t, x)
    assert observation.dtype == np.float32
    assert observation.shape == (*shape, len(LAYOUTS[kind]))
    time, state = scenario.decode_observation(observation)
    assert state.dtype == time.dtype == np.float64
    assert time.shape == shape
    np.testing.assert_allclose(time, t, atol=1e-6)
    others = [0, 1, 3, 4]
    np.testing.assert_allclose(state[..., others], x[..., others], atol=2e-6)
    assert np.all(wrapped(state[..., 2] - x[..., 2]) < 2e-6)
    if kind == "state":  # heading itself, not modulo 2π
        np.testing.assert_allclose(state[..., 2], x[..., 2], atol=2e-6)


@given(
    st.floats(0, 5), st.tuples(*[st.floats(-50, 50)] * 2, *[st.floats(-20, 20)] * 3).map(np.array)
)
def test_any_state_near_the_world_comes_back(t, x):
    for kind in KINDS:
        time, state = decode(PAPER, observe(PAPER, kind, t, x))
        assert abs(time - t) < 1e-6
        np.testing.assert_allclose(state[[0, 1, 3, 4]], x[[0, 1, 3, 4]], rtol=1e-6, atol=1e-5)
        assert wrapped(state[2] - x[2]) < 1e-5


@given(st.floats(0, 5), st.tuples(*[st.floats(-1e9, 1e9)] * 5).map(np.array))
def test_no_state_leaves_the_bounds(t, x):
    for kind in KINDS:
        assert observation_space(PAPER, kind).contains(observe(PAPER, kind, t, x))


@pytest.mark.parametrize("name", Scenario.names())
@pytest.mark.parametrize("kind", KINDS)
def test_bounds_hold_at_every_node_time(kind, name):
    scenario = Scenario.named(name)
    space = observation_space(scenario, kind)
    for k in range(scenario.nodes):
        assert space.contains(observe(scenario, kind, k * scenario.dt, scenario.start))


def moved(scenario, by):
    """The same world somewhere else."""
    offset = np.r_[by, 0.0, 0.0, 0.0]
    return scenario.replace(
        start=scenario.start + offset,
        goal=scenario.goal + offset,
        obstacles=scenario.obstacles + offset[:3],
    )


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_decoded_is_not_clipped_however_large_the_world(kind):
    """A world 3 km wide, 22 km from the origin, driven through at 2 km/s."""
    world = moved(PAPER, (10_000.0, 20_000.0)).replace(goal=(13_000.0, 20_000.0, 0.0, 0.0, 0.0))
    x = np.array([10_001.25, 20_002.5, 0.5, 2000.0, -1500.0])
    t, found = decode(world, observe(world, kind, 1.25, x))
    assert t == 1.25
    np.testing.assert_allclose(found, x, rtol=1e-7, atol=2e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_environments_show_far_worlds_alike(kind):
    world = moved(PAPER.replace(start_deviation=0.0), (10_000.0, 20_000.0))
    env, envs = SlipCarEnv(world, observation=kind), SlipCarVectorEnv(2, world, observation=kind)
    seen, all_seen = env.reset(seed=0)[0], envs.reset(seed=0)[0]
    np.testing.assert_allclose(seen, observe(world, kind, 0.0, world.start), rtol=1e-6)
    np.testing.assert_allclose(all_seen[0], seen, rtol=1e-6, atol=2e-3)  # it steps in float32
    x = decode(world, seen)[1]
    np.testing.assert_allclose(x[:2], (10_000.0, 20_000.0), atol=2e-3)


def test_obstacles_far_away_are_shown_where_they_are():
    world = PAPER.replace(obstacles=[(5000.0, -3000.0, 2000.0)])
    seen = observe(world, "features", 0.0, np.zeros(5), slots=1)
    np.testing.assert_array_equal(seen[12:], (5000.0, -3000.0, 2000.0, 1.0))


def test_states_that_float32_cannot_tell_apart_are_refused():
    world = moved(PAPER, (3e7, 0.0))
    with pytest.raises(ValueError, match=r"30000000.0.* tells too little beyond ±1e\+06"):
        SlipCarEnv(world, observation="state")
    SlipCarEnv(world).reset(seed=0)


def test_features_by_hand():
    """The table of docs/slipcar-v0.md, one entry after the other."""
    t, x = 4.0, np.array([1.2, 2.5, math.pi / 6, 0.4, -0.3])
    to_go = np.array([1.0, 0.5, -math.pi / 6, 0.4, -0.3])  # T − t = 1 s
    expected = [
        *[1.0, 0.5, math.cos(math.pi / 6), 0.5, 0.4, -0.3, 0.6],
        *to_go,
    ]
    np.testing.assert_allclose(observe(PAPER, "features", t, x), expected, rtol=1e-6)


def test_rates_are_clipped_and_finite_at_the_horizon():
    x = np.array([100.0, -100.0, 50.0, 50.0, -50.0])
    rates = observe(PAPER, "features", PAPER.horizon, x)[7:]
    np.testing.assert_array_equal(rates, [-5, 5, -5, 5, -5])
    at_goal = observe(PAPER, "features", PAPER.horizon, np.array(PAPER.goal))
    np.testing.assert_array_equal(at_goal[7:], np.zeros(5))


def test_layouts_name_every_entry():
    for kind in KINDS:
        assert describe(kind) == {"kind": kind, "entries": list(LAYOUTS[kind])}
        assert observation_space(PAPER, kind).shape == (len(LAYOUTS[kind]),)


@pytest.mark.parametrize("kind", ["feature", "", None, 3])
def test_unknown_kinds_list_the_known_ones(kind):
    message = r"unknown observation .*the kinds are \['features', 'state', 'egocentric'\]"
    for call in (
        lambda: observation_space(PAPER, kind),
        lambda: observe(PAPER, kind, 0.0, np.zeros(5)),
        lambda: describe(kind),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize("shape", [(), (5,), (6, 9), (3, 0)])
def test_what_is_no_observation_cannot_be_decoded(shape):
    with pytest.raises(ValueError, match=r"12 \(features\) or 6 \(state\) or 15 \(egocentric\)"):
        decode(PAPER, np.zeros(shape))


def test_the_last_node_lies_within_the_bounds_however_its_time_is_rounded():
    worlds = [PAPER.replace(horizon=T, nodes=N) for T in (3.3, 5.7, 7.0) for N in (12, 26, 38)]
    for kind in ("features", "egocentric"):
        for world in worlds:
            env = SlipCarEnv(world, observation=kind)
            env.reset(seed=0)
            over = False
            while not over:
                observation, _, over, _, _ = env.step(np.zeros(2))
            assert env.observation_space.contains(observation)
        family = Family(horizon=(3.0, 7.0), base=Scenario.named("open").replace(nodes=38))
        envs = SlipCarVectorEnv(64, family, observation=kind, autoreset_mode="Disabled")
        envs.reset(seed=0)
        for _ in range(37):
            observations, *_ = envs.step(np.zeros((64, 2)))
        assert all(envs.single_observation_space.contains(o) for o in observations)

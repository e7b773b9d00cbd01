"""Scenarios as data: names, variants, identity, JSON, the random family, and bad input."""

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from slipcar.envs import Scenario
from slipcar.envs.worlds import MAX_RANDOM_OBSTACLES

PAPER = Scenario.named("paper")
NAN, INF = float("nan"), float("inf")

finite = st.floats(-1e6, 1e6)
positive = st.floats(1e-6, 1e6)


@st.composite
def scenarios(draw):
    start, goal = (np.array(draw(arrays(float, 5, elements=finite))) for _ in range(2))
    rows = draw(st.lists(st.tuples(finite, finite, positive), max_size=5))
    for x, y, radius in rows:
        for end in (start, goal):
            assume(np.hypot(end[0] - x, end[1] - y) >= radius)
    return Scenario(
        start=start,
        goal=goal,
        obstacles=rows,
        horizon=draw(positive),
        nodes=draw(st.integers(2, 500)),
        clearance=draw(st.floats(0, 1e3)),
        obstacle_weight=draw(st.floats(0, 1e6)),
        goal_weight=draw(arrays(float, 5, elements=st.floats(0, 1e6))),
        slip=draw(st.tuples(st.floats(0, 10), st.floats(0, 10))),
        control_bounds=draw(st.none() | st.tuples(positive, positive)),
    )


# ------------------------------------------------------------------------------ data in and out


@given(scenarios())
def test_json_round_trip_is_exact(scenario):
    back = Scenario.from_json(scenario.to_json())
    assert back == scenario
    assert hash(back) == hash(scenario)
    assert back.to_json() == scenario.to_json()
    for field in dataclasses.fields(Scenario):
        before, after = getattr(scenario, field.name), getattr(back, field.name)
        if isinstance(before, np.ndarray):
            assert after.dtype == before.dtype
            assert after.tobytes() == before.tobytes()  # to the last bit
        else:
            assert after == before


@given(scenarios())
def test_equal_scenarios_hash_alike(a):
    def other_zeros(values):
        return np.where(values == 0.0, -values, values)  # 0.0 is -0.0 in numbers, not in bits

    b = a.replace(start=other_zeros(a.start), goal=other_zeros(a.goal), slip=other_zeros(a.slip))
    assert a == b
    assert hash(a) == hash(b)
    assert len({a, b, a.replace(clearance=a.clearance + 1.0)}) == 2


def test_scenarios_work_as_keys_and_differ_when_a_field_does():
    changed = PAPER.replace(clearance=0.2)
    assert changed != PAPER
    assert PAPER != "paper"
    assert {PAPER: 1, changed: 2}[Scenario.named("paper")] == 1
    assert changed.clearance == 0.2
    assert changed.replace(clearance=PAPER.clearance) == PAPER


def test_a_scenario_cannot_be_changed_in_place():
    with pytest.raises(dataclasses.FrozenInstanceError):
        PAPER.horizon = 3.0
    for values in (PAPER.start, PAPER.goal, PAPER.obstacles, PAPER.slip, PAPER.times):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1.0


def test_a_scenario_keeps_no_hold_on_what_it_was_made_from():
    start = np.zeros(5)
    scenario = PAPER.replace(start=start)
    start[0] = 7.0
    assert scenario.start[0] == 0.0


def test_the_named_scenarios():
    assert Scenario.names()[0] == "paper"
    for name in Scenario.names():
        assert Scenario.named(name) == Scenario.of(name)
        assert Scenario.from_json(Scenario.named(name).to_json()) == Scenario.named(name)
    assert Scenario.of(PAPER) is PAPER


def test_the_papers_numbers():
    """Paper §6.3, with the clearance of the released experiment."""
    assert (PAPER.horizon, PAPER.nodes, PAPER.dt) == (5.0, 41, 0.125)
    assert (PAPER.clearance, PAPER.obstacle_weight) == (0.13, 500.0)
    np.testing.assert_array_equal(PAPER.slip, [0.1, 0.01])
    np.testing.assert_array_equal(PAPER.goal, [2.2, 3, 0, 0, 0])
    np.testing.assert_array_equal(
        PAPER.obstacles,
        [[1.5, 1.9, 0.2], [0.6, 2.0, 0.3], [1.15, 0.4, 0.3], [0.35, 0.75, 0.25]],
    )
    np.testing.assert_array_equal(PAPER.goal_weight, np.full(5, 100.0))
    np.testing.assert_array_equal(PAPER.control_bounds, [2.0, 4.0])
    np.testing.assert_allclose(np.diff(PAPER.times), PAPER.dt, rtol=1e-12)


def test_scalars_and_empty_lists_are_understood():
    scenario = PAPER.replace(goal_weight=3.0, obstacles=[])
    np.testing.assert_array_equal(scenario.goal_weight, np.full(5, 3.0))
    assert scenario.obstacles.shape == (0, 3)
    assert Scenario(start=[0.0] * 5, goal=[1.0] * 5).obstacles.shape == (0, 3)


def test_an_end_on_the_rim_is_allowed_as_it_is_no_collision():
    scenario = PAPER.replace(obstacles=[[0.5, 0.0, 0.5]])
    assert scenario.signed_distance(scenario.start) == 0.0


def test_the_initial_guess_is_the_straight_line_with_its_heading_and_speed():
    x, u = PAPER.initial_guess()
    assert x.shape == (41, 5)
    assert u.shape == (40, 2)
    np.testing.assert_array_equal(x[0], PAPER.start)
    np.testing.assert_allclose(x[-1, :2], PAPER.goal[:2])
    np.testing.assert_allclose(x[1:, 2], math.atan2(3.0, 2.2))
    np.testing.assert_allclose(x[1:, 3] * PAPER.horizon, math.hypot(3.0, 2.2))


# ----------------------------------------------------------------------------- the random family


@pytest.mark.parametrize("turned", [False, True])
def test_random_worlds_keep_start_and_goal_free(turned):
    for seed in range(200):
        world = Scenario.random(seed, turned=turned)
        assert 1 <= len(world.obstacles) <= MAX_RANDOM_OBSTACLES
        for end in (world.start, world.goal):
            gap = np.hypot(*(world.obstacles[:, :2] - end[:2]).T) - world.obstacles[:, 2]
            assert gap.min() > world.clearance
        assert 2.5 <= math.dist(world.start[:2], world.goal[:2]) <= 4.5


def test_random_worlds_depend_on_their_arguments_alone():
    first = [Scenario.random(seed) for seed in range(30)]
    assert [Scenario.random(seed) for seed in range(30)] == first
    assert len(set(first)) == 30
    assert Scenario.random(3, turned=True) != Scenario.random(3)


@pytest.mark.parametrize("count", range(MAX_RANDOM_OBSTACLES + 1))
def test_random_worlds_have_as_many_obstacles_as_asked(count):
    assert len(Scenario.random(seed=3, obstacles=count).obstacles) == count


def test_random_worlds_take_changes():
    assert Scenario.random(3, clearance=0.2, horizon=7.0) == Scenario.random(3).replace(
        clearance=0.2, horizon=7.0
    )


# ------------------------------------------------------------------------------------- bad input

BAD_FIELDS = [
    ({"start": [0, 0, 0, 0, NAN]}, r"start\[4\] must be finite, not nan"),
    ({"goal": [0, INF, 0, 0, 0]}, r"goal\[1\] must be finite, not inf"),
    ({"start": [0, 0, 0]}, r"start must have shape \(5\), not \(3,\)"),
    ({"goal": np.zeros((5, 1))}, r"goal must have shape \(5\), not \(5, 1\)"),
    ({"goal": "there"}, "goal must be an array of numbers, not 'there'"),
    ({"goal": [1j] * 5}, "goal must be an array of numbers"),
    ({"horizon": 0.0}, "horizon must be finite and > 0, not 0.0"),
    ({"horizon": -5}, "horizon must be finite and > 0, not -5.0"),
    ({"horizon": NAN}, "horizon must be finite and > 0, not nan"),
    ({"horizon": INF}, "horizon must be finite and > 0, not inf"),
    ({"horizon": [5.0]}, r"horizon must have shape \(\), not \(1,\)"),
    ({"nodes": 1}, "nodes must be at least 2, not 1"),
    ({"nodes": 0}, "nodes must be at least 2, not 0"),
    ({"nodes": 41.0}, "nodes must be an integer at least 2, not 41.0"),
    ({"nodes": True}, "nodes must be an integer at least 2, not True"),
    ({"obstacles": [[1, 1, -0.2]]}, r"obstacles\[0\]: radius must be > 0 m, not -0.2"),
    ({"obstacles": [[3, 3, 0.1], [1, 1, 0]]}, r"obstacles\[1\]: radius must be > 0 m, not 0"),
    ({"obstacles": [[1, NAN, 0.2]]}, r"obstacles\[0, 1\] must be finite, not nan"),
    ({"obstacles": [[1, 1, NAN]]}, r"obstacles\[0, 2\] must be finite, not nan"),
    ({"obstacles": [1, 1, 0.2]}, r"obstacles must have shape \(any, 3\), not \(3,\)"),
    ({"obstacles": [[1, 1]]}, r"obstacles must have shape \(any, 3\), not \(1, 2\)"),
    ({"obstacles": np.zeros((0, 7))}, r"obstacles must have shape \(any, 3\), not \(0, 7\)"),
    ({"obstacles": [[1, 1, 1], [2, 2]]}, "obstacles must be an array of numbers"),
    ({"obstacles": [[0.1, 0.0, 0.2]]}, r"obstacles\[0\].*over the start at \(0, 0\).*0.1 m"),
    ({"obstacles": [[3, 0, 0.1], [2.2, 3.1, 0.3]]}, r"obstacles\[1\].*over the goal at \(2.2, 3\)"),
    ({"clearance": -0.1}, "clearance must be finite and >= 0, not -0.1"),
    ({"clearance": NAN}, "clearance must be finite and >= 0, not nan"),
    ({"obstacle_weight": -1}, "obstacle_weight must be finite and >= 0, not -1.0"),
    ({"obstacle_weight": INF}, "obstacle_weight must be finite and >= 0, not inf"),
    ({"goal_weight": -1}, r"goal_weight\[0\] must be finite and >= 0, not -1.0"),
    ({"goal_weight": [1, 1, NAN, 1, 1]}, r"goal_weight\[2\] must be finite and >= 0, not nan"),
    ({"goal_weight": [1, 1]}, r"goal_weight must have shape \(5\), not \(2,\)"),
    ({"slip": [-0.1, 0.01]}, r"slip\[0\] must be finite and >= 0, not -0.1"),
    ({"slip": [0.1, NAN]}, r"slip\[1\] must be finite and >= 0, not nan"),
    ({"slip": 0.1}, r"slip must have shape \(2\), not \(\)"),
    ({"control_bounds": [2, 0]}, r"control_bounds\[1\] must be finite and > 0, not 0.0"),
    ({"control_bounds": [NAN, 4]}, r"control_bounds\[0\] must be finite and > 0, not nan"),
    ({"control_bounds": [2, 4, 4]}, r"control_bounds must have shape \(2\), not \(3,\)"),
    ({"clearence": 0.1}, r"no field \['clearence'\]; its fields are \['start', 'goal'"),
]


@pytest.mark.parametrize(("change", "message"), BAD_FIELDS)
def test_bad_fields_are_named_with_what_is_allowed(change, message):
    with pytest.raises(ValueError, match=message):
        PAPER.replace(**change)


BAD_JSON = [
    ("{", "not a scenario: the text is not JSON"),
    ("[1, 2]", "expected a JSON object, not list"),
    ('{"start": [0,0,0,0,0]}', r"missing fields \['goal'\]; the fields are \['start'"),
    ('{"format": 99}', "format 99 is unknown; this version reads 1"),
    (json.dumps({**PAPER.to_dict(), "colour": 1}), r"unknown fields \['colour'\]"),
    (json.dumps({**PAPER.to_dict(), "horizon": NAN}), "horizon must be finite and > 0, not nan"),
    (json.dumps({**PAPER.to_dict(), "nodes": 1}), "nodes must be at least 2, not 1"),
    (json.dumps({**PAPER.to_dict(), "start": {"x": 1}}), "start must be an array of numbers"),
    (PAPER.to_json()[:-10], "not JSON"),
]


@pytest.mark.parametrize(("text", "message"), BAD_JSON)
def test_bad_json_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        Scenario.from_json(text)


@pytest.mark.parametrize("name", ["papre", "", "PAPER", None, ["paper"]])
def test_unknown_names_list_the_known_ones(name):
    with pytest.raises(ValueError, match=r"unknown scenario .*'paper', 'open'"):
        Scenario.named(name)


def test_only_scenarios_and_names_are_scenarios():
    with pytest.raises(ValueError, match=r"a Scenario, one of the names \['paper'.* not tuple"):
        Scenario.of((0, 1))
    with pytest.raises(ValueError, match=r"missing fields \['goal'\]"):
        Scenario.of({"start": np.zeros(5)})


@pytest.mark.parametrize("name", Scenario.names())
def test_a_scenario_is_also_known_by_its_data_and_text(name):
    scenario = Scenario.named(name)
    assert Scenario.of(scenario.to_dict()) == Scenario.of(scenario.to_json()) == scenario


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed must be at least 0, not -1"),
        ({"seed": 1.5}, "seed must be an integer at least 0, not 1.5"),
        ({"seed": 1, "obstacles": 9}, "obstacles must be between 0 and 8, not 9"),
        ({"seed": 1, "obstacles": -1}, "obstacles must be between 0 and 8, not -1"),
    ],
)
def test_bad_arguments_of_the_random_family(arguments, message):
    with pytest.raises(ValueError, match=message):
        Scenario.random(**arguments)


def test_an_unbounded_scenario_has_no_action_scale():
    with pytest.raises(ValueError, match=r"control_bounds is None.*replace\(control_bounds="):
        PAPER.replace(control_bounds=None).encode_control(np.zeros(2))

"""The environment's benchmark: what it counts, takes apart and compares; nothing is timed here."""

import importlib
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from slipcar.envs import SlipCarVectorEnv

pytest.importorskip("rich")

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def bench():
    """Imports a module of benchmarks/, which is a folder of scripts and no package."""
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module
    sys.path.remove(str(FOLDER))


def test_calls_that_only_reset_are_no_steps(bench):
    envs = gym.make_vec(
        "slipcar.envs:SlipCar-v0", num_envs=3, vectorization_mode="vector_entry_point"
    )
    walker = bench("environment_turns").vector_walker("ours", envs, 82)
    assert walker.walk() == 3 * 80
    # The count goes on where the last walk ended, whatever the length of an episode.
    walker = bench("environment_turns").vector_walker("ours", envs, 40)
    assert [walker.walk() for _ in range(3)] == [120, 117, 117]


def test_cart_poles_are_counted_as_they_fall(bench):
    envs = gym.make_vec("CartPole-v1", num_envs=8, vectorization_mode="vector_entry_point")
    falls = []
    step = envs.step

    def watched(actions):
        result = step(actions)
        falls.append(int((result[2] | result[3]).sum()))
        return result

    envs.step = watched
    steps = bench("environment_turns").vector_walker("CartPole", envs, 60).walk()
    assert sum(falls) > 8
    assert steps == 8 * 60 - sum(falls[:-1])


def test_ratio_is_that_of_the_rounds(bench):
    turns = bench("environment_turns")
    # The machine was ten times slower in the third round, for both.
    rates = {"ours": np.array([30.0, 30.0, 3.0]), "theirs": np.array([10.0, 15.0, 1.0])}
    assert turns.ratio(rates, "ours", "theirs") == pytest.approx(3.0)


def test_every_walker_has_its_turn_in_every_round(bench):
    turns, order = bench("environment_turns"), []

    def walker(name, steps):
        def walk():
            order.append(name)
            return steps

        return turns.Walker(name, walk)

    rates = turns.by_turns([walker("one", 1), walker("many", 1000)], rounds=4)
    assert len(order) == 10
    assert all(set(order[i : i + 2]) == {"one", "many"} for i in range(0, 10, 2))
    assert all(found.shape == (4,) and (found > 0.0).all() for found in rates.values())


def test_a_part_does_not_count_what_it_calls(bench):
    share = bench("environment_share")
    clocks = share.Clocks()
    inner = clocks.around(lambda: time.sleep(0.05), "inner")
    outer = clocks.around(lambda: [inner(), inner()], "outer")
    began = time.perf_counter()
    outer()
    took = time.perf_counter() - began
    assert clocks.seconds["inner"] >= 0.1
    assert clocks.seconds["outer"] <= took - clocks.seconds["inner"]


def test_the_parts_of_a_step_are_found_and_make_the_whole(bench):
    share, turns = bench("environment_share"), bench("environment_turns")
    assert share.unclocked() == []
    envs = SlipCarVectorEnv(16, "family:random", "egocentric")
    before = share.noise.normals
    rows = share.shares([turns.vector_walker("family", envs, 82)], {"family": 1e6}, rounds=1)
    assert share.noise.normals is before
    parts = {row["part"]: float(row["family [ns]"]) for row in rows}
    assert parts.pop("in all") == 1e6
    assert sum(parts.values()) == pytest.approx(1e6, abs=0.1 * len(parts))
    assert all(nanoseconds > 0.0 for nanoseconds in parts.values())


def test_precision_compares_the_same_paths(bench):
    (paper, family) = bench("environment_precision").rows(500)
    for row in (paper, family):
        assert 0.0 < row["state [m, rad]"] < 1e-4
        assert 0.0 < row["observation"] < 1e-3
        assert 0.0 < row["return (relative)"] < 1e-5
        assert row["in one only"] <= 1
    assert paper["reordered"] == 0  # it has no slots
    assert paper["collisions"] > 50


def test_peers_that_are_not_installed_are_left_out_with_a_line(bench):
    peers, told = bench("environment_peers"), []

    def missing(name):
        raise ImportError("No module named 'slow_cars'\nand more")

    found = [
        peers.Peer("slow cars", "slow-cars", "nothing", 1, missing),
        peers.Peer("CartPole-v1", "gymnasium", "", 1, peers._gymnasium("CartPole-v1", 5)),
    ]
    there, skipped = peers.available(found, told.append)
    assert [peer.name for peer, _ in there] == ["CartPole-v1"]
    assert there[0][1].walk() == 5
    assert told == skipped == ["skipped slow cars: No module named 'slow_cars'"]


def test_what_was_asked_for_is_reached_or_not(bench):
    environment = bench("environment")
    fleet = {name: np.full(3, 9e6) for name in environment.FLEETS} | {"CartPole": np.full(3, 1e7)}
    singles = {environment._OURS: np.full(3, 30e3), "highway-fast-v0 x 1": np.full(3, 100.0)}
    rows = environment.target_rows(
        {environment.FLEET: fleet}, singles, {"steps/s": 20e3}, [], [{"frames/s": 900.0}]
    )
    reached = {row["what"]: row["reached"] for row in rows}
    assert reached == {
        "single environment, steps/s": "yes",
        "single environment over HighwayEnv": "yes",
        "4096 cars, state, over CartPole": "no",
        "4096 cars, features, steps/s": "yes",
        "4096 cars, features, over CartPole": "yes",
        "PPO end to end, steps/s": "no",
        "frames/s": "yes",
        "Torch on a GPU, steps/s": "",
    }

"""The benchmark over random worlds: judged alike, remembered faithfully, counted honestly."""

import dataclasses
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from slipcar.envs import Scenario, routes

pytest.importorskip("casadi", reason='casadi is not installed: pip install "slipcar[bench]"')
pytest.importorskip("rich")

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def worlds():
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module("worlds")
    sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def peer(worlds):
    return importlib.import_module("worlds_ipopt")


@pytest.fixture(scope="module")
def measured(worlds, tmp_path_factory):
    folder = tmp_path_factory.mktemp("worlds")
    return worlds.measure(4, folder), folder


def result(worlds, seed, cost, *, converged=True, miss=0.0):
    return worlds.Result(seed, "", converged, cost, miss, 10, 0.01)


def test_all_planners_are_measured_on_all_worlds(worlds, measured):
    found, folder = measured
    assert list(found) == [row["planner"] for row in worlds.rows(found)]
    for results in found.values():
        assert [r.seed for r in results] == [0, 1, 2, 3]
        for r in results:
            assert r.converged
            assert r.miss <= worlds.RESIDUAL
            assert 0.0 < r.cost < 100.0
    json.dumps(worlds.raw(found))
    assert (folder / "worlds-ipopt.npz").is_file()


def test_several_starts_cost_no_more_than_one(worlds, measured):
    found, _ = measured
    for several, one in zip(found[worlds.SEVERAL], found[worlds.SAME], strict=True):
        assert several.cost <= one.cost * (1.0 + 1e-6)
        assert several.iterations > one.iterations
    for three, one in zip(found[worlds.IPOPT_BEST], found[worlds.IPOPT], strict=True):
        assert three.cost <= one.cost
        assert three.iterations > one.iterations


def test_a_second_run_solves_nothing_again_and_finds_the_same(worlds, measured, peer, monkeypatch):
    found, folder = measured

    def forbidden(*arguments, **options):
        raise AssertionError("IPOPT was asked again")

    monkeypatch.setattr(importlib.import_module("casadi_nlp"), "WholeNlp", forbidden)
    again = worlds.measure(4, folder)
    for name in (worlds.IPOPT, worlds.IPOPT_BEST):
        assert again[name] == found[name]


def test_memory_depends_on_world_guess_and_tolerance(peer, tmp_path):
    world = Scenario.random(0, turned=True)
    own, arc = world.initial_guess(), routes.arc(world, 0.5)
    memory = peer.Ipopt(tmp_path / "memory.npz", 1e-6)
    memory.solve(world, {"own": own})
    memory.solve(world, {"again": own})
    assert memory.solved == 1
    memory.solve(world, {"arc": arc})
    memory.solve(world.replace(clearance=0.2), {"own": own})
    assert memory.solved == 3
    memory.save()
    same, finer = (peer.Ipopt(tmp_path / "memory.npz", tol) for tol in (1e-6, 1e-7))
    kept = same.solve(world, {"own": own, "arc": arc})
    finer.solve(world, {"own": own})
    assert (same.solved, finer.solved) == (0, 1)
    for name, guess in (("own", own), ("arc", arc)):
        fresh = memory.solve(world, {name: guess})[name]
        np.testing.assert_array_equal(kept[name].answer.controls, fresh.answer.controls)
        assert kept[name].answer.iterations == fresh.answer.iterations
        assert kept[name].answer.found is fresh.answer.found


def test_guesses_lead_ipopt_to_different_answers(peer, tmp_path):
    world = Scenario.random(1, turned=True)
    guesses = {"left": routes.arc(world, 0.5), "right": routes.arc(world, -0.5)}
    answers = peer.Ipopt(tmp_path / "memory.npz", 1e-6).solve(world, guesses)
    left, right = (answers[name].answer.controls for name in guesses)
    assert np.abs(left - right).max() > 0.1


def test_shares_count_failures_against_whom_they_befell(worlds):
    ours = [
        result(worlds, 0, 1.00),  # as good
        result(worlds, 1, 1.03),  # worse
        result(worlds, 2, 0.90),  # better
        result(worlds, 3, 0.50, converged=False),  # ours failed
        result(worlds, 4, 9.00),  # theirs failed
        result(worlds, 5, 1.00, converged=False),  # both failed
    ]
    theirs = [result(worlds, seed, 1.0, converged=seed < 4) for seed in range(6)]
    as_good, better = worlds.shares(ours, theirs)
    assert as_good == pytest.approx(3 / 6)
    assert better == pytest.approx(2 / 6)


def test_failing_seeds_are_listed_on_both_sides(worlds):
    good = [result(worlds, seed, 1.0) for seed in range(4)]
    ours = [good[0], result(worlds, 1, 2.0), result(worlds, 2, 1.0, miss=1e-3), good[3]]
    theirs = [good[0], good[1], good[2], dataclasses.replace(good[3], converged=False)]
    names = (worlds.SAME, worlds.DIRECT, worlds.SEVERAL)
    found = dict.fromkeys(names, ours) | dict.fromkeys((worlds.IPOPT, worlds.IPOPT_BEST), theirs)
    lists = worlds.failing(found)
    same = {what: seeds for what, seeds in lists.items() if worlds.DIRECT not in what}
    assert same[f"{worlds.SAME} does not converge to 1e-06"] == [2]
    assert same[f"{worlds.SAME} costs more than 1.02 × {worlds.IPOPT}"] == [1]
    assert same[f"{worlds.IPOPT} does not converge, {worlds.SAME} does"] == [3]
    assert lists[f"{worlds.IPOPT_BEST} does not converge, {worlds.SEVERAL} does"] == [3]
    assert lists[f"{worlds.IPOPT} costs more than 1.02 × {worlds.SAME}"] == []


def test_best_of_three_ignores_a_cheap_failure_and_counts_all_work(worlds):
    answers = [
        result(worlds, 0, 2.0),
        result(worlds, 0, 1.5),
        result(worlds, 0, 0.1, converged=False),
    ]
    best = worlds.best(answers)
    assert (best.cost, best.iterations) == (1.5, 30)
    assert best.seconds == pytest.approx(0.03)


def test_figure_is_drawn(worlds, measured, tmp_path):
    pytest.importorskip("matplotlib")
    paths = worlds.draw(measured[0], tmp_path)
    assert {path.suffix for path in paths} == {".png", ".pdf", ".svg"}
    assert all(path.stat().st_size > 1000 for path in paths)

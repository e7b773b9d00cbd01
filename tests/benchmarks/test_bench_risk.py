"""The benchmarks of risk: promises counted on fresh paths, ratios over common ones, honest rows."""

import dataclasses
import importlib
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.planner import Feedback, plan

pytest.importorskip("rich")

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
PATHS = 2_000


@pytest.fixture(scope="module")
def bench():
    """Imports a module of benchmarks/, which is a folder of scripts and no package."""
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module
    sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def worlds(bench):
    return bench("risk_worlds")


@pytest.fixture(scope="module")
def found(worlds):
    return worlds.measure(1, episodes=PATHS, receding_episodes=8, risk_episodes=PATHS)


@pytest.fixture
def make(worlds):
    def result(seed=0, **changes):
        settled = {
            "turned": False,
            "status": "CONVERGED",
            "requested": 0.01,
            "rate": 0.008,
            "interval": (0.006, 0.011),
            "episodes": 1000,
            "effort": 4.0,
            "total": 5.0,
            "effort_ratio": 1.1,
            "total_ratio": 0.8,
        }
        return worlds.Result(seed=seed, **{**settled, **changes})

    return result


def test_every_planner_is_measured_in_every_world(worlds, found):
    assert tuple(found) == worlds.NAMES
    for name, results in found.items():
        assert [(r.seed, r.turned) for r in results] == [(0, False), (0, True)], name
        assert {r.episodes for r in results} == {8 if "receding" in name else PATHS}
    assert worlds.measure.__defaults__[1] % 128 == 0  # a receding horizon drives 128 at once
    json.dumps({name: [dataclasses.asdict(r) for r in results] for name, results in found.items()})


def test_what_is_measured_is_what_evaluation_says(worlds, found):
    scenario = Scenario.random(0, turned=True)
    row = found[worlds.FEEDBACK][1]
    again = evaluate(Feedback(plan(scenario, feedback=True)), scenario, PATHS, worlds.SEED)
    assert row.rate == again.collision_rate
    assert row.total == pytest.approx(again.total, rel=1e-9)
    assert row.measured == row.total
    # The same paths under the reference: a ratio of means over them.
    base = found[worlds.SCP_STARTS][1]
    assert row.total_ratio == pytest.approx(row.total / base.total, rel=1e-9)
    assert (base.effort_ratio, base.total_ratio) == (1.0, 1.0)


def test_expectations_meet_what_is_measured(worlds, found):
    for name in (worlds.OPEN, worlds.FEEDBACK, worlds.FEEDBACK_SAFE):
        for r in found[name]:
            assert r.ok
            assert r.expected == pytest.approx(r.measured, rel=0.05)
    for r in found[worlds.SCP] + found[worlds.LQR]:
        assert math.isnan(r.expected)


def test_promised_risks_are_kept_on_the_fresh_paths(worlds, found):
    for name, delta in ((worlds.OPEN, 0.01), (worlds.FEEDBACK_SAFE, 0.001)):
        for r in found[name]:
            assert r.requested == delta
            assert r.kept
            assert r.price >= 0.0
    for row in worlds.promises(found):
        assert row["kept"] == "1 of 1"


def test_a_promise_is_broken_where_the_interval_lies_above(worlds, make):
    assert make(interval=(0.0099, 0.02)).kept
    assert not make(interval=(0.0101, 0.02), rate=0.015).kept
    results = [
        make(0),
        make(1, rate=0.015, interval=(0.012, 0.019)),
        make(2, status="RISK_UNREACHABLE", rate=0.4, interval=(0.3, 0.5)),
        make(3, status="STALLED"),
        make(0, turned=True, rate=0.0, interval=(0.0, 0.001)),
    ]
    mine = {worlds.OPEN: results, worlds.FEEDBACK_SAFE: results}
    straight, turned = worlds.promises(mine)[:2]
    assert straight["worlds"] == "4 straight"
    assert (straight["promised"], straight["refused"], straight["failed"]) == (2, 1, 1)
    assert (straight["kept"], straight["rate ≤ δ"]) == ("1 of 2", "1 of 2")
    assert straight["worst"] == pytest.approx(1.5)
    assert (turned["promised"], turned["kept"]) == (1, "1 of 1")
    told = "\n".join(worlds.notes({worlds.OPEN: results}))
    assert "did not keep its promise: 1 worlds (1)" in told
    assert "refused: 1 worlds (2)" in told
    assert "failed: 1 worlds (3)" in told


def test_costs_leave_out_what_did_not_converge_and_pool_the_rest(worlds, make):
    scp = [make(seed, effort_ratio=1.0, total_ratio=1.0) for seed in range(4)]
    tracked = [make(seed, total_ratio=0.5) for seed in range(4)]
    mine = [
        make(0, rate=0.001, total_ratio=0.4, expected=4.0, measured=5.0),
        make(1, rate=0.003, total_ratio=0.4, expected=6.0, measured=5.0),
        make(2, status="STALLED", total_ratio=9.0),
        make(3, status="RISK_UNREACHABLE", total_ratio=9.0),
    ]
    table = {worlds.SCP_STARTS: scp, worlds.LQR: tracked, worlds.FEEDBACK: mine}
    row = next(row for row in worlds.costs(table) if row["planner"] == worlds.FEEDBACK)
    assert row["worlds"] == 2
    assert row["collisions, all paths"].startswith("0.200% [")  # 4 of 2000
    assert row["total / SCP"].startswith("0.4 ")
    assert row["total / tracked"].startswith("0.8 ")
    assert row["expected / measured"].startswith("1 (")


def test_spread_is_the_median_between_quantiles(worlds):
    assert worlds.spread([]) == ""
    assert worlds.spread(np.linspace(0.0, 100.0, 101).tolist()) == "50 (5–95)"


def test_tables_and_figure_come_out(bench, worlds, found, tmp_path):
    report = bench("report")
    for rows in (worlds.promises(found), worlds.costs(found), worlds.times(found)):
        assert "nan" not in report._table(rows)
    three = {name: found[name] for name in (worlds.OPEN, worlds.FEEDBACK, worlds.FEEDBACK_SAFE)}
    before = [[r.rate for r in found[worlds.SCP_STARTS]]] * 3
    written = bench("risk_figure").draw(before, three, {worlds.OPEN: 0.01}, tmp_path)
    assert all(path.stat().st_size > 1000 for path in written)


def test_monte_carlo_is_not_in_the_time(bench):
    times, contenders = bench("risk_times"), bench("contenders")
    simulated = {}
    makers = times.makers(Scenario.named("paper"), simulated)
    chosen = {name: makers[name] for name in ("plan(s)", "risk=0.01, starts=1")}
    (base, risky), skipped = contenders.available(chosen)
    assert skipped == {}
    seconds, answer = risky.solve()
    assert answer.found
    assert seconds > 0.0
    (monte_carlo,) = simulated["risk=0.01, starts=1"]
    assert monte_carlo > 0.0
    base.solve()
    assert simulated["plan(s)"] == [0.0]
    assert [times.is_rare(c.name) for c in (base, risky)] == [False, True]


def test_replans_are_counted_by_the_controller(bench):
    times = bench("risk_times")
    one = times.receding("replan, single", Scenario.named("paper"), 0.0, 1)
    two = times.receding("replan, 2 episodes", Scenario.named("paper"), 0.0, 2)
    steps = Scenario.named("paper").nodes - 1
    assert one.plans == steps - 1  # at the start there is nothing to add to the first plan
    assert two.plans == 2 * one.plans
    seconds, answer = one.solve()
    assert seconds > 0.0
    assert answer.found


def test_ratios_are_to_the_plain_plan(bench):
    times, turns, contenders = bench("risk_times"), bench("turns"), bench("contenders")
    answer = contenders.Answer(np.zeros((40, 2)), 7, True)

    def timing(name, seconds, plans=1):
        contender = contenders.Contender(name, "", lambda: (seconds, answer), plans=plans)
        return turns.Timing(contender, answer, np.array([seconds]))

    every = [timing("plan(s)", 0.001), timing("risk=0.01", 0.02), timing("replan, many", 1.0, 500)]
    simulated = {"plan(s)": [0.0], "risk=0.01": [1.0, 3.0]}
    plain, risky = times.rows(every, simulated)
    assert plain["times plan(s)"] == pytest.approx(1.0)
    assert risky["times plan(s)"] == pytest.approx(20.0)
    assert risky["Monte Carlo [s]"] == pytest.approx(2.0)
    assert math.isnan(plain["Monte Carlo [s]"])
    (replan,) = times.rows(every, simulated, replans=True)
    assert replan["ms (median)"] == pytest.approx(2.0)
    assert replan["times plan(s)"] == pytest.approx(2.0)


def test_paper_case_keeps_what_it_promises(bench):
    rows = bench("risk_paper").measure(episodes=20_000, receding_episodes=0)
    table = {row.name: row for row in rows}
    for delta in (0.01, 0.002):
        row = table[f"plan(s, risk={delta:g})"]
        assert row.driven.collision_interval[0] <= delta
        assert row.columns()["requested"] == f"{delta:.1%}"
        assert row.plan.expected.total == pytest.approx(
            row.driven.effort + row.driven.obstacle, rel=0.02
        )
    scp, tracked = table["plan(s)"], table["Feedback(plan(s)), LQR tracking"]
    steered = table["plan(s, feedback=True)"]
    assert steered.driven.total < tracked.driven.total < scp.driven.total
    assert steered.plan.expected.total == pytest.approx(steered.driven.total, rel=0.01)

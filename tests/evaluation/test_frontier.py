import json
from pathlib import Path

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.evaluation.cli import main
from slipcar.evaluation.frontier import (
    FEEDBACK,
    OPEN_LOOP,
    RECEDING,
    SINGLE,
    Frontier,
    Point,
    frontier,
    point_name,
    undominated,
)
from slipcar.evaluation.report.document import read_document
from slipcar.evaluation.statistics import wilson_interval
from slipcar.planner import Feedback, OpenLoop, Status, plan

PRICES = (0.0, 30.0, 1000.0)
EPISODES, RECEDING_EPISODES = 5000, 128


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("frontier")


@pytest.fixture(scope="module")
def traced(folder):
    return frontier(
        "paper",
        EPISODES,
        seed=2,
        prices=PRICES[::-1],
        receding_prices=(30.0,),
        receding_episodes=RECEDING_EPISODES,
        folder=folder,
        progress=False,
    )


def curve(traced, method):
    return traced.frame[traced.frame["method"] == method].sort_values("price")


# ------------------------------------------------------------------ what it says


def test_every_method_is_there(traced):
    assert traced.notes == ()
    assert traced.comparison.errors == {}
    assert list(curve(traced, OPEN_LOOP)["price"]) == list(PRICES)
    assert list(curve(traced, FEEDBACK)["price"]) == list(PRICES)
    assert list(curve(traced, RECEDING)["price"]) == [30.0]
    assert len(curve(traced, SINGLE)) == 4
    assert curve(traced, SINGLE)["price"].isna().all()
    closed = traced.frame.groupby("method")["closed_loop"].agg(["all", "any"])
    assert not closed.loc[OPEN_LOOP, "any"]
    assert closed.loc[[FEEDBACK, RECEDING], "all"].all()
    assert (traced.frame["failures"] == 0).all()


@pytest.mark.parametrize("method", [OPEN_LOOP, FEEDBACK])
def test_safety_is_bought_with_effort(traced, method):
    found = curve(traced, method)
    assert (np.diff(found["collision_rate"]) < 0.0).all()
    assert (np.diff(found["effort"]) > 0.0).all()
    assert (np.diff(found["total"]) > 0.0).all()
    assert (found["failures"] == 0).all()


def test_feedback_is_safer_and_cheaper_than_open_loop(traced):
    blind, seeing = curve(traced, OPEN_LOOP), curve(traced, FEEDBACK)
    assert (seeing["total"].to_numpy() < blind["total"].to_numpy()).all()
    assert (seeing["collision_rate"].to_numpy()[:2] < blind["collision_rate"].to_numpy()[:2]).all()


def test_a_point_is_its_plan_over_the_common_paths(traced):
    paper = Scenario.named("paper")
    expected = {
        point_name(OPEN_LOOP, 30.0): OpenLoop(plan(paper, risk_price=30.0)),
        point_name(FEEDBACK, 0.0): Feedback(plan(paper, feedback=True)),
    }
    for name, controller in expected.items():
        result = evaluate(controller, paper, EPISODES, seed=2)
        row = traced.frame.loc[name]
        assert row["total"] == pytest.approx(result.total, rel=1e-9)
        assert row["collision_rate"] == result.collision_rate


def test_intervals_are_wilsons(traced):
    for _, row in traced.frame.iterrows():
        episodes = RECEDING_EPISODES if row["method"] == RECEDING else EPISODES
        assert row["episodes"] == episodes
        low, high = wilson_interval(row["collision_rate"] * episodes, episodes)
        if row["runs"] > 1:  # of the method, not of one training: wider
            assert row["collision_low"] <= low < high <= row["collision_high"]
        else:
            assert (row["collision_low"], row["collision_high"]) == pytest.approx((low, high))


@pytest.mark.parametrize("cost", ["effort", "total"])
def test_the_front_is_what_nothing_dominates(traced, cost):
    fewer = traced.frame["method"] == RECEDING
    assert not traced.frame.loc[fewer, f"{cost}_front"].any()
    frame = traced.frame[~fewer]
    points = frame[["collision_rate", cost]].to_numpy()
    for at, marked in zip(points, frame[f"{cost}_front"], strict=True):
        beaten = any((other <= at).all() and (other < at).any() for other in points)
        assert marked == (not beaten)


def test_undominated_by_hand():
    rates = np.array([1.0, 2.0, 3.0, 2.0, np.nan, 1.0])
    costs = np.array([3.0, 2.0, 1.0, 2.5, 0.0, 3.0])
    expected = [True, True, True, False, False, True]  # equals do not dominate each other
    assert undominated(rates, costs).tolist() == expected


# ------------------------------------------------------------------ finished points, bad input


def test_finished_points_are_reused(traced, folder):
    again = frontier(
        "paper", EPISODES, 2, prices=PRICES, receding_prices=(), folder=folder, progress=False
    )
    assert len(again.comparison.reused) == len(again.points) == 4 + 2 * len(PRICES)
    rows = traced.frame.loc[again.frame.index]
    assert again.frame["total"].equals(rows["total"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prices": (1.0, -2.0)}, "prices must be finite and >= 0, not -2.0"),
        ({"prices": ("dear",)}, "prices must be finite and >= 0, not 'dear'"),
        ({"receding_prices": (np.inf,)}, "receding_prices must be finite and >= 0, not inf"),
        ({"prices": (3.0, 3)}, "prices must differ from each other; 3 comes twice"),
        ({"receding_episodes": 0}, "receding_episodes must be at least 1, not 0"),
        ({"episodes": 0}, "episodes must be at least 1, not 0"),
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        ({"scenario": "open"}, "needs a scenario with obstacles"),
    ],
)
def test_bad_arguments_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        frontier(**{"scenario": "paper", "episodes": 10, "progress": False, **change})


def test_plans_that_fail_are_told_of_and_not_shown(monkeypatch):
    def plan_or_fail(scenario, **options):
        found = plan(scenario, **options)
        return found.replace(status=Status.STALLED) if options.get("risk_price") == 1.0 else found

    monkeypatch.setattr("slipcar.evaluation.frontier.plan", plan_or_fail)
    f = frontier("paper", 20, prices=(0.0, 1.0), receding_prices=(), progress=False)
    assert point_name(OPEN_LOOP, 0.0) in f.frame.index
    for method in (OPEN_LOOP, FEEDBACK):
        name = point_name(method, 1.0)
        assert name not in f.frame.index
        assert any(note.startswith(f"{name}: the plan is STALLED") for note in f.notes)
    assert all(note in f.to_markdown() for note in f.notes)


# ------------------------------------------------------------------ what is written


def test_tables_say_where_they_come_from(traced, tmp_path):
    import pandas as pd

    written = traced.save(tmp_path, figures=False)
    assert {path.name for path in written} >= {
        "table.md", "table.csv", "times.csv", "table.tex", "results.json", "document.json"
    }  # fmt: skip
    scene = read_document(tmp_path).scene
    ends = [point_name(m, p) for m in (OPEN_LOOP, FEEDBACK) for p in (PRICES[0], PRICES[-1])]
    assert [row["name"] for row in scene["rows"]][:4] == ends
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert all(f"| {name} " in text for name in traced.frame.index)
    assert f"first {RECEDING_EPISODES:,} of them" in text
    row = traced.frame.loc[point_name(FEEDBACK, 30.0)]
    low, high = 100 * row["collision_low"], 100 * row["collision_high"]
    assert f"{100 * row['collision_rate']:.3f} [{low:.3f}, {high:.3f}]" in text
    read = pd.read_csv(tmp_path / "table.csv", index_col="controller")
    np.testing.assert_allclose(read["effort"], traced.frame["effort"], rtol=1e-15)
    data = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert Scenario.from_json(json.dumps(data["scenario"])) == Scenario.named("paper")
    assert [r["controller"] for r in data["rows"]] == list(traced.frame.index)
    assert r"$\nu$" in (tmp_path / "table.tex").read_text(encoding="utf-8")


def markers(figure):
    """Every marker drawn: (axes, x, y)."""
    return [
        (axes, *line.get_xydata()[0])
        for axes in figure.axes
        for line in axes.lines
        if line.get_marker() not in ("None", None, "") and line.get_transform() == axes.transData
    ]


def test_the_figure_shows_every_point_where_it_is(traced):
    pytest.importorskip("matplotlib")
    from slipcar.evaluation.figures.frontier import frontier_figure

    figure = frontier_figure(traced)
    drawn = [(x, y) for _, x, y in markers(figure)]
    for _, row in traced.frame.iterrows():
        rate = row["collision_rate"] or row["collision_high"]  # none observed: the upper limit
        for cost in ("effort", "total"):
            assert any(np.allclose((100 * rate, row[cost]), at, rtol=1e-9) for at in drawn)
    for axes, x, y in markers(figure):  # none is cut off
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        assert left < x < right
        assert low < y < high
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert {OPEN_LOOP, FEEDBACK, RECEDING, "PPO"} <= set(texts)


def test_labels_cover_neither_markers_nor_each_other():
    pytest.importorskip("matplotlib")
    from slipcar.evaluation.figures.labels import Label, place
    from slipcar.evaluation.figures.scene import new_figure

    figure = new_figure(5.0, 4.0)
    axes = figure.subplots()
    points = np.random.default_rng(0).uniform(size=(12, 2))
    axes.plot(*points.T, "o", markersize=4)
    place(axes, [Label(f"point {i}", at[None], "k") for i, at in enumerate(points)], points, [])
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in axes.texts if text.get_text()]
    assert len(boxes) == len(points)
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert not any(box.contains(*at) for at in axes.transData.transform(points))


def test_an_axis_is_broken_between_groups_alone():
    pytest.importorskip("matplotlib")
    from slipcar.evaluation.figures.frontier import widest_gap

    assert widest_gap([[5.0, 5.3], [4.9], [7.0, 9.0]]) == (5.3, 7.0)
    assert widest_gap([[5.0, 9.0], [4.9]]) is None  # the wide gap is within a curve
    assert widest_gap([[1.0, 2.0], [2.5, 3.5], [4.0]]) is None  # none is wide
    assert widest_gap([]) is None


# ------------------------------------------------------------------ the command


def test_the_command_writes_what_it_says(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    arguments = ["frontier", "--scenario", "gap", "--episodes", "20", "--out", str(tmp_path)]
    assert main([*arguments, "--prices", "0", "10", "--receding-prices"]) == 0
    text = capsys.readouterr().out
    assert point_name(FEEDBACK, 10.0) in text
    assert "No PPO row" in text
    for name in ("table.md", "table.csv", "results.json", "frontier.png", "frontier.pdf"):
        assert (tmp_path / name).stat().st_size > 500
        assert name in text


def test_an_interruption_says_where_its_points_are(tmp_path, capsys, monkeypatch):
    class Interrupts:
        scenario = Scenario.named("paper")

        def predict(self, *arguments, **rest):
            raise KeyboardInterrupt

    policies = (Interrupts(), Interrupts())
    monkeypatch.setattr("slipcar.baselines.shipped_runs", lambda method, world: policies)
    assert main(["frontier", "--episodes", "20", "--folder", str(tmp_path)]) == 130
    assert f"finished points are kept in {tmp_path}" in capsys.readouterr().err
    assert len(list((tmp_path / "cells").glob("*.npz"))) == 3


def test_a_frontier_of_nothing_is_still_told(traced, tmp_path):
    import dataclasses

    message = "ValueError: no fuel"
    failed = dataclasses.replace(traced.comparison, results={}, errors={"a": message})
    nothing = Frontier((Point("a", SINGLE, float("nan"), None),), failed, 1, ())
    assert message in nothing.to_markdown()
    assert not nothing.frame["effort_front"].any()


@pytest.mark.long
def test_the_page_shows_what_the_command_prints(tmp_path):
    assert main(["frontier", "--no-figures", "--workers", "2", "--folder", str(tmp_path)]) == 0
    # Times are the machine's; rates and costs are not.
    printed = (tmp_path / "table.md").read_text(encoding="utf-8").split("**Solver failures")[0]
    rows = [line for line in printed.splitlines() if line.startswith("| ")]
    assert len(rows) == 1 + 4 + 2 * 8 + 4
    page = (Path(__file__).parents[2] / "docs" / "frontier.md").read_text(encoding="utf-8")
    assert [row for row in rows if row not in page] == []

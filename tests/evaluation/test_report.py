import dataclasses
import json
import re

import numpy as np
import pytest

from slipcar.evaluation import compare, sample_paths
from slipcar.evaluation.report.comparison import TAILS, document, save, save_document
from slipcar.evaluation.report.document import Figure, read_document
from slipcar.evaluation.report.formats import duration, with_error, with_interval
from slipcar.evaluation.report.scene import scene
from slipcar.evaluation.runs import Runs
from slipcar.planner import Feedback, OpenLoop, plan

EPISODES = 600


@pytest.fixture
def compared(paper, replay, turning):
    runs = Runs(tuple(replay(paper, w * turning) for w in (0.9, 1.0, 1.1)), ("s0", "s1", "s2"))
    found = plan(paper)
    rows = {
        "still": replay(paper, (0.0, 0.0)),
        "SCP": OpenLoop(found),
        "SCP + feedback": Feedback(found),
        "learned": runs,
    }
    return compare(rows, paper, EPISODES, 3, progress=False)


def table(shown, words):
    (found,) = [table for table in shown.tables if words in table.caption]
    return found


def column(found, header):
    j = found.headers.index(header)
    return {row[0]: value[j] for row, value in zip(found.cells, found.values, strict=True)}


# ------------------------------------------------------------------ tables


def test_every_number_is_the_frames(compared):
    frame, shown = compared.frame, document(compared)
    places = {
        ("Cost of a path", "total cost"): "total",
        ("Collisions", "at nodes [%]"): "collision_rate",
        ("Collisions", "at or between nodes [%]"): "between_rate",
        ("Tails", "cost 99 %"): "total_p99",
        ("Tails", "dearest 5 %"): "total_cvar95",
        ("Tails", "clearance 1 % [m]"): "clearance_p01",
        ("Tails", "closest 5 % [m]"): "clearance_cvar05",
        ("Error at the goal", "heading RMS [rad]"): "heading_rms",
    }
    for (words, header), key in places.items():
        assert column(table(shown, words), header) == frame[key].to_dict()
    assert [c.header for c in TAILS[1:]] == list(table(shown, "Tails").headers[2:])


def test_texts_are_their_values(compared):
    """What is printed first in a cell is its value, in the unit of the header."""
    for found in document(compared).tables:
        for texts, values in zip(found.cells, found.values, strict=True):
            for header, text, value in zip(found.headers, texts, values, strict=True):
                if value is None or "inference" in header or "planning" in header:
                    continue
                percent = "[%" in header or header == "at or between nodes"
                scale = 100.0 if percent else 1.0
                digits = len(re.match(r"[+-]?\d+\.?(\d*)", text).group(1))
                printed = float(re.match(r"[+-]?[\d.]+", text).group())
                assert printed == pytest.approx(scale * value, abs=0.51 * 10.0**-digits)


def test_tails_are_ordered_and_hold_by_definition(compared):
    found = table(document(compared), "Tails")
    for name, result in compared.results.items():
        total, clearance = np.sort(result.metrics.total), np.sort(result.metrics.clearance)
        worst = len(total) // 20
        assert column(found, "dearest 5 %")[name] == pytest.approx(total[-worst:].mean())
        assert column(found, "closest 5 % [m]")[name] == pytest.approx(clearance[:worst].mean())
        ordered = [column(found, h)[name] for h in ("cost 50 %", "cost 95 %", "cost 99 %")]
        assert ordered == sorted(ordered)


def test_training_noise_shows_each_training(compared):
    found = table(document(compared), "Training noise")
    assert [row[:2] for row in found.cells] == [
        ("learned", "all 3"),
        ("learned", "s0"),
        ("learned", "s1"),
        ("learned", "s2"),
    ]
    runs = compared.results["learned"].runs
    totals = [values[2] for values in found.values]
    assert totals[1:] == [run.total for run in runs]
    assert totals[0] == pytest.approx(np.mean(totals[1:]))
    assert found.values[0][3] == pytest.approx(np.std(totals[1:], ddof=1))
    assert all(values[3] is None for values in found.values[1:])
    single = {name: row for name, row in compared.controllers.items() if name != "learned"}
    alone = compare(single, compared.scenario, 64, 3, progress=False)
    assert not any("Training" in found.caption for found in document(alone).tables)


def test_rows_of_different_lengths_are_told(compared):
    assert document(compared).setting.startswith("600 episodes a row, seed 3")
    fewer = dataclasses.replace(
        compared.results["still"], metrics=compared.results["still"].metrics.first(500)
    )
    mixed = dataclasses.replace(compared, results=compared.results | {"still": fewer})
    assert document(mixed).setting.startswith("500 to 600 episodes a row")


def test_warnings_and_failures_are_notes(compared):
    told = dataclasses.replace(compared, warnings=("too wide",), errors={"x": "no fuel"})
    notes = document(told, notes=("a note",)).notes
    assert notes == ("a note", "too wide", "x did not finish: no fuel")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(80.0, "80 s"), (0.0123, "12.3 ms"), (4.5e-6, "4.5 µs"), (5.1e-8, "51 ns"), (0.0, "0 s")],
)
def test_durations(seconds, text):
    assert duration("t")({"t": seconds}) == text
    assert duration("t")({"t": float("nan")}) == "–"


# ------------------------------------------------------------------ files


def test_the_table_holds_no_times_and_the_times_are_beside(compared, tmp_path):
    """Where and how it is computed changes no byte of table.csv."""
    slower = {
        name: dataclasses.replace(result, inference_time=2.0, preparation_time=3.0, wall_time=4.0)
        for name, result in compared.results.items()
    }
    elsewhere = dataclasses.replace(
        compared, results=slower, wall_time=9.0, provenance={"cpu": "Z80", "date": "today"}
    )
    for name, comparison in (("here", compared), ("there", elsewhere)):
        save(comparison, tmp_path / name, figures=False)
    here, there = ((tmp_path / name / "table.csv").read_bytes() for name in ("here", "there"))
    assert here == there
    assert b"Z80" not in there
    times = read_document(tmp_path / "there").frames["times"]
    assert list(times.columns) == ["inference_time", "preparation_time", "wall_time"]
    assert times.loc["SCP"].tolist() == [2.0, 3.0, 4.0]
    assert not set(times.columns) & set(read_document(tmp_path / "here").frames["table"].columns)


def test_save_writes_what_a_report_needs(compared, tmp_path):
    written = save(compared, tmp_path, figures=False, title="Mine", notes=("n",))
    assert {path.name for path in written} == {path.name for path in tmp_path.iterdir()}
    back = read_document(tmp_path)
    assert (back.kind, back.title, back.notes) == ("compare", "Mine", ("n",))
    assert back.tables == document(compared).tables
    names = [row["name"] for row in back.scene["rows"]]
    assert names == [*list(compared.results)[:-1], "learned, s0"]
    assert back.figures == ()
    assert json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["seed"] == 3


def test_figures_are_listed_in_order_and_the_same_every_time(compared, tmp_path):
    pytest.importorskip("matplotlib")
    from slipcar.evaluation.figures import saved as plots

    def draw():
        return [
            path
            for folder in (tmp_path, tmp_path / "again")
            for path in plots.save_figure(plots.tradeoff_figure(compared), folder, "tradeoff")
        ]

    captions = {"absent": "Not drawn.", "tradeoff": "Drawn."}
    written = save_document(document(compared), tmp_path, draw, captions)
    assert read_document(tmp_path).figures == (Figure("tradeoff", "Drawn."),)
    for suffix in ("png", "pdf", "svg"):
        here, again = tmp_path / f"tradeoff.{suffix}", tmp_path / f"again/tradeoff.{suffix}"
        assert {here, again} <= set(written)
        assert here.read_bytes() == again.read_bytes()
        assert here.stat().st_size > 1000


def test_tables_are_there_when_drawing_fails(compared, tmp_path):
    def draw():
        raise ImportError("No module named 'matplotlib'")

    with pytest.raises(ImportError, match=r"pip install 'matplotlib>=.*the tables are in"):
        save_document(document(compared), tmp_path, draw, {}, lambda: {"rows": []})
    back = read_document(tmp_path)
    assert back.tables == document(compared).tables
    assert back.scene == {"rows": []}


# ------------------------------------------------------------------ the scene


def test_cars_drive_the_paths_of_the_evaluation(compared, paper):
    shown = scene(compared, paths=5)
    assert json.loads(json.dumps(shown, allow_nan=False)) == shown
    for row, (name, controller) in zip(shown["rows"], compared.controllers.items(), strict=True):
        controller = controller.controllers[0] if isinstance(controller, Runs) else controller
        states, _ = sample_paths(controller, paper, 5, seed=3)
        np.testing.assert_allclose(row["paths"], states[..., :3], atol=5.1e-5)
        assert row["closed"] == compared.results[name].closed_loop
    np.testing.assert_allclose(shown["obstacles"], paper.obstacles, atol=5.1e-5)
    np.testing.assert_allclose(shown["times"], paper.times, atol=5.1e-5)


def test_hits_are_the_first_nodes_inside(compared, paper):
    shown = scene(compared, ["SCP"], paths=200)
    states, _ = sample_paths(compared.controllers["SCP"], paper, 200, seed=3)
    inside = paper.signed_distance(states) < 0.0
    hits = shown["rows"][0]["hits"]
    assert (
        sum(hit is not None for hit in hits)
        == compared.results["SCP"].metrics.collision[:200].sum()
        > 0
    )
    for hit, row in zip(hits, inside, strict=True):
        assert (hit is None and not row.any()) or (row[hit] and not row[:hit].any())


def test_iterates_end_in_the_plan(compared):
    found = compared.controllers["SCP"].plan
    shown = scene(compared, [], paths=1)
    assert shown["rows"] == []
    assert shown["iterates"]["name"] == "SCP"
    steps = shown["iterates"]["steps"]
    accepted = [step for step in found.history if step.accepted]
    assert len(steps) == len(accepted) + 1
    np.testing.assert_allclose(steps[0]["path"], found.guess[:, :2], atol=5.1e-5)
    np.testing.assert_allclose(steps[-1]["path"], found.mean[:, :2], atol=5.1e-5)
    assert steps[-1]["effort"] == accepted[-1].effort


def test_a_comparison_without_plans_has_no_iterates(paper, replay):
    c = compare({"still": replay(paper, (0.0, 0.0))}, paper, 20, progress=False)
    shown = scene(c)
    assert shown["iterates"] is None
    assert len(shown["rows"][0]["paths"]) == 12


def test_of_many_rows_a_few_are_shown_at_first(paper, replay, turning):
    rows = {f"r{i}": replay(paper, 0.1 * i * turning) for i in range(6)}
    for name in ("r3", "r4", "r5"):
        rows[name].closed_loop = True
    shown = scene(compare(rows, paper, 20, reference="r1", progress=False))
    assert [row["name"] for row in shown["rows"] if row["shown"]] == ["r1", "r3", "r4"]


def test_what_has_no_error_prints_the_mean_alone():
    row = {"cost": 1.25, "cost_se": 0.5, "cost_low": -0.5, "cost_high": 2.0}
    single = {"cost": 1.25, **dict.fromkeys(("cost_se", "cost_low", "cost_high"), float("nan"))}
    assert with_error("cost")(row) == "1.250 ± 0.500"
    assert with_error("cost")(single) == "1.250"
    text = with_interval("cost", "cost", 10.0, 1, "+")
    assert text(row) == "+12.5 [-5.0, +20.0]"
    assert text(single) == "+12.5"

import json

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation import compare, evaluate
from slipcar.evaluation.metrics import FIELDS
from slipcar.evaluation.provenance import commit, provenance
from slipcar.evaluation.statistics import paired_difference

EPISODES = 300


class Counted:
    """Counts its calls; identified by its name."""

    def __init__(self, inner, name):
        self.inner, self.name, self.calls = inner, name, 0
        self.observation, self.closed_loop = inner.observation, inner.closed_loop

    def fingerprint(self):
        return self.name

    def predict(self, observation, **rest):
        self.calls += 1
        return self.inner.predict(observation, **rest)


class Raises:
    def __init__(self, error):
        self.error = error

    def predict(self, observation, **rest):
        raise self.error


@pytest.fixture
def rows(paper, replay, turning):
    return {
        "still": Counted(replay(paper, (0.0, 0.0)), "still"),
        "SCP": Counted(replay(paper, turning), "turning"),
        "half": Counted(replay(paper, 0.5 * turning), "half"),
    }


def run(rows, scenario, **options):
    return compare(rows, scenario, EPISODES, **{"seed": 3, "progress": False, **options})


def same(a, b):
    return all(
        np.array_equal(getattr(a.metrics, name), getattr(b.metrics, name)) for name in FIELDS
    )


# ------------------------------------------------------------------ the table


def test_rows_are_what_evaluate_says(rows, paper):
    c = run(rows, paper)
    assert list(c.frame.index) == list(rows)
    for name, controller in rows.items():
        r = evaluate(controller, paper, EPISODES, seed=3)
        assert same(r, c.results[name])
        assert c.frame.loc[name, "total"] == r.total
        assert c.frame.loc[name, "collision_rate"] == r.collision_rate


def test_differences_are_paired_and_to_the_reference(rows, paper):
    c = run(rows, paper)
    assert c.reference == "SCP"  # the first row with SCP in its name
    expected = paired_difference(c.results["half"].metrics.total, c.results["SCP"].metrics.total)
    columns = ["total_difference", "total_difference_low", "total_difference_high"]
    assert tuple(c.frame.loc["half", columns]) == expected
    assert c.frame.loc["SCP", columns].isna().all()
    assert run(rows, paper, reference="still").reference == "still"
    assert run({"a": rows["half"], "b": rows["still"]}, paper).reference == "a"


def test_a_controller_that_raises_is_a_row_and_the_others_go_on(rows, paper):
    c = run({"broken": Raises(RuntimeError("no fuel")), **rows}, paper)
    assert c.errors == {
        "broken": "RuntimeError: no fuel; raised by Raises.predict at step 0, episodes 0 to 1023"
    }
    assert list(c.results) == list(rows)
    assert c.frame.loc["broken", "error"] == c.errors["broken"]
    assert np.isnan(c.frame.loc["broken", "total"])
    for text in (c.to_markdown(), c.to_csv(), c.to_json()):
        assert "no fuel" in text


def test_a_raising_reference_leaves_differences_empty(rows, paper):
    c = run({"SCP": Raises(ValueError("x")), "half": rows["half"]}, paper)
    assert c.frame["total_difference"].isna().all()
    assert "half" in c.to_markdown()


def test_all_rows_may_fail(paper):
    c = run({"a": Raises(ValueError("x"))}, paper)
    assert "did not finish" in c.to_markdown()
    assert c.to_latex()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"controllers": {}}, "at least one controller"),
        ({"controllers": {"": None}}, "non-empty string in one line, not ''"),
        ({"controllers": {"a": 3}}, "predict"),
        ({"reference": "b"}, r"unknown reference 'b'; the rows are \['a'\]"),
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
    ],
)
def test_bad_arguments_are_named(replay, paper, change, message):
    arguments = {"controllers": {"a": replay(paper, (0, 0))}, "scenario": paper, **change}
    with pytest.raises(ValueError, match=message):
        compare(**arguments, episodes=10, progress=False)


# ------------------------------------------------------------------ finished rows


def test_finished_rows_are_reused(rows, paper, tmp_path):
    first = run(rows, paper, folder=tmp_path)
    calls = rows["SCP"].calls
    again = run(rows, paper, folder=tmp_path)
    assert again.reused == tuple(rows)
    assert rows["SCP"].calls == calls
    assert all(same(first.results[name], again.results[name]) for name in rows)
    assert again.frame.equals(first.frame)
    run(rows, paper, folder=tmp_path, resume=False)
    assert rows["SCP"].calls == 2 * calls


@pytest.mark.parametrize(
    "change",
    [{"seed": 4}, {"substeps": 2}, {"scenario": Scenario.named("paper").replace(clearance=0.2)}],
)
def test_rows_of_another_setting_are_not_reused(rows, paper, tmp_path, change):
    run(rows, paper, folder=tmp_path)
    scenario = change.pop("scenario", paper)
    assert run(rows, scenario, folder=tmp_path, **change).reused == ()


def test_a_changed_controller_invalidates_its_own_row_alone(rows, paper, replay, tmp_path):
    run(rows, paper, folder=tmp_path)
    assert compare(rows, paper, 200, 3, folder=tmp_path, progress=False).reused == ()
    changed = {**rows, "half": Counted(replay(paper, (0.1, 0.0)), "other")}
    assert run(changed, paper, folder=tmp_path).reused == ("still", "SCP")


def test_an_interruption_leaves_finished_rows(rows, paper, tmp_path):
    interrupted = {**rows, "half": Raises(KeyboardInterrupt())}
    with pytest.raises(KeyboardInterrupt):
        run(interrupted, paper, folder=tmp_path)
    assert run(rows, paper, folder=tmp_path).reused == ("still", "SCP")


# ------------------------------------------------------------------ what is written


def test_tables_mark_the_loop_and_emphasise_the_best(rows, paper):
    rows["half"].closed_loop = True
    c = run(rows, paper)
    best = c.frame["total"].astype(float).idxmin()
    lines = [line for line in c.to_markdown().splitlines() if line.startswith("|")]
    for name in rows:
        row = next(line for line in lines if line.startswith(f"| {name} "))
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert cells[1] == ("closed" if name == "half" else "open")
        value = f"{c.frame.loc[name, 'total']:.3f} ± {c.frame.loc[name, 'total_se']:.3f}"
        assert cells[2] == (f"**{value}**" if name == best else value)


def test_latex_is_escaped_and_ruled(rows, paper):
    text = run({"100 % SCP_1 & co": rows["SCP"], "b": rows["half"]}, paper).to_latex()
    assert r"100 \% SCP\_1 \& co" in text
    for part in (r"\toprule", r"\midrule", r"\bottomrule", r"\textbf{", r"$\pm$", r"$\Delta$"):
        assert part in text
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 6


def test_csv_holds_the_raw_numbers(rows, paper, tmp_path):
    import pandas as pd

    c = run(rows, paper)
    c.to_csv(tmp_path / "table.csv")
    read = pd.read_csv(tmp_path / "table.csv", index_col="controller")
    np.testing.assert_allclose(read["total"], c.frame["total"], rtol=1e-15)


def test_json_says_how_to_repeat_it(rows, paper):
    open_field = paper.replace(obstacles=())
    data = json.loads(run(rows, open_field).to_json())
    assert Scenario.from_json(json.dumps(data["scenario"])) == open_field
    assert (data["seed"], data["episodes"], data["substeps"]) == (3, EPISODES, 1)
    assert data["reference"] == "SCP"
    assert [row["controller"] for row in data["rows"]] == list(rows)
    prints = [row["fingerprint"] for row in data["rows"]]
    assert len(set(prints)) == 3  # by what they are called
    assert data["rows"][0]["clearance_p05"] is None  # JSON has no infinity
    told = data["provenance"]
    assert told["versions"]["numpy"] == np.__version__
    assert {"date", "python", "cpu", "cpu_count", "os", "commit", "code"} <= told.keys()


def test_provenance_is_about_this_checkout():
    told = provenance()
    assert len(told["code"]) == 16
    found = commit()
    assert found is None or len(found.removesuffix("+changes")) == 40


def test_save_writes_the_tables(rows, paper, tmp_path):
    c = run(rows, paper)
    written = c.save(tmp_path / "deep" / "folder", figures=False)
    assert {path.name for path in written} == {
        "table.md", "table.csv", "times.csv", "table.tex", "results.json", "document.json"
    }  # fmt: skip
    assert (tmp_path / "deep/folder/table.md").read_text(encoding="utf-8") == c.to_markdown()


def test_the_terminal_shows_every_row_and_interval(rows, paper):
    from rich.console import Console

    from slipcar.evaluation.report.comparison import terminal

    c = run({**rows, "broken": Raises(RuntimeError("no [fuel]"))}, paper)
    console = Console(width=140, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(terminal(c))
    text = console.export_text()
    low, high = c.results["SCP"].collision_interval
    assert f"[{100 * low:.2f}, {100 * high:.2f}]" in text
    assert "RuntimeError: no [fuel]" in text
    assert all(name in text for name in rows)


def test_numpy_scalars_are_numbers_in_every_record(paper, tmp_path, replay):
    """Rows, kept cells and files are the same as with Python's own."""
    rows = {"a": replay(paper, np.zeros((40, 2)))}
    scalars = compare(
        rows,
        paper,
        episodes=np.int64(64),
        seed=np.uint32(1),
        substeps=np.int8(2),
        n_jobs=np.int64(1),
        time_limit=np.float32(60.0),
        folder=tmp_path / "a",
    )
    plain = compare(rows, paper, 64, 1, substeps=2, time_limit=60.0, folder=tmp_path / "a")
    assert plain.reused == ("a",)
    scalars.save(tmp_path / "a", figures=False)
    plain.save(tmp_path / "b", figures=False)
    read = [json.loads((tmp_path / name / "results.json").read_text()) for name in "ab"]
    assert read[0]["seed"] == read[1]["seed"] == 1
    assert read[0]["episodes"] == read[1]["episodes"] == 64
    result = evaluate(rows["a"], paper, np.int64(64), np.int64(1), batch_size=np.int64(8))
    assert (type(result.seed), type(result.substeps)) == (int, int)

"""Results and comparisons in a notebook: short, as HTML, drawn, as frames and datasets."""

import re
import sys

import numpy as np
import pytest

from slipcar.evaluation import compare
from slipcar.evaluation.runs import Runs
from slipcar.evaluation.suites import slip
from slipcar.evaluation.suites.records import SuiteResult
from slipcar.evaluation.suites.suite import run_suite


@pytest.fixture
def compared(paper, replay, turning):
    runs = Runs(tuple(replay(paper, w * turning) for w in (0.9, 1.1)), ("s0", "s1"))
    rows = {"still": replay(paper, 0.0 * turning), "<b>SCP</b>": replay(paper, turning)}
    return compare({**rows, "learned": runs}, paper, 300, progress=False)


def test_reprs_are_short(compared):
    for record in (compared, *compared.results.values(), compared.results["still"].metrics):
        assert len(repr(record)) < 400
        assert "array([" not in repr(record)
    assert repr(compared) == "Comparison(3 rows, 300 episodes, seed 0, reference '<b>SCP</b>')"
    assert "2 trainings" not in repr(compared.results["still"])
    assert "trainings 2" in repr(compared.results["learned"])
    assert f"total cost {compared.results['still'].total:.3f}" in repr(compared.results["still"])


def test_reprs_of_a_suite_are_short(paper, replay, turning):
    suite = slip.suite(8, (0.0, 0.1))
    rows = {suite.reference: replay(paper, turning)}
    result = run_suite(type(suite)(**{**vars(suite), "rows": rows}), progress=False)
    assert isinstance(result, SuiteResult)
    assert len(repr(result)) < 400


def test_html_shows_the_main_table_and_what_it_says(compared):
    html = compared._repr_html_()
    assert html.count("<table>") == html.count("</table>") == 1
    assert "&lt;b&gt;SCP&lt;/b&gt;" in html
    assert "<b>" not in html
    assert f"{compared.results['still'].total:.3f} ± " in html
    assert "Cheapest: “" in html
    assert len(re.findall(r"<tr>", html)) == 1 + len(compared.results)
    assert "collisions" in compared.results["learned"]._repr_html_()


def test_the_winner_alone_is_emphasised(compared):
    bold = re.findall(r"<strong>(.*?)</strong>", compared._repr_html_())
    first = compared.leaders["total"]
    winners = [name for name in (first.winner,) if name]
    assert [text for text in bold if "±" in text] == [
        f"{compared.results[name].total:.3f} ± {compared.results[name].total_se:.3f}"
        for name in winners
    ]


def test_a_comparison_is_drawn_into_the_axes_it_is_given(compared):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    _, axes = plt.subplots()
    assert compared.plot(axes) is axes
    drawn = {line.get_label(): line for line in axes.lines}
    still = compared.results["still"]
    shown = drawn[next(label for label in drawn if label.startswith("still"))]
    assert shown.get_ydata()[0] in (still.total, pytest.approx(np.nan, nan_ok=True))
    assert compared.plot().figure is not axes.figure
    plt.close("all")


def test_nothing_finished_is_nothing_to_plot(paper):
    def fails(scenario):
        raise RuntimeError("no fuel")

    failed = compare({"a": fails}, paper, 10, progress=False)
    with pytest.raises(ValueError, match="no row finished"):
        failed.plot()
    assert "1 failed" in repr(failed)
    assert "no fuel" in failed._repr_html_()


def test_frames_and_datasets_hold_every_episode(compared):
    pytest.importorskip("xarray")
    assert compared.to_frame() is compared.frame
    one, several = compared.results["still"], compared.results["learned"]
    np.testing.assert_array_equal(one.to_frame()["total"], one.metrics.total)
    frame = several.to_frame()
    assert frame.index.names == ["training", "episode"]
    np.testing.assert_array_equal(frame.loc[1, "goal"], several.runs[1].metrics.goal)
    data = compared.to_xarray()
    assert data["total"].dims == ("controller", "episode")
    np.testing.assert_array_equal(data["total"].sel(controller="still"), one.metrics.total)
    mean = float(data["collision"].sel(controller="learned").mean())
    assert mean == pytest.approx(several.collision_rate)


def test_without_xarray_it_says_what_to_install(compared, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match=r"to_xarray needs xarray .*: pip install xarray"):
        compared.to_xarray()

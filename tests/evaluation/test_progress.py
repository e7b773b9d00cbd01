"""How far rows are: bars where they can be drawn, lines elsewhere, and a look into long cells."""

import io
import re
import sys
import time

import numpy as np
import pytest
from rich.console import Console

from slipcar.evaluation import compare, progress
from slipcar.evaluation.progress import Bars
from slipcar.evaluation.rollout import Stretch, measure
from slipcar.evaluation.ticks import Ticks

ROWS = {"planned feedback, risk ≤ 0.1 %": 10_000, "PPO": 10_000}


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("columns", [120, 80, 60, 40])
def test_bars_cut_no_number(columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    with Bars(ROWS) as bars:
        for row in ROWS:
            bars.advance(row, 9_000)
        bars.note("PPO", "failed")
        time.sleep(0.05)
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", terminal.getvalue()).replace("\r", "\n")
    assert "…" not in shown
    last = shown.splitlines()[-3:]
    assert all(len(line) <= columns for line in last)
    assert "failed" in "".join(last)
    assert "left" in shown
    assert "90 %" in shown or "9,000 of 10,000 episodes" in shown


def test_a_pipe_is_told_of_each_row_once(monkeypatch, capsys):
    with Bars(ROWS) as bars:
        for _ in range(10):
            for row in ROWS:
                bars.within(row, 0, 500.0)
                bars.advance(row, 1_000, 0)
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(": ")[0] for line in lines] == list(ROWS)
    assert all("10,000 episodes" in line for line in lines)


def test_a_pipe_hears_now_and_then_how_long_it_takes(monkeypatch, capsys):
    clock = iter(np.arange(0.0, 1e4, 20.0))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    with Bars({"slow": 1000}) as bars:
        for _ in range(4):
            bars.advance("slow", 200)
    lines = capsys.readouterr().err.splitlines()
    assert lines
    assert re.fullmatch(r"slow: \d+ of 1,000 episodes, \d+ (min \d+ )?s, some .* left", lines[-1])


def test_a_notebook_without_widgets_gets_text(monkeypatch, capsys):
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    assert Console().is_jupyter
    with Bars({"PPO": 100}) as bars:
        bars.advance("PPO", 100)
    out, errors = capsys.readouterr()
    assert out == "PPO: 100 episodes, 0 s\n"
    assert not errors


def test_nothing_is_said_where_nothing_is_wanted(capsys):
    with Bars(ROWS, shown=False) as bars:
        bars.advance("PPO", 10_000)
    assert capsys.readouterr() == ("", "")


def test_a_cell_tells_how_far_it_is(paper, replay, turning):
    done = []
    measure(Stretch(replay(paper, turning), paper, 1024, 1500, 0), done.append)
    assert len(done) == 2 * (paper.nodes - 1)
    assert done == sorted(done)
    assert done[0] == pytest.approx(1024 / 40)
    assert done[39] == pytest.approx(1024)
    assert done[-1] == pytest.approx(1500)


def test_another_process_writes_how_far_it_is(tmp_path, monkeypatch):
    ticks = Ticks(str(tmp_path))
    monkeypatch.setattr("slipcar.evaluation.ticks._PAUSE", -1.0)
    write = ticks.writer("3")
    write(12.5)
    (tmp_path / "half").write_text("")
    assert dict(ticks.read()) == {"3": 12.5}
    Ticks(str(tmp_path / "gone")).writer("1")(1.0)  # no folder is no error


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_long_cells_are_looked_into(n_jobs, paper, monkeypatch):
    class Slow:
        observation, closed_loop = "state", True

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            time.sleep(0.06)
            return np.zeros((len(observation), 2)), state

    seen = []
    within = Bars.within
    monkeypatch.setattr(
        Bars, "within", lambda self, *told: (seen.append(told[2]), within(self, *told))
    )
    compare({"slow": Slow()}, paper, 100, n_jobs=n_jobs, progress=False)
    assert any(0.0 < done < 100.0 for done in seen)

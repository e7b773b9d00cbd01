"""The benchmarks of the live page, the control loop and the law in C measure what they say."""

import importlib
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    yield importlib.import_module
    for name in ("c_law", "control_loop", "live_page", "report"):
        sys.modules.pop(name, None)


def test_control_loop_times_every_step_and_counts_what_is_late(bench):
    loop = bench("control_loop")
    clock, processor, controller = loop.latencies(60, None)
    assert clock.shape == processor.shape == (60,)
    assert (clock > 0).all()
    row = loop.row("clock", clock, controller, None)
    assert row["late"] == row["replans failed"] == 0
    assert row["median"] <= row["99 %"] <= row["99.9 %"] <= row["worst"]
    _, _, controller = loop.latencies(20, 1e-6)
    assert controller.late > 0


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_law_in_c_is_the_same_law(bench):
    row = bench("c_law").row("u-turn", shutil.which("cc"))
    assert row["double: difference"] < 1e-9
    assert 0 < row["float: difference"] < 1e-4
    assert 0 < row["double [µs]"] < row["Python [µs]"]


def test_live_page_is_dragged_and_drawn(bench):
    pytest.importorskip("aiohttp")
    pytest.importorskip("playwright.sync_api")
    page = bench("live_page")
    try:
        row = page.row("plan with feedback", "paper", "", seconds=1.0)
    except FileNotFoundError as missing:
        pytest.skip(str(missing))
    assert row["updates a second"] > 0
    assert row["inputs"] > 10
    assert np.isfinite(row["input to picture [ms], median"])

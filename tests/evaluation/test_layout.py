"""No table and no sentence is cut, however narrow the terminal: no digit, no sign, no unit."""

import io
import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rich.console import Console

from slipcar.envs import Scenario
from slipcar.evaluation.cli import main
from slipcar.evaluation.commands import plan_text
from slipcar.evaluation.commands.simulate import episodes_table
from slipcar.evaluation.frontier import frontier
from slipcar.evaluation.makers import Maker
from slipcar.evaluation.report import comparison as report
from slipcar.evaluation.report import frontier as report_frontier
from slipcar.evaluation.report.document import read_document
from slipcar.evaluation.report.layout import Fitted, Prose, lines
from slipcar.evaluation.report.table import Table
from slipcar.evaluation.rollout import evaluate
from slipcar.evaluation.runs import Runs
from slipcar.evaluation.suites import horizon, random, slip
from slipcar.evaluation.suites.suite import run_suite
from slipcar.planner import OpenLoop, plan

WIDTHS = (120, 100, 80, 60)
# What belongs to one number: its sign, error, interval's ends, exponent, unit.
NUMBER = re.compile(r"[+-]?\d[\d.]*(?:e[+-]?\d+)?(?: ± [\d.]+)?(?: %)?")


def printed(renderable, width):
    """The lines that a terminal of this width shows."""
    out = io.StringIO()
    Console(file=out, width=width, highlight=False, legacy_windows=False).print(renderable)
    return out.getvalue().splitlines()


def assert_uncut(table, shown, width):
    assert all(len(line) <= width for line in shown), max(shown, key=len)
    assert not any("…" in line for line in shown)
    text = "\n".join(shown)
    for j in range(len(table.headers)):
        for row in table.cells:
            fits = table.numeric(j) and width >= 40
            whole = [row[j]] if fits else NUMBER.findall(row[j])
            assert all(part in text for part in whole), (table.headers[j], row[j])
    for word in {word for row in table.cells for cell in row for word in cell.split()}:
        assert len(word) > width - 4 or word in text
    for header in table.headers[1:]:
        assert all(word in text for word in header.split() if len(word) < width - 4)


@pytest.fixture(scope="module")
def documents():
    """One of each kind, small."""
    paper = Scenario.named("paper")
    straight, steered = Maker.of("straight"), Maker.of("planned-feedback")
    runs = Runs(tuple(maker(paper) for maker in (straight, steered)), ("seed 0", "seed 1"))
    rows = {"stochastic SCP": straight, "planned feedback, risk ≤ 0.1 %": steered, "PPO": runs}
    from slipcar.evaluation import compare

    found = {"compare": report.document(compare(rows, paper, 64, progress=False))}
    few = frontier(
        paper, 32, prices=(0.0, 10.0), receding_prices=(), policy=straight(paper), progress=False
    )
    found["frontier"] = report_frontier.document(few)
    suites = {
        "random": (random, random.suite(8, 2)),
        "slip": (slip, slip.suite(8)),
        "horizon": (horizon, horizon.suite(8, (11, 21, 41))),
    }
    for name, (module, suite) in suites.items():
        fields = dict(vars(suite))
        fields["rows"] = {suite.reference: straight, "planned feedback": steered}
        found[name] = module.document(run_suite(type(suite)(**fields), progress=False))
    return found


@pytest.mark.parametrize("width", [*WIDTHS, 40, 20])
def test_no_number_of_any_document_is_cut(documents, width):
    for name, document in documents.items():
        assert document.tables, name
        for table in document.tables:
            assert_uncut(table, printed(Fitted(table), width), width)
        shown = printed(document.terminal(), width)
        assert all(len(line) <= width for line in shown)


@pytest.mark.parametrize("width", [*WIDTHS, 40])
def test_no_number_of_a_plan_or_an_episode_is_cut(width):
    paper = Scenario.named("paper")
    several = plan(paper, starts=3)
    free = plan(paper, free_final_time=True)
    metrics = evaluate(OpenLoop(several), paper, 5).metrics
    for fitted in (
        plan_text.iterations_table(several),
        plan_text.alternatives_table(several),
        plan_text.horizons_table(free),
        episodes_table(metrics),
    ):
        assert len(fitted.table.cells) > 2
        assert_uncut(fitted.table, printed(fitted, width), width)


CELLS = st.one_of(
    st.floats(allow_nan=False).map("{:.3f}".format),
    st.floats(allow_nan=False, allow_infinity=False).map("{0:.2e} ± {0:.2e}".format),
    st.floats(-1e3, 1e3).map("{0:+.2f} [{0:+.2f}, {0:+.2f}]".format),
    st.text("ab −", min_size=1, max_size=60).map(lambda text: text.strip() or "a"),
    st.integers(0, 100).map("risk ≤ {} %".format),
)


@st.composite
def tables(draw):
    columns, rows = draw(st.integers(2, 9)), draw(st.integers(0, 5))
    cells = tuple(tuple(draw(CELLS) for _ in range(columns)) for _ in range(rows))
    numeric = [j > 0 and draw(st.booleans()) for j in range(columns)]
    values = tuple(tuple(1.0 if wanted else None for wanted in numeric) for _ in range(rows))
    headers = tuple(draw(st.text("abc []", max_size=30)) for _ in range(columns))
    return Table("", headers, cells, values)


@given(tables(), st.integers(25, 130))
@example(Table("", ("a",), (("1",),), ((None,),)), 80)
@example(Table("", ("a", "b"), (), ()), 80)
@settings(max_examples=200, deadline=None)
def test_any_table_fits_any_width(table, width):
    shown = [line.plain for line in lines(table, width)]
    assert all(len(line) <= width for line in shown)
    # Between the rules and blanks there is every letter of every cell, as often as it must be.
    text = "".join("".join(shown).split())
    for row in table.cells:
        for cell in row:
            for part in NUMBER.findall(cell):
                assert len(part) >= width - 12 or any(part in line for line in shown)
            assert all(text.count(letter) >= cell.count(letter) for letter in set(cell) - {" "})


def test_what_fits_is_one_block_and_what_does_not_is_stacked():
    headers = ("controller", "total cost", "collisions")
    cells = (("SCP", "5.051 ± 0.006", "1.00 [0.82, 1.21]"), ("PPO", "5.0 ± 0.1", "–"))
    table = Table("", headers, cells, ((None, 5.0, 1.0), (None, 5.0, None)), frozenset({(0, 1)}))
    wide = [line.plain for line in lines(table, 80)]
    assert wide == [
        "controller     total cost         collisions",
        "──────────  ─────────────  ─────────────────",
        "SCP         5.051 ± 0.006  1.00 [0.82, 1.21]",
        "PPO             5.0 ± 0.1                  –",
    ]
    narrow = [line.plain for line in lines(table, 30)]
    assert narrow == [
        "controller     total cost",
        "──────────  ─────────────",
        "SCP         5.051 ± 0.006",
        "PPO             5.0 ± 0.1",
        "",
        "controller         collisions",
        "──────────  ─────────────────",
        "SCP         1.00 [0.82, 1.21]",
        "PPO                         –",
    ]
    assert [line.plain for line in lines(table, 22)][:3] == [
        "SCP",
        "  total cost:",
        "    5.051 ± 0.006",
    ]
    (bold,) = [line for line in lines(table, 80) if line.spans]
    assert bold.plain[bold.spans[0].start : bold.spans[0].end] == "5.051 ± 0.006"


def test_prose_keeps_numbers_and_their_units_together():
    text = "It costs 5.038 ± 0.010 and collides on ≤ 0.1 % of the paths."
    for width in range(14, 70):
        shown = "\n".join(printed(Prose(text), width))
        assert "5.038 ± 0.010" in shown
        assert "≤ 0.1 %" in shown


# ------------------------------------------------------------------ whole commands


@pytest.fixture
def few_rows(monkeypatch):
    """The usual table without what takes seconds."""
    from slipcar.evaluation import rows

    whole = rows.row_makers

    def makers(scenario, **how):
        made, notes = whole(scenario, **how)
        slow = (rows.CHANCE, rows.STEERED_CHANCE, rows.RECEDING, rows.RECEDING_MARGINS)
        return {name: maker for name, maker in made.items() if name not in slow}, notes

    monkeypatch.setattr(rows, "row_makers", makers)


@pytest.mark.parametrize("columns", [80, 60])
@pytest.mark.usefixtures("few_rows")
def test_compare_honours_columns_and_cuts_nothing(columns, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    options = ["--episodes", "64", "--no-figures", "--folder", "r", "--all-tables"]
    monkeypatch.chdir(tmp_path)
    assert main(["compare", *options]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert all(len(line) <= columns for line in shown), max(shown, key=len)
    tables = read_document(tmp_path / "r").tables
    assert len(tables) > 6
    brief = {"effort", "obstacle", "goal"}  # without their error in a terminal
    for table in tables:
        kept = [j for j, header in enumerate(table.headers) if header not in brief]
        for row in table.cells:
            assert all(row[j] in "\n".join(shown) for j in kept if table.numeric(j))


@pytest.mark.parametrize("columns", [80, 60])
@pytest.mark.parametrize(
    "arguments", [["plan", "--starts", "2"], ["plan", "--feedback"], ["simulate", "scp"]]
)
def test_commands_honour_columns(arguments, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    assert main(arguments) == 0
    shown = capsys.readouterr().out.splitlines()
    assert all(len(line) <= columns for line in shown), max(shown, key=len)
    assert max(map(len, shown)) > columns - 20


def test_a_pipe_without_columns_is_wide(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert main(["simulate", "scp", "--episodes", "2"]) == 0
    header = capsys.readouterr().out.splitlines()[0]
    assert header.split()[0] == "episode"
    assert np.size(header.split("  ")) >= 8

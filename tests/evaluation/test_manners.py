"""What commands print, and what they find out before they compute."""

import io
import json
import os
import subprocess
import sys

import pytest

from slipcar.evaluation.cli import COMMANDS, main
from slipcar.evaluation.rows import chosen

DRIVE = ["simulate", "scp", "--episodes", "2"]


@pytest.fixture
def no_computing(monkeypatch):
    """Whoever plans or drives fails the test."""

    def refuse(*_, **__):
        raise AssertionError("computed before it was checked")

    for name in ("rollout.measure", "reproduction.reproduce.reproduce", "rows.default_rows"):
        monkeypatch.setattr(f"slipcar.evaluation.{name}", refuse)
    for name in ("planner.plan", "baselines.train_ppo", "evaluation.rows.plan"):
        monkeypatch.setattr(f"slipcar.{name}", refuse)


@pytest.fixture
def few_rows(monkeypatch, replay, paper, turning):
    def makers(scenario, **_):
        rows = {"stochastic SCP": turning, "PPO": 0.5 * turning, "planned": 0.0 * turning}
        return {name: lambda u=u: replay(paper, u) for name, u in rows.items()}, ["a note"]

    monkeypatch.setattr("slipcar.evaluation.rows.row_makers", makers)


def run(*arguments, **environment):
    return subprocess.run(
        [sys.executable, "-m", "slipcar.evaluation", *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


# ------------------------------------------------------------------ what is printed


def test_the_version_is_the_packages(capsys):
    import importlib.metadata

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"slipcar {importlib.metadata.version('slipcar')}\n"


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_can_be_quiet_or_speak_json(command, capsys):
    assert main([command, "--help"]) == 0
    said = capsys.readouterr().out
    assert "--quiet" in said
    assert "--json" in said


@pytest.mark.parametrize("arguments", [DRIVE, ["plan"]])
def test_quiet_is_quiet(arguments, capsys):
    assert main([*arguments, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_quiet_still_says_what_went_wrong(capsys):
    assert main(["plan", "--max-iterations", "1", "--quiet"]) == 1
    said = capsys.readouterr()
    assert not said.out
    assert "MAX_ITERATIONS" in said.err


def test_json_is_all_there_is_on_the_standard_output(capsys):
    assert main([*DRIVE, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert len(data["episodes"]["total"]) == 2
    assert data["summary"]["episodes"] == 2
    assert main(["plan", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["status"] == "CONVERGED"
    assert len(data["controls"]) == len(data["mean"]) - 1 == 40


@pytest.mark.usefixtures("few_rows")
def test_compare_prints_the_main_table_three_sentences_and_where_the_rest_is(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "120")  # room for the table in one piece
    options = ["compare", "--episodes", "200", "--no-figures", "--folder", str(tmp_path)]
    assert main(options) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("controller") == 1
    assert "Cheapest: “" in said
    assert "Fewest collisions: “" in said
    assert "Against “stochastic SCP” on the same paths: of 2 other rows" in said
    assert "a note" in said
    assert f"{tmp_path}/table.md; --all-tables prints them here" in said
    assert main([*options, "--all-tables"]) == 0
    whole = capsys.readouterr().out
    assert whole.count("controller") > 4
    assert main([*options, "--json"]) == 0
    out, errors = capsys.readouterr()
    assert [row["controller"] for row in json.loads(out)["rows"]] == [
        "stochastic SCP", "PPO", "planned",
    ]  # fmt: skip
    assert "a note" in errors


@pytest.mark.usefixtures("few_rows")
def test_rows_and_the_reference_can_be_chosen(tmp_path, capsys):
    options = ["compare", "--episodes", "100", "--no-figures", "--folder", str(tmp_path)]
    assert main([*options, "--rows", "ppo", "pl*", "--reference", "PPO", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert [row["controller"] for row in data["rows"]] == ["PPO", "planned"]
    assert data["reference"] == "PPO"
    assert main([*options, "--rows", "moon"]) == 2
    assert "no row is called 'moon'; the rows are ['stochastic SCP'," in capsys.readouterr().err
    assert main([*options, "--rows", "PPO", "--reference", "planned"]) == 2
    assert "--reference: no row is called 'planned'" in capsys.readouterr().err


def test_words_mean_names_and_patterns_in_the_tables_order():
    names = ["stochastic SCP", "PPO", "SCP, risk ≤ 1 %", "odd [x]"]
    assert chosen(names, []) == names
    assert chosen(names, ["ppo", "*scp*"]) == names[:3]
    assert chosen(names, ["odd [x]"]) == ["odd [x]"]
    with pytest.raises(ValueError, match="no row is called 'SCP'"):
        chosen(names, ["PPO", "SCP"])


# ------------------------------------------------------------------ before any computing


@pytest.mark.usefixtures("no_computing")
@pytest.mark.parametrize(
    "arguments",
    [
        ["compare"],
        ["compare", "--suite", "slip"],
        ["frontier"],
        ["reproduce"],
        ["plan", "--figures", "figures"],
        ["plan", "--figure", "a.png"],
        ["simulate", "scp", "--figure", "a.png"],
    ],
)
def test_without_matplotlib_nothing_is_computed(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "figures need matplotlib" in said
    assert "pip install 'matplotlib>=" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("no_computing")
@pytest.mark.parametrize(
    "arguments",
    [
        ["compare", "--folder"],
        ["compare", "--suite", "slip", "--folder"],
        ["frontier", "--folder"],
        ["reproduce", "--folder"],
        ["plan", "--figures"],
        ["train", "--folder"],
        ["simulate", "scp", "--frames"],
    ],
)
def test_a_folder_that_cannot_be_written_is_found_at_once(arguments, capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert main([*arguments, str(tmp_path / "file" / "below")]) == 2
    said = capsys.readouterr().err
    assert "cannot write into" in said
    assert "file is no folder" in said


def hidden(**more):
    """An environment without a display."""
    names = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    return {name: value for name, value in os.environ.items() if name not in names} | more


def test_human_without_a_display_is_an_error_before_driving(tmp_path):
    pytest.importorskip("pygame")
    done = subprocess.run(
        [sys.executable, "-m", "slipcar.evaluation", "simulate", "scp", "--human"],
        env=hidden(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "--human needs a display, and there is none" in done.stderr
    assert not done.stdout


def test_results_are_there_when_printing_fails(tmp_path, few_rows, monkeypatch):
    """A terminal that takes nothing costs no table."""

    class Deaf(io.StringIO):
        encoding = "ascii"

        def write(self, text):
            raise UnicodeEncodeError("ascii", text, 0, 1, "ordinal not in range")

    monkeypatch.setattr("sys.stdout", Deaf())
    options = ["compare", "--episodes", "50", "--no-figures", "--folder", str(tmp_path)]
    assert main(options) == 2
    assert "| stochastic SCP" in (tmp_path / "table.md").read_text()


def test_what_was_printed_is_there_when_drawing_fails(tmp_path, few_rows, monkeypatch, capsys):
    def refuse(*_):
        raise OSError("no space left on device")

    pytest.importorskip("matplotlib")
    monkeypatch.setattr("slipcar.evaluation.figures.saved.save_all", refuse)
    assert main(["compare", "--episodes", "50", "--folder", str(tmp_path)]) == 2
    out, errors = capsys.readouterr()
    assert "stochastic SCP" in out
    assert "no space left" in errors


def test_a_reader_that_has_enough_is_no_error():
    done = subprocess.run(
        f"{sys.executable} -m slipcar.evaluation plan | head -n 1",
        shell=True,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "iteration" in done.stdout
    assert not done.stderr


def test_hints_are_commands_for_a_checkout_too():
    from slipcar.envs.extras import install

    for extra in ("rl", "plot", "qp", "video", "data", "cluster", "report"):
        assert install(extra).startswith("pip install '")
        assert "slipcar" not in install(extra)
    assert "pygame-ce" in install("plot")


def test_hints_name_the_program_as_it_can_be_called(monkeypatch, tmp_path):
    from slipcar.evaluation.commands.output import program

    script = tmp_path / "slipcar"
    script.write_text("#!/bin/sh\n")
    script.chmod(0o755)
    monkeypatch.setattr("sys.argv", [".venv/bin/slipcar", "compare"])
    monkeypatch.setenv("PATH", str(tmp_path))
    assert program() == ".venv/bin/slipcar"
    monkeypatch.setattr("sys.argv", [str(script)])
    assert program() == "slipcar"
    monkeypatch.setattr("sys.argv", ["/x/evaluation/__main__.py"])
    assert program() == "python -m slipcar.evaluation"

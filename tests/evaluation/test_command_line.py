import json
import subprocess
import sys

import numpy as np
import pytest

from slipcar.envs import Family, Scenario
from slipcar.envs.sources import source_of
from slipcar.evaluation.cli import COMMANDS, main
from slipcar.evaluation.commands.inputs import read_controller, read_scenario
from slipcar.evaluation.makers import chargeable
from slipcar.planner import Feedback, OpenLoop, Plan, Status, plan


def test_help_teaches(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in COMMANDS)
    options = {
        "compare": ["--episodes", "--seed", "--folder", "--workers", "--policy", "--no-resume"],
        "plan": [
            "--variance-weight",
            "--starts",
            "--guess",
            "--method",
            "--compiled",
            "--shooting",
            "--free-final-time",
            "--time-weight",
            "--integrator",
            "--solver",
            "--tolerance",
            "--save",
            "--figure",
            "--figures",
            "--compare-methods",
        ],
        "frontier": ["--episodes", "--scenario", "--out", "--seed", "--workers", "--prices"],
        "simulate": [
            "--controller",
            "--video",
            "--tiled",
            "--overlay",
            "--gif",
            "--frames",
            "--human",
            "feedback",
            "straight",
            "receding",
            "ppo",
        ],
        "dataset": ["--id", "--episodes", "--observation", "--exploration-noise", "--overwrite"],
        "train": ["--total-steps", "--learning-rate", "--folder", "--seed"],
    }
    for name, expected in options.items():
        assert main([name, "--help"]) == 0
        text = capsys.readouterr().out
        assert f"slipcar {name}" in text  # an example
        for option in expected:
            assert option in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["plan", "--scenario", "moon"], "unknown scenario 'moon'"),
        (["plan", "--scenario", "random:x"], "random:SEED needs a whole number"),
        (["plan", "--scenario", "family:hard:1"], "unknown family 'hard'"),
        (["plan", "--scenario", "family:easy"], "family:NAME:SEED needs a whole number"),
        (["simulate", "ppo", "--tiled"], "--tiled needs --video"),
        (["plan", "--scenario", "nowhere.json"], "nowhere.json"),
        (["plan", "--variance-weight", "-1"], "variance_weight must be finite and >= 0"),
        (["plan", "--save", "plan.txt"], "ends in .npz"),
        (["plan", "--figure", "plan.docx"], "ends in .png, .pdf or .svg"),
        (["plan", "--compare-methods", "plan.docx"], "ends in .png, .pdf or .svg"),
        (["plan", "--worlds", "-1"], "worlds must be >= 0"),
        (["plan", "--starts", "0"], "starts must be an integer >= 1"),
        (["plan", "--guess", "missing.npz"], "missing.npz"),
        (["plan", "--free-final-time", "--time-weight", "0"], "time_weight must be finite and > 0"),
        (["plan", "--free-final-time", "--final-time-bounds", "3", "2"], "final_time_bounds"),
        (["plan", "--method", "newton", "--trust-region", "paper"], "method='convex' can"),
        (["simulate", "uber"], "unknown controller 'uber'"),
        (["simulate", "missing.npz"], "missing.npz"),
        (["simulate", "scp", "--episodes", "0"], "episodes must be at least 1, not 0"),
        (["compare", "--episodes", "0"], "episodes must be at least 1, not 0"),
        (["simulate", "scp", "--episodes", "51", "--gif", "a.gif"], "at most 50"),
        (["simulate", "scp", "--gif", "a.mp4"], "ends in .gif"),
        (["compare", "--policy", "missing"], "missing"),
        (["frontier", "--episodes", "0"], "episodes must be at least 1, not 0"),
        (["frontier", "--prices", "1", "-1"], "prices must be finite and >= 0, not -1"),
        (["frontier", "--scenario", "moon"], "unknown scenario 'moon'"),
        (["train", "--learning-rate", "-1"], "learning_rate"),
        (["train", "--minibatches", "3"], "minibatches must divide"),
    ],
)
def test_bad_values_are_one_line_and_exit_code_2(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_errors_of_our_own_are_one_line(capsys):
    main(["plan", "--scenario", "moon"])
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("arguments", [[], ["drive"], ["plan", "--tolerance", "small"], ["--x"]])
def test_unknown_words_are_exit_code_2(arguments, capsys):
    assert main(arguments) == 2
    assert capsys.readouterr().err


def test_plan_prints_saves_and_draws(tmp_path, capsys):
    saved, figure = tmp_path / "a" / "plan.npz", tmp_path / "plan.svg"
    assert main(["plan", "--save", str(saved), "--figure", str(figure)]) == 0
    text = capsys.readouterr().out
    expected = plan(Scenario.named("paper"))
    assert "CONVERGED" in text
    assert f"effort {expected.effort:.6f}" in text
    assert f"{expected.iterations} iterations" in text
    assert str(expected.certificate) in text
    np.testing.assert_array_equal(Plan.load(saved).controls, expected.controls)
    assert "<svg" in figure.read_text(encoding="utf-8")


def test_plan_tells_of_every_guess(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")  # so that no label is broken
    assert main(["plan", "--starts", "4"]) == 0
    text = capsys.readouterr().out
    rows = plan(Scenario.named("paper"), starts=4).alternatives
    # The own guess is tried with and without its penalties, and a way that was left once more.
    assert len(rows) >= 5
    assert all(row.label in text and f"{row.cost:.6f}" in text for row in rows)


def test_plan_tells_of_every_horizon_and_starts_from_an_earlier_plan(tmp_path, capsys):
    saved = tmp_path / "plan.npz"
    assert main(["plan", "--free-final-time", "--time-weight", "2", "--save", str(saved)]) == 0
    text = capsys.readouterr().out
    found = Plan.load(saved)
    assert len(found.time_search) > 2
    assert all(f"{row.final_time:.6f}" in text for row in found.time_search)
    assert f"final time {found.final_time:.6f} s" in text
    assert main(["plan", "--guess", str(saved)]) == 0
    expected = plan(Scenario.named("paper"), guess=found)
    assert f"effort {expected.effort:.6f}" in capsys.readouterr().out


def test_plan_tells_of_the_shot(capsys):
    assert main(["plan", "--shooting"]) == 0
    assert "shooting: converged" in capsys.readouterr().out


def test_plan_draws_what_it_proves_and_compares_methods(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    compared = tmp_path / "residuals.svg"
    arguments = ["--figures", str(tmp_path), "--compare-methods", str(compared), "--worlds", "1"]
    assert main(["plan", *arguments]) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {"iterations.png", "covariance.pdf", "hamiltonian.png", "residuals.svg"} <= names


def test_a_plan_that_does_not_converge_is_exit_code_1(capsys):
    assert main(["plan", "--max-iterations", "1"]) == 1
    assert "MAX_ITERATIONS" in capsys.readouterr().out


def test_simulate_prints_each_episode(capsys):
    from slipcar.evaluation import evaluate

    assert main(["simulate", "scp", "--episodes", "3", "--seed", "4"]) == 0
    text = capsys.readouterr().out
    paper = Scenario.named("paper")
    for total in evaluate(OpenLoop(plan(paper)), paper, 3, seed=4).metrics.total:
        assert f"{total:.3f}" in text


def test_simulate_draws_and_films(tmp_path):
    pytest.importorskip("pygame")
    pytest.importorskip("matplotlib")
    from PIL import Image

    figure, gif, frames = tmp_path / "p.png", tmp_path / "p.gif", tmp_path / "frames"
    arguments = ["--scenario", "open", "--episodes", "1", "--figure", str(figure)]
    assert (
        main(["simulate", "straight", *arguments, "--gif", str(gif), "--frames", str(frames)]) == 0
    )
    assert figure.read_bytes()[:4] == b"\x89PNG"
    shown = Image.open(gif)
    pictures = sorted(frames.iterdir())
    assert len(pictures) > 41  # every node, and a pause at the end
    assert shown.n_frames >= 41
    assert shown.size == Image.open(pictures[0]).size


def test_a_stored_plan_drives_the_scenario_it_was_made_for(tmp_path, monkeypatch):
    slalom = Scenario.named("slalom")
    found = plan(slalom)
    found.save(tmp_path / "open.npz")
    Feedback(found).plan.save(tmp_path / "closed.npz")
    blind, world = read_controller(str(tmp_path / "open.npz"), slalom)
    assert type(blind) is OpenLoop
    assert world == slalom
    tracked, _ = read_controller(str(tmp_path / "closed.npz"), slalom)
    assert type(tracked) is Feedback
    assert tracked.fingerprint() == Feedback(found).fingerprint()


def test_compare_end_to_end(tmp_path, capsys, monkeypatch, replay):
    driver = replay(Scenario.named("paper"), (0.1, 0.0))
    monkeypatch.setattr("slipcar.baselines.shipped_runs", lambda method, world: (driver,))
    arguments = ["compare", "--episodes", "200", "--folder", str(tmp_path), "--no-figures"]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "PPO" in text
    assert "table.md" in text
    data = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert data["episodes"] == 200
    assert data["reference"] == "stochastic SCP"
    assert main([*arguments, "--scenario", "open"]) == 0
    assert "No PPO row" in capsys.readouterr().out


def test_an_interrupted_compare_says_where_its_rows_are(tmp_path, capsys, monkeypatch, replay):
    class Interrupts:
        scenario = Scenario.named("paper")

        def predict(self, *arguments, **rest):
            raise KeyboardInterrupt

    policies = (Interrupts(), Interrupts())
    monkeypatch.setattr("slipcar.baselines.shipped_runs", lambda method, world: policies)
    arguments = ["compare", "--episodes", "100", "--folder", str(tmp_path)]
    assert main(arguments) == 130
    assert f"finished work is kept in {tmp_path}" in capsys.readouterr().err
    assert len(list((tmp_path / "cells").glob("*.npz"))) == 4


def test_scenarios_by_name_seed_and_file(tmp_path):
    assert read_scenario("gap") == Scenario.named("gap")
    assert read_scenario("random:7") == Scenario.random(7)
    path = tmp_path / "mine.json"
    path.write_text(Scenario.random(3).to_json(), encoding="utf-8")
    assert read_scenario(str(path)) == Scenario.random(3)
    assert read_scenario("family:easy:4") == Family.named("easy").sample(4)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_scenario_files_may_begin_with_a_byte_order_mark(tmp_path, encoding):
    world = Scenario.random(5)
    (tmp_path / "world.json").write_text(world.to_json(), encoding=encoding)
    assert read_scenario(str(tmp_path / "world.json")) == world
    text = (tmp_path / "world.json").read_text(encoding="utf-8")  # the mark stays in it
    assert Scenario.from_json(text) == Scenario.of(text) == source_of(text) == world


@pytest.mark.parametrize(
    ("encoding", "message"),
    [
        ("utf-16", r"world\.json is written in UTF-16: save it as UTF-8"),
        ("utf-16-le", r"world\.json is written in UTF-16-LE: save it as UTF-8"),
        ("utf-32", r"world\.json is written in UTF-32: save it as UTF-8"),
        ("latin-1", r"world\.json is not written in UTF-8 \(byte 0xe9 at \d+\): save it as UTF-8"),
    ],
)
def test_other_encodings_of_a_scenario_file_are_named(tmp_path, encoding, message):
    text = json.dumps(Scenario.random(5).to_dict() | {"é": 1}, ensure_ascii=False)
    (tmp_path / "world.json").write_text(text, encoding=encoding)
    with pytest.raises(ValueError, match=message):
        read_scenario(str(tmp_path / "world.json"))


def test_a_file_that_is_no_scenario_is_named(tmp_path):
    (tmp_path / "world.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match=r"world\.json: not a scenario: expected a JSON object"):
        read_scenario(str(tmp_path / "world.json"))


def test_plans_of_the_mean_are_had_where_chance_reaches_the_speed(tmp_path):
    """The paper's penalty does not hold there; the rows and words go without it."""
    noisy = Scenario.named("paper").replace(process_noise=(0.0, 0.0, 0.0, 0.05, 0.0))
    assert (chargeable(Scenario.named("paper")), chargeable(noisy)) == (1.0, 0.0)
    for word in ("scp", "feedback", "deterministic"):
        controller, world = read_controller(word, noisy)
        assert controller.plan.status is Status.CONVERGED
        assert world == noisy


def test_importing_is_light():
    code = (
        "import sys, slipcar.evaluation, slipcar.evaluation.cli;"
        "heavy = {'torch', 'matplotlib', 'pandas', 'stable_baselines3', 'pygame', 'cvxpy', 'osqp'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_python_m_runs_the_command_line():
    done = subprocess.run(
        [sys.executable, "-m", "slipcar.evaluation", "plan", "--scenario", "moon"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "unknown scenario 'moon'" in done.stderr

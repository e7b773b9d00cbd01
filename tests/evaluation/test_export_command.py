"""`slipcar export` as a user calls it."""

import json
import shutil
import subprocess

import pytest

from slipcar.envs import Scenario
from slipcar.evaluation.cli import main
from slipcar.planner import plan
from slipcar.planner.law import Law


@pytest.fixture
def planned(tmp_path):
    return plan(Scenario.named("paper"), feedback=True).save(tmp_path / "My plan-1.npz")


def test_a_plan_becomes_c_that_tests_itself(planned, capsys):
    assert main(["export", str(planned), "--to", "c"]) == 0
    names = {path.name for path in planned.parent.iterdir()} - {planned.name}
    assert names == {"my_plan_1.h", "my_plan_1.c", "my_plan_1_test.c"}
    command = capsys.readouterr().out.splitlines()[-1].removeprefix("test it: ")
    if shutil.which("cc"):  # the very command that is printed
        subprocess.run(command, shell=True, check=True, cwd=planned.parent)


def test_a_plan_becomes_json(planned, tmp_path):
    out = tmp_path / "law.json"
    assert main(["export", str(planned), "--to", "json", "--out", str(out)]) == 0
    assert Law.from_dict(json.loads(out.read_text())).gains.shape == (40, 2, 5)


def test_the_shipped_policy_becomes_torchscript(tmp_path, capsys):
    pytest.importorskip("torch")
    out = tmp_path / "policy.pt"
    assert main(["export", "policy", "--to", "torchscript", "--out", str(out)]) == 0
    assert out.is_file()
    assert "largest difference from the original at 1000 states" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["PLAN", "--to", "onnx"], "a plan (.npz) is exported to c or json"),
        (["policy", "--to", "c"], "a plan (.npz) is exported to c or json"),
        (["PLAN", "--to", "json", "--float32"], "--float32 is of C"),
        (["PLAN", "--to", "c", "--scenario", "gap"], "--scenario is of policies"),
        (["policy", "--to", "onnx", "--law", "lqr"], "are of plans"),
        (["nowhere.npz", "--to", "c"], "no plan at nowhere.npz"),
        (["nowhere", "--to", "onnx"], "no weights at nowhere"),
    ],
)
def test_bad_arguments_are_one_line(planned, arguments, words, capsys):
    arguments = [str(planned) if a == "PLAN" else a for a in arguments]
    assert main(["export", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_a_plan_without_gains_says_what_to_do(tmp_path, capsys):
    path = plan(Scenario.named("paper")).save(tmp_path / "p.npz")
    assert main(["export", str(path), "--to", "c"]) == 2
    assert "slipcar plan --feedback" in capsys.readouterr().err
    assert main(["export", str(path), "--to", "c", "--law", "open-loop"]) == 0

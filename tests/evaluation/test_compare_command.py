"""`slipcar compare` on the command line: suites, own rows, and everything that is refused."""

import dataclasses

import pytest

from slipcar.evaluation.cli import main
from slipcar.evaluation.commands.compare import check_names, percentage

OWN = """
import numpy as np


def brake(t, x):
    return np.stack([-x[:, 3], -x[:, 4]], axis=-1)


def nan(t, x):
    return np.full((len(x), 2), np.nan)


class Wrong:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((3, 2)), None


class Raises:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        raise RuntimeError("no fuel")


class Slow:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        while True:
            pass


wrong, raises, slow = Wrong(), Raises(), Slow()
"""


@pytest.fixture
def own(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(OWN, encoding="utf-8")
    return path


@pytest.fixture
def few_rows(monkeypatch, replay, paper, turning):
    """The table without its usual rows, which take a while."""

    def rows(scenario, **rest):
        return {"stochastic SCP": replay(paper, turning)}, ["a note"]

    monkeypatch.setattr("slipcar.evaluation.rows.default_rows", rows)


def test_bad_controllers_are_failed_rows_and_the_others_are_kept(own, few_rows, tmp_path, capsys):
    names = ("brake", "nan", "wrong", "raises", "slow")
    controllers = [f"--controller={name}={own}:{name}" for name in names]
    folder = tmp_path / "results"
    options = ["--episodes", "50", "--no-figures", "--time-limit", "0.5", "--folder", str(folder)]
    assert main(["compare", *options, *controllers]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "a note" in said
    for name, message in (
        ("nan", "returned nan; controls must be finite"),
        ("wrong", "must return actions of shape (1024, 2), not (3, 2)"),
        ("raises", "RuntimeError: no fuel"),
        ("slow", "took longer than 0.5 s"),
    ):
        assert f"{name} did not finish" in said
        assert message in said
    table = (folder / "table.csv").read_text()
    assert "stochastic SCP,False,50" in table
    assert "brake,True,50" in table


def test_a_suite_takes_own_rows(own, tmp_path, capsys, monkeypatch):
    from slipcar.evaluation.makers import Maker
    from slipcar.evaluation.suites import slip

    rows = {slip.REFERENCE: Maker.of("straight")}
    monkeypatch.setattr(slip, "learned_rows", lambda *rest: {})
    whole = slip.suite
    monkeypatch.setattr(
        slip, "suite", lambda episodes: dataclasses.replace(whole(episodes, (0.0, 0.1)), rows=rows)
    )
    arguments = ["compare", "--suite", "slip", "--episodes", "20", "--folder", str(tmp_path)]
    assert main([*arguments, "--no-figures", "--controller", f"brake={own}:brake"]) == 0
    assert "brake" in (tmp_path / "table.csv").read_text()
    assert "brake" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--suite", "slip", "--scenario", "gap"], "--scenario: only the suite paper has it"),
        (["--suite", "random", "--substeps", "2"], "--substeps: only the suite paper"),
        (["--suite", "horizon", "--resolution", "1%"], "--resolution: only the suite paper"),
        (["--resolution", "60%"], "between 0 % and 50 %"),
        (["--resolution", "fine"], "not 'fine'"),
        (["--episodes", "0"], "episodes must be at least 1, not 0"),
        (["--time-limit", "0"], "--time-limit must be > 0 seconds"),
        (["--cluster", "slurm", "--suite", "slip"], "unknown cluster 'slurm'"),
        (["--controller", "nobody"], "unknown controller 'nobody'"),
        (["--controller", "no_such_module:thing"], "no_such_module"),
        (["--workers", "0"], "n_jobs must be at least 1"),
    ],
)
def test_what_is_refused_is_said_in_one_line(arguments, message, tmp_path, capsys):
    assert main(["compare", "--folder", str(tmp_path / "none"), *arguments]) == 2
    said = capsys.readouterr().err.strip()
    assert message in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "none").exists()


def test_an_unknown_suite_is_told_which_there_are(capsys):
    assert main(["compare", "--suite", "moon"]) == 2
    said = "".join(capsys.readouterr())
    assert all(name in said for name in ("moon", "paper", "random", "slip", "horizon"))


@pytest.mark.parametrize(("text", "share"), [("0.1%", 0.001), ("0.002", 0.002), (" 5 % ", 0.05)])
def test_a_percentage_is_a_share(text, share):
    assert percentage("--resolution", text) == pytest.approx(share)


def test_names_are_unique():
    check_names(["a"], ["b"], 1)
    with pytest.raises(ValueError, match="there is a row 'a' already"):
        check_names(["a"], ["a"], 1)
    with pytest.raises(ValueError, match="two have the same name"):
        check_names(["a"], ["b"], 2)

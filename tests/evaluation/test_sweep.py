"""Finished work: kept as it comes, found again, and never taken for something else."""

import resource
import signal
import time

import numpy as np
import pytest

from slipcar.evaluation import compare
from slipcar.evaluation.cells import Store, cell_name, controller_fingerprint
from slipcar.evaluation.metrics import FIELDS, Result
from slipcar.evaluation.noise import BLOCK
from slipcar.evaluation.provenance import code_digest
from slipcar.evaluation.runs import Runs
from slipcar.evaluation.statistics import half_width, standard_error
from slipcar.planner import OpenLoop, plan


class Named:
    """Drives as another does, and counts its calls; identified by its name."""

    observation, closed_loop = "state", False

    def __init__(self, inner, name):
        self.inner, self.name, self.calls = inner, name, 0

    def fingerprint(self):
        return self.name

    def predict(self, observation, **rest):
        self.calls += 1
        return self.inner.predict(observation, **rest)


class Hangs:
    def __init__(self, at=0):
        self.at = at

    def predict(self, observation, state=None, **rest):
        k = 0 if state is None else state
        while k == self.at:
            pass
        return np.zeros((len(observation), 2)), k + 1


@pytest.fixture
def row(paper, replay, turning):
    return Named(replay(paper, turning), "turning")


def same(a, b):
    return all(
        np.array_equal(getattr(a.metrics, name), getattr(b.metrics, name)) for name in FIELDS
    )


def run(rows, scenario, episodes=2500, **options):
    return compare(rows, scenario, episodes, **{"seed": 3, "progress": False, **options})


# ------------------------------------------------------------------ cells


def test_more_episodes_add_cells_to_those_that_are_there(row, paper, tmp_path):
    run({"a": row}, paper, 2 * BLOCK, folder=tmp_path)
    cells = set((tmp_path / "cells").iterdir())
    assert len(cells) == 2
    calls = row.calls
    more = run({"a": row}, paper, 3 * BLOCK, folder=tmp_path)
    assert cells < set((tmp_path / "cells").iterdir())
    assert row.calls == 1.5 * calls
    assert same(more.results["a"], run({"a": row}, paper, 3 * BLOCK).results["a"])


def test_what_changes_back_is_found_again(row, paper, tmp_path):
    run({"a": row}, paper, folder=tmp_path)
    run({"a": row}, paper, folder=tmp_path, seed=4)
    assert run({"a": row}, paper, folder=tmp_path).reused == ("a",)
    assert run({"another name": row}, paper, folder=tmp_path).reused == ("another name",)


@pytest.mark.parametrize("keep", [0, 100, 5000])
def test_a_truncated_cell_is_done_again(row, paper, tmp_path, keep):
    whole = run({"a": row}, paper, folder=tmp_path)
    path = sorted((tmp_path / "cells").iterdir())[0]
    path.write_bytes(path.read_bytes()[:keep])
    again = run({"a": row}, paper, folder=tmp_path)
    assert again.reused == ()
    assert same(again.results["a"], whole.results["a"])
    assert run({"a": row}, paper, folder=tmp_path).reused == ("a",)


def test_a_cell_is_not_taken_for_another(row, paper, tmp_path):
    run({"a": row}, paper, 100, folder=tmp_path)
    (path,) = (tmp_path / "cells").iterdir()
    key = {"something": "else"}
    path.rename(path.with_name(cell_name(key)))
    assert Store(tmp_path).get(key) is None


def test_a_killed_process_leaves_nothing_temporary_for_long(row, paper, tmp_path):
    run({"a": row}, paper, 100, folder=tmp_path)
    (cell,) = (tmp_path / "cells").iterdir()
    from slipcar.baselines import files

    dead = cell.with_name(f".{cell.name}.{files._host()}-4194305")  # beyond any process id
    other_host = cell.with_name(f".{cell.name}.elsewhere-1")
    for path in (dead, other_host):
        path.write_bytes(b"half")
    assert run({"a": row}, paper, 100, folder=tmp_path).reused == ("a",)
    assert not dead.exists()
    assert other_host.exists()


def test_cells_of_others_are_told_of(row, paper, tmp_path):
    run({"a": row}, paper, 100, folder=tmp_path)
    (warning,) = run({"a": row}, paper, 100, seed=9, folder=tmp_path).warnings
    assert warning.startswith("1 finished cells")
    assert "another version" in warning


def test_the_code_that_numbers_depend_on_is_in_the_key(paper):
    parts = {code_digest(part) for part in ("envs", "planner", "policy", "core")}
    assert len(parts) == 4
    assert code_digest("envs", "core") != code_digest("envs")


def test_a_full_disk_costs_the_reuse_and_not_the_results(row, paper, tmp_path):
    """A real one as far as the process can tell: files may not grow beyond 1 kB."""
    whole = run({"a": row}, paper, 100)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))
        found = run({"a": row, "b": row}, paper, 100, folder=tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    assert same(found.results["a"], whole.results["a"])
    assert not list((tmp_path / "cells").iterdir())
    (warning,) = found.warnings
    assert "cannot be kept" in warning
    assert "File too large" in warning


# ------------------------------------------------------------------ controllers that hang


@pytest.mark.parametrize("at", [0, 7])
def test_a_controller_that_hangs_is_a_failed_row(row, paper, at):
    began = time.monotonic()
    found = run({"hangs": Hangs(at), "a": row}, paper, 1000, time_limit=0.5)
    assert time.monotonic() - began < 20.0
    assert list(found.results) == ["a"]
    message = found.errors["hangs"]
    assert "1000 episodes took longer than 0.5 s" in message
    assert f"Hangs.predict at step {at}" in message


def test_a_bad_time_limit_is_named(row, paper):
    with pytest.raises(ValueError, match="time_limit"):
        run({"a": row}, paper, time_limit=0.0)


# ------------------------------------------------------------------ several trainings


@pytest.fixture
def trained(paper, replay, turning):
    drivers = [replay(paper, factor * turning) for factor in (0.9, 1.0, 1.1)]
    return Runs(tuple(drivers), ("seed 0", "seed 1", "seed 2"))


def test_a_method_is_the_mean_of_its_trainings(trained, row, paper):
    found = run({"SCP": row, "learned": trained}, paper, 1000)
    result = found.results["learned"]
    alone = [run({"a": one}, paper, 1000).results["a"] for one in trained.controllers]
    assert all(same(a, b) for a, b in zip(result.runs, alone, strict=True))
    means = np.array([one.total for one in alone])
    assert result.total == pytest.approx(means.mean(), rel=1e-12)
    assert result.spread("total") == pytest.approx(means.std(ddof=1), rel=1e-12)
    assert result.episodes == 1000
    paths = standard_error(np.mean([one.metrics.total for one in alone], axis=0))
    assert result.total_se == pytest.approx(np.hypot(means.std(ddof=1) / np.sqrt(3), paths))
    line = found.frame.loc["learned"]
    assert (line["runs"], line["episodes"]) == (3, 1000)
    # Three trainings say less of a method than a thousand paths of a policy.
    low, high = result.collision_interval
    rates = [one.collision_rate for one in alone]
    assert low <= min(rates)
    assert high >= max(rates)


def test_differences_to_and_from_a_method_are_opposite(trained, row, paper):
    found = run({"SCP": row, "learned": trained}, paper, 1000)
    there = found.results["learned"].difference(found.results["SCP"], "total")
    back = found.results["SCP"].difference(found.results["learned"], "total")
    assert (there.mean, there.low, there.high) == pytest.approx((-back.mean, -back.high, -back.low))
    assert there.low < there.mean < there.high


def test_a_method_with_a_training_that_fails_fails(row, paper):
    runs = Runs((row, Hangs()), ("seed 0", "seed 1"))
    found = run({"a": row, "learned": runs}, paper, 100, time_limit=0.3)
    assert "took longer" in found.errors["learned"]
    assert list(found.results) == ["a"]


@pytest.mark.parametrize(
    ("labels", "message"),
    [(("a",), "a label for each, not 2 and 1"), (("a", "a"), "labels of runs must differ")],
)
def test_bad_runs_are_named(row, labels, message):
    with pytest.raises(ValueError, match=message):
        Runs((row, row), labels)


def test_one_training_is_a_row_like_any_other(row, paper):
    result = run({"a": row}, paper, 100).results["a"]
    assert Result.of_runs([result]) is result


# ------------------------------------------------------------------ a resolution


def test_a_resolution_gives_each_row_the_episodes_it_needs(paper, tmp_path):
    rows = {"SCP": OpenLoop(plan(paper))}
    rows["blind"] = OpenLoop(plan(paper.replace(obstacles=())).replace(problem=paper))
    found = compare(rows, paper, resolution=0.004, folder=tmp_path, progress=False)
    counts = found.frame["episodes"]
    assert counts["blind"] > counts["SCP"]  # 29 % against 6 %
    for result in found.results.values():
        assert half_width(result.collision_rate, result.episodes) <= 0.004
    assert found.warnings == ()
    # Differences are over the paths that both met.
    first = found.results["blind"].metrics.total[: counts["SCP"]]
    difference = first.mean() - found.results["SCP"].total
    assert found.frame.loc["blind", "total_difference"] == pytest.approx(difference)
    again = compare(rows, paper, resolution=0.004, folder=tmp_path, progress=False)
    assert again.reused == tuple(rows)


def test_an_interval_too_wide_for_the_claim_is_told(row, paper):
    (warning,) = run({"a": row}, paper, 500, resolution=0.001).warnings
    assert warning.startswith("a: its collision rate is known to ± ")
    assert "not to the ± 0.1 % asked for" in warning
    with pytest.raises(ValueError, match="resolution must be between 0 and"):
        run({"a": row}, paper, resolution=0.7)


def test_a_fingerprint_may_be_unknown(row):
    row.fingerprint = lambda: None
    assert controller_fingerprint(row) is None

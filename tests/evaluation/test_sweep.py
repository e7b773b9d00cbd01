"""Finished work: kept as it comes, found again, and never taken for something else."""

import importlib.util
import resource
import signal
import sys
import time

import numpy as np
import pytest

from slipcar.evaluation import compare
from slipcar.evaluation.cells import Store, cell_name, controller_fingerprint
from slipcar.evaluation.metrics import FIELDS, Result
from slipcar.evaluation.noise import BLOCK
from slipcar.evaluation.own import as_controller
from slipcar.evaluation.provenance import code_digest
from slipcar.evaluation.runs import Runs
from slipcar.evaluation.statistics import half_width, standard_error
from slipcar.planner import Feedback, OpenLoop, plan


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


def test_more_episodes_are_not_asked_of_what_needs_more_trainings(trained, paper):
    (warning,) = run({"a": trained}, paper, 20_000, resolution=0.006).warnings
    assert "it takes more trainings, not more episodes" in warning


def test_rows_that_never_differ_differ_rarely(row, paper):
    found = run({"SCP": row, "twin": row}, paper, 1000).frame.loc["twin"]
    assert found["collision_difference"] == 0.0
    # No discordant path in 1000: rarer than 0.4 %, not never.
    assert found["collision_difference_high"] == pytest.approx(0.0038, abs=2e-4)
    assert found["collision_difference_low"] == -found["collision_difference_high"]


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
    assert "episodes would do" in warning
    assert warning.startswith("a: its collision rate is known to ± ")
    assert "not to the ± 0.1 % asked for" in warning
    with pytest.raises(ValueError, match="resolution must be between 0 and"):
        run({"a": row}, paper, resolution=0.7)


# ------------------------------------------------------------------ what identifies a controller


def written(folder, name, text):
    path = folder / f"{name}.py"
    path.write_text(text, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


DRIVER = """
import numpy as np

GAIN = {gain}


def wanted(rows):
    return GAIN * np.ones((rows, 2))


class Driver:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return wanted(len(observation)), state
"""


def test_edited_code_is_another_controller(tmp_path):
    prints = set()
    for gain in (0.1, 0.2, 0.1):
        module = written(tmp_path, "slipcar_test_driver", DRIVER.format(gain=gain))
        prints.add(controller_fingerprint(module.Driver()))
    del sys.modules["slipcar_test_driver"]
    assert len(prints) == 2
    assert None not in prints


def test_a_subclass_does_not_pass_for_what_it_inherits_from(paper):
    class Half(OpenLoop):
        def predict(self, observation, **rest):
            action, state = super().predict(observation, **rest)
            return 0.5 * action, state

    p = plan(paper)
    assert controller_fingerprint(Half(p)) != controller_fingerprint(OpenLoop(p))


def test_a_plan_for_other_bounds_is_another_controller(paper):
    p = plan(paper)
    wide = p.replace(problem=paper.replace(control_bounds=(3.0, 6.0)))
    assert OpenLoop(p).fingerprint() != OpenLoop(wide).fingerprint()
    assert Feedback(p).fingerprint() != Feedback(wide).fingerprint()


def test_how_a_function_is_called_identifies_it(paper):
    def still(observation):
        return np.zeros((len(observation), 2))

    one = as_controller(still, paper).fingerprint()
    still.observation = "state"
    assert as_controller(still, paper).fingerprint() != one


def test_what_cannot_be_told_is_never_reused(paper, layers, tmp_path):
    controller = layers()
    assert controller_fingerprint(controller) == controller_fingerprint(layers())
    controller.rng = np.random.default_rng(0)  # what it may do with that cannot be told
    assert controller_fingerprint(controller) is None
    run({"a": controller}, paper, 100, folder=tmp_path)
    assert run({"a": controller}, paper, 100, folder=tmp_path).reused == ()


def test_driving_does_not_change_a_fingerprint(trained, paper):
    before = controller_fingerprint(trained)
    run({"a": trained}, paper, 100)
    assert controller_fingerprint(trained) == before


# ------------------------------------------------------------------ one row and the others


def test_a_controller_that_exits_is_a_failed_row(row, paper):
    class Exits:
        def predict(self, observation, **rest):
            raise SystemExit(0)

    def exits(scenario):
        raise SystemExit("bye")

    found = run({"Exits": Exits(), "exits": exits, "a": row}, paper, 100)
    assert "SystemExit" in found.errors["Exits"]
    assert "SystemExit: bye" in found.errors["exits"]
    assert list(found.results) == ["a"]


def test_errors_are_one_line_and_the_first_in_order(paper, row):
    class Multi:
        def predict(self, observation, **rest):
            raise ValueError("one\n\n# two\n| three |")

    alone = run({"a": Multi()}, paper, 3000)
    spread = run({"a": Multi()}, paper, 3000, n_jobs=2)
    assert alone.errors == spread.errors
    assert alone.errors["a"].startswith("ValueError: one # two | three |; raised by Multi.predict")
    assert "episodes 0 to 1023" in alone.errors["a"]
    with pytest.raises(ValueError, match="in one line"):
        run({"a\nb": row}, paper)


def test_a_folder_that_is_a_file_is_refused_before_anything_is_driven(row, paper, tmp_path):
    (tmp_path / "results").write_text("")
    with pytest.raises(OSError, match="is a file, and results need a folder"):
        run({"a": row}, paper, folder=tmp_path / "results")
    assert row.calls == 0

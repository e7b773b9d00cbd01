"""Suites end to end in small: the rows, the worlds, the tables, and what an interruption costs."""

import dataclasses

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.evaluation.makers import Maker
from slipcar.evaluation.statistics import wilson_interval
from slipcar.evaluation.suites import horizon as suite_horizon
from slipcar.evaluation.suites import random as suite_random
from slipcar.evaluation.suites import slip as suite_slip
from slipcar.evaluation.suites.suite import Suite, SuiteResult, Variant, run_suite, save_suite
from slipcar.planner import OpenLoop, plan


def small(suite, rows):
    """The suite with some of its rows."""
    chosen = {name: suite.rows[name] for name in rows}
    return dataclasses.replace(suite, rows=chosen)


@pytest.fixture(scope="module")
def slip():
    rows = ("stochastic SCP", "stochastic SCP + feedback", "PPO")
    return small(suite_slip.suite(600, (0.0, 0.1, 1.0)), rows)


@pytest.fixture(scope="module")
def slipped(slip):
    return run_suite(slip, progress=False)


def test_a_cell_is_what_evaluate_says(slipped):
    world = Scenario.named("paper").replace(slip=(1.0, 0.1))
    expected = evaluate(OpenLoop(plan(world)), world, 600)
    found = slipped.results["stochastic SCP", "α² = 1"]
    np.testing.assert_array_equal(found.metrics.total, expected.metrics.total)
    assert not found.closed_loop
    assert found.preparation_time > 0.0


def test_an_interrupted_suite_continues(slip, slipped, tmp_path):
    kept = run_suite(slip, folder=tmp_path, progress=False)
    assert kept.computed == len(list((tmp_path / "cells").iterdir())) > 0
    for path in list((tmp_path / "cells").iterdir())[:2]:
        path.unlink()
    again = run_suite(slip, folder=tmp_path, progress=False)
    assert again.computed == 2
    drop = ["inference_time", "preparation_time"]
    assert again.frame.drop(columns=drop).equals(slipped.frame.drop(columns=drop))
    more = dataclasses.replace(slip, rows={**slip.rows, "deterministic": Maker.of("deterministic")})
    assert run_suite(more, folder=tmp_path, progress=False).computed == 3  # the new row alone


def test_workers_make_the_same_bytes(slip, slipped, tmp_path):
    spread = run_suite(slip, n_jobs=2, progress=False)
    for name, result in (("one", slipped), ("two", spread)):
        save_suite(result, suite_slip.document(result), tmp_path / name, figures=False)
    for file in ("table.csv", "cells.csv"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_methods_cross_where_the_sign_of_their_difference_changes(slipped):
    crossed = suite_slip.crossings(slipped)
    pair = crossed[crossed["below"] == "stochastic SCP + feedback"]
    (line,) = [line for _, line in pair.iterrows() if line["above"] == "stochastic SCP"]
    assert (line["crossing_low"], line["crossing_high"]) == (0.1, 1.0)
    assert 0.1 < line["crossing"] < 1.0
    document = suite_slip.document(slipped)
    assert "PPO" in document.markdown()
    assert [table.headers[-1] for table in document.tables][:2] == ["1", "1"]


def test_figures_are_drawn(slipped, tmp_path):
    pytest.importorskip("matplotlib")
    written = save_suite(slipped, suite_slip.document(slipped), tmp_path)
    assert {"slip.png", "slip.pdf", "slip.svg"} <= {path.name for path in written}


def test_worlds_are_the_unit_of_the_random_suite():
    rows = ("stochastic SCP", "stochastic SCP + feedback")
    suite = small(suite_random.suite(64, worlds=4), rows)
    assert len({variant.scenario.goal.tobytes() for variant in suite.variants}) == 4
    result = run_suite(suite, progress=False)
    table = suite_random.over_worlds(result)
    totals = [result.results[rows[0], variant.label].total for variant in suite.variants]
    line = table.loc[rows[0]]
    assert line["total"] == pytest.approx(np.mean(totals))
    assert line["total_se"] == pytest.approx(np.std(totals, ddof=1) / 2.0)
    assert line["worlds"] == 4
    reference = [result.results[rows[1], variant.label].total for variant in suite.variants]
    assert line["total_difference"] == pytest.approx(np.mean(np.subtract(totals, reference)))
    assert np.isnan(table.loc[rows[1], "total_difference"])
    document = suite_random.document(result)
    assert "4 held-out worlds" in document.markdown()
    with pytest.raises(ValueError, match="count must be between 1 and 100, not 101"):
        suite_random.suite(10, worlds=101)


def fails(scenario):
    raise RuntimeError("no plan")


@dataclasses.dataclass(frozen=True)
class OnlyIn:
    """Drives straight in one world, and gives up in others."""

    goal: bytes

    def __call__(self, scenario):
        if scenario.goal.tobytes() != self.goal:
            raise RuntimeError("hard")
        return Maker.of("straight")(scenario)


def of_random(rows, worlds, episodes=16):
    suite = suite_random.suite(episodes, worlds)
    return run_suite(dataclasses.replace(suite, rows=rows), progress=False)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("others", [{}, {"straight": Maker.of("straight")}, {"bad": fails}])
@pytest.mark.parametrize("reference", [fails, Maker.of("straight")])
def test_nothing_to_compare_with_is_no_difference(others, reference):
    result = of_random({**others, suite_random.REFERENCE: reference}, worlds=2)
    frame = suite_random.over_worlds(result)
    differences = suite_random.document(result).tables[2]
    compared = "straight" in others and reference is not fails
    assert np.isfinite(frame["total_difference"]).sum() == np.isfinite(frame["cheaper"]).sum()
    assert np.isfinite(frame["total_difference"]).sum() == compared
    assert any("[" in cell for row in differences.cells for cell in row[2:]) == compared


def test_who_gives_up_hard_worlds_is_not_the_best():
    suite = suite_random.suite(16, 3)
    easy, reference = suite.variants[1].scenario, suite_random.REFERENCE
    rows = {
        "easy": OnlyIn(easy.goal.tobytes()),
        "plans": Maker.of("planned-feedback"),
        reference: Maker.of("straight"),
    }
    result = of_random(rows, worlds=3)
    table = suite_random.document(result).tables[0]
    worlds, cost = table.headers.index("worlds"), table.headers.index("total cost")
    assert [row[worlds] for row in table.cells] == ["1", "3", "3"]
    assert "±" not in table.cells[0][cost]  # one world has no error, but a mean
    assert float(table.cells[0][cost]) > 0.0
    totals = result.frame.pivot(index="variant", columns="controller", values="total")
    assert (totals["plans"] < totals[reference]).all()
    assert table.bold == {(1, cost)}


def test_rows_that_no_interval_separates_have_no_winner():
    straight = Maker.of("straight")
    table = suite_random.document(of_random({"a": straight, "b": straight}, worlds=3)).tables[0]
    assert table.bold == frozenset()


def test_no_collision_in_any_world_is_not_certainty():
    frame = suite_random.over_worlds(of_random({"straight": Maker.of("straight")}, worlds=2))
    line = frame.loc["straight"]
    assert (line["collision_rate"], line["collision_low"]) == (0.0, 0.0)
    assert line["collision_high"] == pytest.approx(wilson_interval(0.0, 32)[1])


def test_the_fine_simulation_is_equally_fine_for_all():
    suite = suite_horizon.suite(100, (11, 41))
    fine = [variant for variant in suite.variants if variant.substeps > 1]
    assert {variant.substeps * (variant.scenario.nodes - 1) for variant in fine} == {640}
    result = run_suite(small(suite, ("stochastic SCP", "stochastic SCP, RK4 mean")), progress=False)
    frame = suite_horizon.grids(result)
    # A mean planned with RK4 is nearer to the fine simulation's than Euler's, with few nodes.
    miss = frame["position_rms_11_fine"]
    assert miss["stochastic SCP, RK4 mean"] < miss["stochastic SCP"]
    assert "N = 41" in suite_horizon.document(result).markdown()
    with pytest.raises(ValueError, match="12 - 1 must be a divisor of 640"):
        suite_horizon.suite(10, (12,))


def test_a_row_that_fails_somewhere_is_told_and_the_others_go_on(paper):
    suite = Suite(
        "slip",
        {"good": Maker.of("straight"), "bad": Maker.of("straight", speed="high")},
        [Variant("a", 0.0, paper), Variant("b", 1.0, paper)],
        10,
        "good",
    )
    result = run_suite(suite, progress=False)
    assert isinstance(result, SuiteResult)
    assert len(result.results) == 2
    (line,) = result.failed
    assert line.startswith("bad did not finish in a and 1 more: TypeError")
    with pytest.raises(ValueError, match="unknown kind of row 'magic'"):
        Maker.of("magic")

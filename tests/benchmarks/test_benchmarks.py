"""Every contender of `make bench` reaches the cost it is said to; nothing is timed here."""

import contextlib
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import plan
from slipcar.planner.convex.solvers.registry import make_solver

pytest.importorskip("casadi", reason='casadi is not installed: pip install "slipcar[bench]"')
pytest.importorskip("rich")

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def bench():
    """Imports a module of benchmarks/, which is a folder of scripts and no package."""
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module
    sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def makers(bench):
    """Contenders by name on the paper's case; peers in processes that end with the module."""
    with contextlib.ExitStack() as stack:
        planners, peers = bench("planners"), bench("peers")
        yield planners.makers(Scenario.named("paper"), peers.default_python(), stack)


def _plan(bench, makers, name):
    contenders = bench("contenders")
    try:
        contender = makers[name]()
        answer = contender.solve()[1]
    except (ImportError, contenders.UnavailableError) as missing:
        pytest.skip(f"{name}: {missing}")
    return contender, answer, contenders.judge(Scenario.named("paper"), answer.controls)


@pytest.mark.parametrize(
    "name",
    [
        "slipcar",
        "slipcar, fine",
        "slipcar, new scenario",
        "slipcar, own class",
        "slipcar, NumPy",
        "slipcar, NumPy, fine",
        "slipcar, convex scheme",
        "slipcar, OSQP in place",
        "slipcar, cvxpy + Clarabel",
        "slipcar, cvxpy + Clarabel, built once",
        "slipcar, plan_batch, 1 thread",
        "slipcar, plan_batch, 1 thread, fine",
        "slipcar, plan_batch, 2 threads",
        "CasADi + fatrop",
        "CasADi + IPOPT",
        "CasADi + IPOPT, not expanded",
        pytest.param("CasADi + fatrop, compiled", marks=pytest.mark.long),
        pytest.param("OpenSCvx", marks=pytest.mark.long),
    ],
)
def test_contender_solves_the_problem(bench, makers, name):
    contender, answer, judged = _plan(bench, makers, name)
    controls, optimum = bench("planners").reference()
    assert contender.solves == bench("contenders").EXACT
    assert answer.found
    assert judged.miss < 1e-4
    assert judged.cost == pytest.approx(optimum, rel=1e-5)
    np.testing.assert_allclose(answer.controls, controls, atol=5e-3)


def test_paper_recipe_ends_at_an_optimum_of_the_problem_with_a_box(bench, makers):
    # Its dynamics are exact where it stops moving, so it must agree with the whole problem whose
    # goal is the same box.
    recipe = bench("paper_recipe")
    _, answer, judged = _plan(bench, makers, "the paper's recipe, IPOPT")
    whole = bench("casadi_nlp").WholeNlp(
        Scenario.named("paper"), terminal_box=recipe.TERMINAL_BOX, tolerance=1e-8
    )
    best = whole.answer(whole.solve())
    optimum = bench("contenders").judge(Scenario.named("paper"), best.controls)
    assert answer.found
    assert best.found
    assert judged.miss < 1.01 * recipe.TERMINAL_BOX
    assert judged.cost == pytest.approx(optimum.cost, rel=1e-5)
    assert judged.cost < bench("planners").reference()[1] - 5e-3  # a box is cheaper to reach


def test_crocoddyl_reaches_the_cost_but_for_its_penalty(bench, makers):
    _, answer, judged = _plan(bench, makers, "crocoddyl FDDP")
    assert answer.found
    assert judged.miss < 1e-5
    assert judged.cost == pytest.approx(bench("planners").reference()[1], rel=1e-5)


def test_variance_weight_trades_cost_for_variance(bench, makers):
    _, compiled, judged = _plan(bench, makers, "slipcar, w = 1")
    _, plain, _ = _plan(bench, makers, "slipcar, NumPy, w = 1")
    _, convex, _ = _plan(bench, makers, "slipcar, convex scheme, w = 1")
    assert judged.cost > bench("planners").reference()[1]  # nothing is cheaper than the optimum
    np.testing.assert_allclose(compiled.controls, plain.controls, atol=1e-6)
    np.testing.assert_allclose(compiled.controls, convex.controls, atol=1e-2)


def test_random_worlds_are_new_each_time_and_in_no_table_of_the_papers_case(
    bench, makers, monkeypatch
):
    planners, many, turns = bench("planners"), bench("many"), bench("turns")
    seeds, random = [], Scenario.random
    monkeypatch.setattr(
        Scenario,
        "random",
        lambda seed, *given, **options: seeds.append(seed) or random(seed, *given, **options),
    )
    one = makers["slipcar, random worlds"]()
    batch = many.new_worlds(count=3)
    seeds.clear()
    answers = [contender.solve()[1] for contender in (one, one, batch, batch)]
    assert len(set(seeds)) == len(seeds) == 8
    assert all(answer.found for answer in answers)
    assert bench("contenders").EXACT not in (one.solves, batch.solves)
    timings = [turns.Timing(c, answers[0], np.array([0.1, 0.3])) for c in (one, batch)]
    assert (
        planners.rows(timings) == planners.ratios(timings) == planners.disagreements(timings) == []
    )
    told = {row["planner"]: row for row in planners.unmet_rows(timings)}
    assert told[one.name]["95 %"] == pytest.approx(290.0)
    assert told[batch.name]["ms (median)"] == pytest.approx(200.0 / 3.0)


def test_a_users_own_class_is_the_scenario(bench):
    scenario = Scenario.named("paper")
    own, rng = bench("own_problems").OwnCar(scenario), np.random.default_rng(0)
    t, x, u = np.zeros(6), rng.normal(size=(6, 5)), rng.normal(size=(6, 2))
    np.testing.assert_allclose(own.drift(t, x, u), scenario.drift(t, x, u), atol=1e-15)
    np.testing.assert_allclose(own.penalty(t, x), scenario.penalty(t, x), atol=1e-14)
    np.testing.assert_array_equal(own.terminal(x), scenario.terminal(x))
    covariance = [s @ s.swapaxes(-1, -2) for s in (own.diffusion(t, x), scenario.diffusion(t, x))]
    np.testing.assert_allclose(*covariance, atol=1e-15)
    assert not hasattr(own, "parameters")


@pytest.mark.parametrize("count", [1, 3])
def test_pendulums_are_planned_for(bench, count):
    p = plan(bench("own_problems").Pendulums(count))
    assert p.status.ok
    assert p.mean.shape == (41, 2 * count)


def test_start_states_are_the_own_one_and_others_within_reach(bench):
    scenario, many = Scenario.named("paper"), bench("many")
    states = many.start_states(scenario)
    offsets = states - scenario.start
    assert states.shape == (1000, 5)
    np.testing.assert_array_equal(states[0], scenario.start)
    assert (np.abs(offsets) <= [0.1, 0.1, 0.2, 0.0, 0.0]).all()
    # Uniform on ±a: standard deviation a/√3, within 10 % over 1000.
    np.testing.assert_allclose(
        np.std(offsets[:, :3], axis=0) * np.sqrt(3), [0.1, 0.1, 0.2], rtol=0.1
    )
    np.testing.assert_array_equal(states, many.start_states(scenario))


def test_a_plan_of_a_batch_takes_its_share_of_the_call(bench):
    contenders, turns = bench("contenders"), bench("turns")
    answer = contenders.Answer(np.zeros((40, 2)), 1, True)
    one = contenders.Contender("one", "", lambda: (0.5, answer))
    many = contenders.Contender("many", "", lambda: (0.5, answer), plans=1000, threads=2)
    for contender, ms in ((one, 500.0), (many, 0.5)):
        timing = turns.Timing(contender, answer, np.array([0.5, 0.5]))
        assert timing.ms == pytest.approx((ms, ms, ms))
        assert timing.columns()["fastest"] == pytest.approx(ms)
    (row,) = bench("many").rows([turns.Timing(c, answer, np.array([0.5])) for c in (one, many)])
    assert row["ms per plan and core"] == pytest.approx(1.0)


def test_ratio_is_over_the_rounds_that_both_took_part_in(bench):
    contenders, turns = bench("contenders"), bench("turns")
    answer = contenders.Answer(np.zeros((40, 2)), 1, True)
    one = contenders.Contender("one", "", lambda: (0.5, answer))
    many = contenders.Contender("many", "", lambda: (0.5, answer), plans=10)
    theirs = turns.Timing(one, answer, np.array([1.0, 1.0, 1.0, 7.0, 7.0, 7.0, 7.0]))
    ours = turns.Timing(many, answer, np.array([2.0, 2.0, 2.0]))
    assert bench("planners").ratio(theirs, ours) == pytest.approx(5.0)


class Recorder:
    """A solver that keeps what it is asked."""

    def __init__(self):
        self.solver, self.subproblems = make_solver("structured"), []

    def solve(self, sub):
        self.subproblems.append(sub)
        return self.solver.solve(sub)


def test_parametrised_programme_solves_whatever_sub_problem_comes(bench):
    # Bounds and penalties come and go within a plan, and the same solver serves the next one.
    pytest.importorskip("clarabel")
    recorder = Recorder()
    for bounds, free_first in ((None, True), ((0.9, 1.2), False)):
        scenario = Scenario.named("paper").replace(control_bounds=bounds)
        plan(scenario, variance_weight=0.0, solver=recorder, free_first=free_first)
    subs = recorder.subproblems
    assert {sub.bounded for sub in subs} == {True, False}
    assert {bool(sub.h.any()) for sub in subs} == {True, False}
    solver, exact = bench("cvxpy_dpp").DppSolver(), make_solver("structured")
    for i in np.random.default_rng(0).permutation(len(subs)):
        found, expected = solver.solve(subs[i]), exact.solve(subs[i])
        assert found.found
        assert found.objective == pytest.approx(expected.objective, rel=1e-5, abs=1e-5)


def test_parametrised_programme_refuses_what_it_cannot_pose(bench):
    recorder = Recorder()
    plan(Scenario.named("paper"), variance_weight=1.0, method="convex", solver=recorder)
    with pytest.raises(ValueError, match="variance_weight"):
        bench("cvxpy_dpp").DppSolver().solve(recorder.subproblems[0])


def test_judge_gives_the_reference_its_cost(bench):
    controls, optimum = bench("planners").reference()
    judged = bench("contenders").judge(Scenario.named("paper"), controls)
    assert judged.cost == pytest.approx(optimum, rel=1e-9)
    assert judged.miss < 1e-9
    assert bench("contenders").judge(Scenario.named("paper"), 0.0 * controls).miss > 1.0


def test_exponent_of_a_power_law(bench):
    nodes = np.array([41, 81, 161, 321, 641])
    slope, intercept = bench("growth").exponent(nodes, 0.3 * nodes**1.25)
    assert slope == pytest.approx(1.25)
    assert np.exp(intercept) == pytest.approx(0.3)


@pytest.mark.parametrize("N", [41, 81])
def test_growth_contenders_agree_at_every_size(bench, N):
    growth, contenders = bench("growth"), bench("contenders")
    scenario = Scenario.named("paper").replace(nodes=N)
    found, _ = contenders.available(growth.makers(scenario))
    costs = [contenders.judge(scenario, c.solve()[1].controls).cost for c in found]
    assert len(costs) >= 3
    np.testing.assert_allclose(costs, costs[-1], rtol=1e-6)


def test_what_is_not_installed_is_skipped_with_its_reason(bench):
    contenders, told = bench("contenders"), []

    def missing():
        raise ImportError("No module named 'fast_solver'\nand more")

    found, skipped = contenders.available({"fast": missing}, told.append)
    assert found == []
    assert skipped == {"fast": "No module named 'fast_solver'"}
    assert told == ["skipped fast: No module named 'fast_solver'"]


def test_worker_that_dies_is_unavailable(bench, tmp_path):
    peers, contenders = bench("peers"), bench("contenders")
    script = tmp_path / "dies.py"
    script.write_text("raise SystemExit('no such device')")
    worker = peers.Worker(sys.executable, script)
    with contextlib.closing(worker), pytest.raises(contenders.UnavailableError, match="no such"):
        worker.ask({})

"""The paper's case, planned and driven: numbers that were measured elsewhere than here."""

import numpy as np
import pytest

from slipcar.evaluation import compare, evaluate, sample_paths
from slipcar.evaluation.rollout import solver_failures
from slipcar.evaluation.rows import (
    CHANCE,
    DETERMINISTIC,
    FEEDBACK,
    FEEDBACK_RISK,
    OPEN_RISK,
    PATH_CHANCE,
    PPO,
    RECEDING,
    RECEDING_MARGINS,
    REFERENCE,
    STEERED,
    STEERED_CHANCE,
    STEERED_PATH_CHANCE,
    STOCHASTIC,
    STRAIGHT,
    default_rows,
)
from slipcar.planner import Feedback, OpenLoop, plan


@pytest.fixture(scope="module")
def paper():
    from slipcar.envs import Scenario

    return Scenario.named("paper")


@pytest.fixture(scope="module")
def deterministic(paper):
    return plan(paper, variance_weight=0.0)


def test_without_slip_a_path_costs_what_the_plan_says(paper, deterministic):
    dry = paper.replace(slip=(0.0, 0.0))
    r = evaluate(OpenLoop(deterministic), dry, 10)
    # Actions travel as float32; the goal is reached to that precision.
    assert r.effort == pytest.approx(deterministic.effort, rel=1e-6)
    assert r.obstacle == pytest.approx(deterministic.obstacle_cost, rel=1e-3)
    assert r.total == pytest.approx(deterministic.cost, abs=1e-4)
    assert r.goal < 1e-6
    assert r.collision_rate == 0.0


def test_deterministic_scp_in_open_loop(paper, deterministic):
    r = evaluate(OpenLoop(deterministic), paper, 100_000, seed=0)
    assert r.effort == pytest.approx(4.398, abs=0.002)
    assert 0.057 <= r.collision_rate <= 0.062
    assert r.collision_interval[0] <= 0.0596 <= r.collision_interval[1]
    assert r.position_rms == pytest.approx(0.152, abs=0.001)
    assert r.total == pytest.approx(6.92, abs=0.03)
    assert r.obstacle == pytest.approx(0.205, abs=0.004)


def test_tracking_the_plan(paper, deterministic):
    r = evaluate(Feedback(deterministic), paper, 30_000, seed=1)
    assert r.total == pytest.approx(5.06, abs=0.02)
    assert r.collision_rate == pytest.approx(0.010, abs=0.0025)
    assert r.position_rms == pytest.approx(0.060, abs=0.001)
    assert r.closed_loop


def test_predicted_covariance_is_that_of_the_paths(paper):
    found = plan(paper)
    states, _ = sample_paths(OpenLoop(found), paper, 30_000, seed=2)
    variance = states.var(axis=0)
    integral = (variance[1:].sum(axis=-1) * paper.dt).sum()
    assert found.variance == pytest.approx(integral, rel=0.03)
    np.testing.assert_allclose(variance[-1, :2], np.diagonal(found.covariance[-1])[:2], rtol=0.04)


def test_rows_of_the_real_controllers_do_not_depend_on_batches(paper, deterministic):
    for controller in (OpenLoop(deterministic), Feedback(deterministic)):
        whole = evaluate(controller, paper, 3000, seed=5).metrics.total
        parts = evaluate(controller, paper, 3000, seed=5, batch_size=1).metrics.total
        workers = evaluate(controller, paper, 3000, seed=5, n_jobs=2).metrics.total
        np.testing.assert_array_equal(whole, parts)
        np.testing.assert_array_equal(whole, workers)


def test_a_plan_that_did_not_converge_is_seen_in_the_table(paper):
    unfinished = plan(paper, max_iterations=1)
    assert not unfinished.status.ok
    assert solver_failures(OpenLoop(unfinished)) == 1
    c = compare({"good": OpenLoop(plan(paper)), "bad": OpenLoop(unfinished)}, paper, 100,
                progress=False)  # fmt: skip
    assert c.frame["failures"].tolist() == [0, 1]


def test_default_rows(paper, replay):
    rows, notes = default_rows(paper, policy=replay(paper, (0.0, 0.0)))
    assert notes == []
    assert list(rows) == [
        *(STRAIGHT, DETERMINISTIC, STOCHASTIC, FEEDBACK, PPO),
        *(CHANCE, STEERED, STEERED_CHANCE, RECEDING, RECEDING_MARGINS),
    ]
    closed = {name for name, controller in rows.items() if getattr(controller, "closed_loop", True)}
    assert closed == {FEEDBACK, STEERED, STEERED_CHANCE, RECEDING, RECEDING_MARGINS}
    replanned = {name: rows.pop(name) for name in (RECEDING, RECEDING_MARGINS)}
    c = compare(rows, paper, 10_000, reference=REFERENCE, progress=False)
    assert not c.errors
    rate = c.frame["collision_rate"]
    assert rate[STRAIGHT] > rate[DETERMINISTIC] > rate[FEEDBACK] > rate[STEERED]
    # What was promised, as far as so many paths can tell.
    assert c.frame.loc[CHANCE, "collision_low"] <= OPEN_RISK < rate[STOCHASTIC]
    assert c.frame.loc[STEERED_CHANCE, "collision_low"] <= FEEDBACK_RISK < rate[STEERED]
    for name in (FEEDBACK, STEERED, STEERED_CHANCE):
        assert c.frame.loc[name, "total_difference_high"] < 0.0
    few = compare(rows | replanned, paper, 128, reference=STOCHASTIC, progress=False).frame
    assert few.loc[[*replanned], "failures"].eq(0).all()
    assert few.loc[[*replanned], "total_difference_high"].lt(0.0).all()
    safer, cheaper = few.loc[RECEDING_MARGINS], few.loc[RECEDING]
    assert safer["obstacle"] < cheaper["obstacle"]
    assert safer["effort"] > cheaper["effort"]


def test_default_rows_speak_of_plans_that_failed(paper, replay, monkeypatch):
    unfinished = plan(paper, max_iterations=1)
    monkeypatch.setattr("slipcar.evaluation.rows.plan", lambda scenario, **options: unfinished)
    rows, notes = default_rows(paper, policy=replay(paper, (0.0, 0.0)))
    for name in (STOCHASTIC, CHANCE, STEERED, STEERED_CHANCE):
        assert any(note.startswith(f"{name}: the plan is MAX_ITERATIONS") for note in notes)
        assert solver_failures(rows[name]) == 1
    assert len(notes) == 4


def test_finer_simulations_have_rows_promised_on_the_path(paper, replay, monkeypatch):
    def quick(scenario, **options):
        changed = {"risk": 0.05, "risk_episodes": 2048, "starts": 1} if "risk" in options else {}
        return plan(scenario, **{**options, **changed})

    monkeypatch.setattr("slipcar.evaluation.rows.plan", quick)
    policy = replay(paper, (0.0, 0.0))
    plain, fine = (default_rows(paper, policy=policy, substeps=n) for n in (1, 4))
    assert set(fine[0]) - set(plain[0]) == {PATH_CHANCE, STEERED_PATH_CHANCE}
    for name in (PATH_CHANCE, STEERED_PATH_CHANCE):
        risk = fine[0][name].plan.risk
        (note,) = (note for note in fine[1] if note.startswith(name + ":"))
        assert "on the path" in str(risk)
        assert str(risk) in note
        assert f"at nodes of the same paths {risk.verified_at_nodes:.3%}" in note

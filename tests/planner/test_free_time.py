"""Free final time on the car against IPOPT on the whole problem (data/make_free_time.py)."""

import json
from pathlib import Path

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status, plan
from slipcar.planner.extremal.certificate import certify

DATA = json.loads(
    (Path(__file__).parents[1] / "data" / "free_time.json").read_text(encoding="utf-8")
)
CASES = DATA["cases"]
OPTIONS = {"variance_weight": 0.0, "tolerance": 1e-10}


def scenario_of(case):
    return Scenario.from_json(json.dumps(case["scenario"]))


def agree(p, case):
    assert p.status is Status.CONVERGED
    assert p.times[-1] == pytest.approx(case["final_time"], rel=1e-5)
    assert p.effort + p.obstacle_cost == pytest.approx(case["cost"], rel=1e-7)
    np.testing.assert_allclose(p.controls, case["controls"], atol=1e-4)
    np.testing.assert_allclose(p.mean, case["states"], atol=1e-4)
    scale = np.max(np.abs(case["adjoint"]))
    # The paper's multipliers maximise, IPOPT's minimise.
    np.testing.assert_allclose(
        -p.multipliers.terminal, case["terminal_multiplier"], atol=1e-4 * scale
    )
    np.testing.assert_allclose(-p.multipliers.adjoint[1:], case["adjoint"], atol=1e-4 * scale)


@pytest.mark.parametrize("name", CASES)
def test_a_plan_at_the_best_horizon_meets_the_reference(name):
    # The envelope theorem: how the least cost changes with T, known from one plan at fixed T.
    case = CASES[name]
    s, T = scenario_of(case), case["final_time"]
    guess = (np.array(case["states"]), np.array(case["controls"]))
    p = plan(s.replace(horizon=T), guess=guess, cold_start="never", **OPTIONS)
    agree(p, case)
    found = certify(p, time_weight=case["time_weight"])
    assert abs(found.transversality) < 1e-4 * case["time_weight"]
    assert found.extremal


@pytest.mark.parametrize("name", CASES)
def test_free_final_time_meets_the_reference(name):
    case = CASES[name]
    c = case["time_weight"]
    p = plan(scenario_of(case), free_final_time=True, time_weight=c, **OPTIONS)
    agree(p, case)
    assert p.final_time == pytest.approx(case["final_time"], rel=1e-5)
    assert p.final_time == p.times[-1]
    assert abs(p.certificate.transversality) < 1e-4 * c
    assert p.certificate.extremal


@pytest.mark.parametrize("horizon", [2.5, 4.0, 8.0])
def test_the_first_horizon_does_not_matter(horizon):
    # On the paper's case IPOPT comes to the same T from wherever it starts.
    case = CASES["paper, time weight 4"]
    s = scenario_of(case).replace(horizon=horizon)
    agree(plan(s, free_final_time=True, time_weight=4.0, **OPTIONS), case)


def test_with_noise_the_horizon_is_a_minimum_over_fixed_ones():
    s, c, w = Scenario.named("paper"), 1.0, 5.0
    free = plan(s, free_final_time=True, time_weight=c, variance_weight=w, tolerance=1e-10)
    assert free.status is Status.CONVERGED

    def total(p):
        return p.cost + w * p.variance + c * p.times[-1]

    beside = []
    for stretch in (0.96, 1.0, 1.04):
        held = s.replace(horizon=stretch * free.final_time)
        p = plan(held, guess=free, cold_start="never", variance_weight=w, tolerance=1e-10)
        assert p.status is Status.CONVERGED
        beside.append(total(p))
    assert beside[1] == pytest.approx(total(free), rel=1e-7)
    assert beside[1] < min(beside[0], beside[2])


def test_time_costs_make_haste():
    times = [
        plan(Scenario.named("open"), free_final_time=True, time_weight=c).final_time
        for c in (0.5, 2.0, 8.0)
    ]
    assert times[0] > times[1] > times[2]


def test_reference_is_a_minimum_and_has_its_multipliers():
    for case in CASES.values():
        held = [neighbour["total"] for neighbour in case["neighbours_with_final_time_fixed"]]
        assert min(held) > case["total"]
        assert case["total"] == case["cost"] + case["time_weight"] * case["final_time"]
        assert np.shape(case["adjoint"]) == np.shape(case["states"][1:])

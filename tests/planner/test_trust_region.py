"""Schedules on their own and inside the iteration."""

import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.planner import Status, plan
from slipcar.planner.convex import trust_region
from slipcar.planner.convex.trust_region import (
    AdaptiveTrustRegion,
    PaperTrustRegion,
    Step,
    TrustRegion,
)


def step(predicted=1.0, actual=1.0, radius=0.1):
    return Step(radius=radius, predicted=predicted, actual=actual, before=10.0)


def test_paper_schedule_shrinks_by_one_percent():
    t = PaperTrustRegion()
    radii = []
    for _ in range(50):
        radii.append(t.radius)
        assert t.judge(step(actual=-5.0))  # every finite step is taken
    np.testing.assert_allclose(radii, 100.0 * 0.99 ** np.arange(50))


@pytest.mark.parametrize("radius", [1e-6, 1e-3, 0.1, 5.0])
def test_paper_schedule_finds_the_multiplier_of_its_radius(radius):
    # A step that shrinks as 1/(1 + m)²: any decreasing function will do.
    t = PaperTrustRegion(radius=radius)
    for _ in range(60):
        size = 10.0 / (1.0 + t.multiplier) ** 2
        if t.fits(size):
            break
    assert 0.98 * radius <= size <= radius


def test_paper_schedule_takes_a_step_that_fits_anyway():
    t = PaperTrustRegion()
    assert t.fits(3.0)
    assert t.multiplier == 0.0


@pytest.mark.parametrize("radius", [0.5, 0.02])
def test_steps_of_a_plan_keep_the_papers_radius(monkeypatch, radius, rollout):
    monkeypatch.setitem(
        trust_region.TRUST_REGIONS, "paper", lambda: PaperTrustRegion(radius=radius)
    )
    paper = Scenario.named("paper")
    u = np.full((40, 2), 0.1)
    guess = (rollout(paper, u), u)  # a path it can drive: staying there is a step of length zero
    p = plan(paper, guess=guess, trust_region="paper", max_iterations=8, cold_start="never")
    allowed = radius * 0.99 ** np.arange(len(p.history))
    taken = np.array([h.trust_radius for h in p.history])
    # Whatever a step leaves as defect, the next must take up: a little more than Δ at times.
    assert np.all(taken <= 1.1 * allowed)
    assert p.history[0].trust_multiplier > 0.0
    assert 0.98 * radius < taken[0] <= radius


def test_the_shortest_step_is_taken_where_none_fits(monkeypatch):
    # The straight line is no path of the car: its defects alone are longer than Δ.
    paper = Scenario.named("paper")
    free = plan(paper, trust_region="none", max_iterations=1).history[0].trust_radius
    monkeypatch.setitem(trust_region.TRUST_REGIONS, "paper", lambda: PaperTrustRegion(radius=1e-9))
    shortest = plan(paper, trust_region="paper", max_iterations=1).history[0]
    assert 1e-9 < shortest.trust_radius < free
    again = plan(paper, trust_region="paper", max_iterations=8)
    assert np.isfinite(again.mean).all()
    assert again.history[-1].defect < 0.2


def test_radius_counts_the_noise_of_the_error_process(monkeypatch):
    # Ten times the slip: more of E∫‖x − x_k‖² is noise, though the mean moves alike.
    monkeypatch.setitem(trust_region.TRUST_REGIONS, "paper", lambda: PaperTrustRegion(radius=1e9))
    paper = Scenario.named("paper")

    def first(factor, weight=0.0):
        scenario = paper.replace(slip=factor * paper.slip)
        options = {"trust_region": "paper", "variance_weight": weight, "max_iterations": 1}
        return plan(scenario, **options).history[0].trust_radius

    noise = first(1.0) - first(0.0)
    assert noise > 0.0
    assert first(10.0) - first(0.0) == pytest.approx(100.0 * noise, rel=1e-6)
    # The variance penalty's weight is none of the trust region's business.
    assert first(10.0, weight=1e-9) == pytest.approx(first(10.0), rel=1e-6)


def test_no_trust_region_takes_everything_that_is_finite():
    t = TrustRegion()
    assert t.fits(1e300)
    assert t.judge(step(actual=-1e300))
    assert not t.collapsed
    assert not t.judge(step(actual=-np.inf))
    assert t.collapsed


def test_adaptive_schedule_answers_the_ratio():
    t = AdaptiveTrustRegion(free=0)
    assert not t.judge(step(predicted=1.0, actual=-0.5, radius=0.1))
    first = t.multiplier
    assert first > 0.0
    assert not t.judge(step(predicted=0.5, actual=-0.1, radius=0.05))
    assert t.multiplier >= 4.0 * first
    high = t.multiplier
    assert t.judge(step(actual=0.9))
    assert t.multiplier == high / 4.0
    assert t.judge(step(actual=0.5))
    assert t.multiplier == high / 4.0
    assert t.judge(step(actual=0.1))
    assert t.multiplier == high / 2.0


def test_adaptive_schedule_lets_rounding_errors_pass():
    t = AdaptiveTrustRegion(free=0)
    assert t.judge(step(predicted=1e-9, actual=-1e-9))
    assert t.multiplier == 0.0
    assert not t.judge(step(predicted=1e-9, actual=-1e-3))


def test_adaptive_schedule_takes_its_free_steps_unless_they_lead_nowhere():
    t = AdaptiveTrustRegion(free=3)
    assert all(t.judge(step(actual=-10.0)) for _ in range(3))
    assert not t.judge(step(actual=-10.0))
    t = AdaptiveTrustRegion(free=3)
    assert not t.judge(step(actual=-np.inf))
    assert t.multiplier > 0.0


def test_adaptive_schedule_gives_up_at_last():
    t = AdaptiveTrustRegion(free=0, patience=5)
    for _ in range(5):
        assert not t.judge(step(actual=-1.0))
        assert not t.collapsed
    t.judge(step(actual=-1.0))
    assert t.collapsed


class Wall:
    """A drift that exists on one side only: some steps lead to where nothing is defined."""

    start, times, control_weight = np.array([0.5]), np.linspace(0.0, 1.0, 21), np.eye(1)

    def drift(self, t, x, u):
        return np.sqrt(x) * u

    def diffusion(self, t, x):
        return np.full((*x.shape[:-1], 1, 1), 0.05)

    def terminal(self, x):
        return x - 0.01


@pytest.mark.parametrize("schedule", ["adaptive", "paper", "none"])
def test_steps_to_where_the_model_is_not_finite_are_never_taken(schedule):
    guess = (np.linspace([0.5], [40.0], 21), np.full((20, 1), 1.0))
    with np.errstate(all="raise"):
        p = plan(Wall(), guess=guess, trust_region=schedule, variance_weight=0.0)
    assert np.isfinite(p.mean).all()
    refused = [h for h in p.history if not np.isfinite(h.actual)]
    assert not any(h.accepted for h in refused)
    if schedule != "adaptive" and refused:
        assert p.status is Status.STALLED

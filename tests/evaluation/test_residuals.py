import numpy as np
import pytest

from slipcar.envs import Scenario
from slipcar.evaluation.residuals import first_shot, residual_curves, residuals_of
from slipcar.planner import plan
from slipcar.planner.extremal.certificate import certify


@pytest.fixture(scope="module")
def convex():
    return plan(Scenario.named("paper"), method="convex", tolerance=1e-14)


def test_residuals_are_those_of_the_certificate(convex):
    residuals, seconds = residuals_of(convex)
    assert len(residuals) == sum(h.accepted for h in convex.history)
    assert np.all(np.diff(seconds) > 0.0)
    assert residuals[-1] == pytest.approx(certify(convex).violations.largest)


def test_the_first_shot_starts_at_an_iterate_and_lands(convex):
    k, shot, lost = first_shot(convex)
    assert lost >= 0.0
    assert shot.residuals[0] == pytest.approx(residuals_of(convex)[0][k], rel=1e-6)
    assert shot.residual <= 1e-12


def test_every_method_reaches_an_extremal_and_two_of_them_quadratically():
    curves = residual_curves(Scenario.named("paper"), repeats=1)
    assert list(curves) == ["convex", "shooting", "newton"]
    for curve in curves.values():
        assert curve.residuals.shape == curve.iterations.shape == curve.seconds.shape
        assert np.all(np.diff(curve.iterations) > 0)
        assert curve.residuals[-1] <= 1e-11
    # Linear: from 1e-4 on each iteration gains about the same. Quadratic: two steps are enough.
    steps = {
        name: int(np.sum(c.residuals[c.residuals < 1e-4] > 1e-11)) for name, c in curves.items()
    }
    assert steps["convex"] >= 8
    assert max(steps["shooting"], steps["newton"]) <= 4
    shot, convex = curves["shooting"], curves["convex"]
    joined = convex.iterations == shot.iterations[0]
    assert shot.residuals[0] == pytest.approx(convex.residuals[joined][0], rel=1e-6)
    assert shot.seconds[0] > convex.seconds[joined][0]


def test_a_plan_that_no_shot_improves_gets_none():
    paper = Scenario.named("paper")
    stuck = plan(paper.replace(control_bounds=(0.1, 0.1)), max_iterations=5)
    assert first_shot(stuck) is None


def test_repeats_must_be_positive(paper):
    with pytest.raises(ValueError, match="repeats"):
        residual_curves(paper, repeats=0)

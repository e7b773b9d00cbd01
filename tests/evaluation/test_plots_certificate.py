import numpy as np
import pytest

pytest.importorskip("matplotlib")

from slipcar.envs import Scenario
from slipcar.evaluation.plots_certificate import (
    first_shot,
    plot_hamiltonian,
    plot_residuals,
    residuals_of,
)
from slipcar.planner import plan
from slipcar.planner.certificate import certify


@pytest.fixture(scope="module")
def planned():
    return plan(Scenario.named("paper"), tolerance=1e-14)


def test_hamiltonian_curves_peak_at_the_plans_controls(planned):
    figure = plot_hamiltonian(planned, nodes=(0, 11, 39))
    for j, axes in enumerate(figure.axes[:2]):
        curves = [line for line in axes.lines if len(line.get_xdata()) > 100]
        dots = [line for line in axes.lines if line.get_markersize() == 4]
        assert len(curves) == len(dots) == 3
        for k, curve, dot in zip((0, 11, 39), curves, dots, strict=True):
            v, H = curve.get_data()
            step = v[1] - v[0]
            assert abs(v[np.argmax(H)] - planned.controls[k, j]) <= step
            assert np.all(H <= 1e-12)
            # d²H/dv² = −2R.
            np.testing.assert_allclose(np.diff(H, 2) / step**2, -2.0, rtol=1e-6)
            assert dot.get_xdata()[0] == pytest.approx(planned.controls[k, j])
            assert dot.get_ydata()[0] == pytest.approx(0.0, abs=1e-9)


def test_a_control_that_is_no_maximum_lies_below_it(planned):
    u = planned.controls.copy()
    u[11, 1] += 0.3
    axes = plot_hamiltonian(planned.replace(controls=u), nodes=[11]).axes[1]
    dot = next(line for line in axes.lines if line.get_markersize() == 4)
    assert dot.get_ydata()[0] == pytest.approx(-0.09, rel=1e-3)


def test_multipliers_panel_shows_every_iteration(planned):
    axes = plot_hamiltonian(planned).axes[2]
    history = certify(planned).terminal_history
    drawn = np.array([line.get_ydata() for line in axes.lines[:5]])
    np.testing.assert_array_equal(drawn, history.T)


@pytest.mark.parametrize("nodes", [[40], [-1], []])
def test_nodes_that_are_none_are_refused(planned, nodes):
    with pytest.raises(ValueError, match="nodes"):
        plot_hamiltonian(planned, nodes=nodes)


def test_residual_curves_are_those_of_the_certificate(planned):
    residuals, seconds = residuals_of(planned)
    assert len(residuals) == sum(h.accepted for h in planned.history)
    assert np.all(np.diff(seconds) > 0.0)
    c = certify(planned)
    assert residuals[-1] == pytest.approx(c.violations.largest)
    k, shot, lost = first_shot(planned)
    assert lost >= 0.0
    assert shot.residuals[0] == pytest.approx(residuals[k], rel=1e-6)
    assert shot.residual <= 1e-12
    figure = plot_residuals(planned, [plan(Scenario.random(4), tolerance=1e-8)])
    by_iteration, by_time = figure.axes
    alone, together = by_iteration.lines[-2:]
    np.testing.assert_array_equal(alone.get_ydata(), residuals)
    np.testing.assert_array_equal(together.get_ydata(), np.maximum(shot.residuals, 1e-16))
    assert together.get_xdata()[0] == k + 1
    assert len(by_time.lines) == len(by_iteration.lines) == 4
    assert by_iteration.get_yscale() == "log"


def test_a_plan_that_no_shot_improves_is_drawn_alone():
    stuck = plan(Scenario.named("paper").replace(control_bounds=(0.1, 0.1)), max_iterations=5)
    assert first_shot(stuck) is None
    assert len(plot_residuals(stuck).axes[0].lines) == 1

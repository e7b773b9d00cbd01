import numpy as np
import pytest

pytest.importorskip("matplotlib")

from slipcar.envs import Scenario
from slipcar.evaluation.figures.certificate import plot_hamiltonian
from slipcar.evaluation.figures.residuals import plot_residuals
from slipcar.evaluation.residuals import Curve
from slipcar.planner import plan
from slipcar.planner.extremal.certificate import certify


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


def curve(*residuals):
    count = np.arange(1, len(residuals) + 1)
    return Curve(np.array(residuals), count, 1e-3 * count)


def test_residuals_are_drawn_against_iteration_and_time():
    bold = {"convex": curve(1.0, 0.1, 1e-20), "newton": curve(1.0, 1e-9)}
    bold["newton, NumPy"] = curve(1.0, 1e-9)
    figure = plot_residuals(bold, [{"convex": curve(2.0, 0.2)}])
    by_iteration, by_time = figure.axes
    assert len(by_iteration.lines) == 3  # the uncompiled iterates are the same
    assert len(by_time.lines) == 4
    faint, convex, _ = by_iteration.lines
    np.testing.assert_array_equal(faint.get_ydata(), [2.0, 0.2])
    np.testing.assert_array_equal(convex.get_ydata(), [1.0, 0.1, 1e-16])  # the axis ends there
    np.testing.assert_allclose(by_time.lines[1].get_xdata(), [1.0, 2.0, 3.0])  # ms
    assert by_iteration.get_yscale() == "log"
    assert len(figure.legends[0].get_texts()) == 3


def test_unknown_methods_are_refused():
    with pytest.raises(ValueError, match="guessing"):
        plot_residuals({"guessing": curve(1.0)})

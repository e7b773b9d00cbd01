"""A plan in a notebook: short, as HTML, drawn for any system, as a frame and as a dataset."""

import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from scipy import stats

from slipcar.envs import Scenario
from slipcar.planner import Feedback, OpenLoop, Plan, plan


class Glider:
    """A system without a plane and without names."""

    start = np.array([0.0, 0.0])
    times = np.linspace(0.0, 4.0, 21)
    control_weight = np.eye(1)

    def drift(self, t, x, u):
        return np.stack([x[..., 1], u[..., 0] - 0.1 * x[..., 1] ** 2], axis=-1)

    def diffusion(self, t, x):
        return np.stack([0.0 * x[..., 1], 0.1 * x[..., 1]], axis=-1)[..., None]

    def terminal(self, x):
        return x - np.array([1.0, 0.0])


class Named(Glider):
    state_names, control_names = ("height [m]", "<b>climb</b>"), ("lift",)


@pytest.fixture(scope="module")
def glide():
    return plan(Glider(), variance_weight=0.0)


@pytest.fixture(scope="module")
def drive():
    return plan(Scenario.named("paper"), starts=3)


class Reader(HTMLParser):
    """Text of each cell; every tag must be closed, in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.texts = [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.texts.append(text)


def test_reprs_are_short_and_say_what_came_out(drive, glide):
    for record in (
        drive, glide, drive.certificate, drive.certificate.violations, drive.multipliers,
        drive.history, drive.history[0], drive.alternatives[0], OpenLoop(drive),
        plan(Scenario.named("paper"), feedback=True).expected, Feedback(drive),
    ):  # fmt: skip
        assert len(repr(record)) < 500, type(record)
        assert "\n" not in repr(record)
        assert "array([" not in repr(record)
    assert "CONVERGED" in repr(drive)
    assert drive.certificate.verdict in repr(drive.certificate)
    assert "mean=<array (41, 5)>" in repr(drive.history[0])


def test_html_is_well_formed_escaped_and_says_the_same(drive):
    texts = Reader(drive._repr_html_()).texts
    assert f"{drive.effort:.6g}" in texts
    assert any(text.startswith("CONVERGED: ") for text in texts)
    shown = plan(Named(), variance_weight=0.0)
    assert "height [m], <b>climb</b>" in Reader(shown._repr_html_()).texts
    texts = Reader(drive.certificate._repr_html_()).texts
    assert f"Certificate: {drive.certificate.verdict}" in texts
    assert all(name in texts for name in drive.certificate.residuals)
    bad = plan(Scenario.named("paper"), max_iterations=1).certificate
    assert any("not met: " in text for text in Reader(bad._repr_html_()).texts)


# ------------------------------------------------------------------ drawn


@pytest.fixture
def pyplot():
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    yield plt
    plt.close("all")


def test_a_plane_is_drawn_into_the_axes_it_is_given(drive, pyplot):
    _, axes = pyplot.subplots()
    assert drive.plot(axes) is axes
    lines = {line.get_label(): line for line in axes.lines}
    np.testing.assert_array_equal(lines["mean"].get_xydata(), drive.mean[:, :2])
    assert len(axes.patches) == 2 * len(drive.problem.obstacles)  # with their clearance
    assert axes.get_xlabel() == "r_x [m]"
    own = drive.plot()
    assert own.figure is not axes.figure


def test_ellipses_hold_the_mass_they_say(glide, pyplot):
    axes = glide.plot(plane=(0, 1))
    rims = [line.get_xydata() for line in axes.lines if line.get_alpha() == 0.7]
    assert len(rims) == 10
    last = rims[-1] - glide.mean[-1]
    squared = np.einsum("ki,ij,kj->k", last, np.linalg.inv(glide.covariance[-1]), last)
    np.testing.assert_allclose(squared, stats.chi2.ppf(0.95, df=2))


def test_a_system_without_a_plane_is_drawn_over_time(glide, pyplot):
    panels = glide.plot()
    assert panels.shape == (3,)
    assert [panel.get_title(loc="left") for panel in panels] == ["x[0]", "x[1]", "u[0]"]
    np.testing.assert_array_equal(panels[1].lines[0].get_ydata(), glide.mean[:, 1])
    (band,) = panels[1].collections
    top = band.get_paths()[0].vertices[:, 1].max()
    sd = np.sqrt(glide.covariance[:, 1, 1])
    assert top == pytest.approx((glide.mean[:, 1] + stats.norm.ppf(0.975) * sd).max(), abs=1e-6)
    held = panels[2].lines[0].get_ydata()
    np.testing.assert_array_equal(held[:-1], glide.controls[:, 0])
    _, grid = pyplot.subplots(1, 3)
    assert all(a is b for a, b in zip(glide.plot(grid), grid, strict=True))


def test_any_two_states_are_a_plane_and_nothing_else_is(drive, glide, pyplot):
    axes = drive.plot(plane=(3, 4))
    assert not axes.patches  # obstacles are in the plane of positions alone
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("v [m/s]", "ω [rad/s]")
    for plane in ((0, 5), (1, 1), (0,), (0, 1, 2)):
        with pytest.raises(ValueError, match=r"plane must be two of the states 0\.\.4"):
            drive.plot(plane=plane)
    _, axes = pyplot.subplots()
    with pytest.raises(ValueError, match=r"into 3 Axes, not 1; a plane=\(i, j\)"):
        glide.plot(axes)
    _, grid = pyplot.subplots(1, 2)
    with pytest.raises(ValueError, match="into one Axes"):
        drive.plot(grid)


def test_a_plan_that_lost_its_problem_can_still_be_drawn(glide, tmp_path, pyplot):
    again = Plan.load(glide.save(tmp_path / "plan.npz"))
    assert again.problem is None
    assert len(again.plot()) == 3
    assert list(again.to_frame()) == list(glide.to_frame())


# ------------------------------------------------------------------ as tables


def test_a_frame_has_a_row_a_node(drive, glide):
    frame = drive.to_frame()
    assert frame.index.name == "time"
    np.testing.assert_array_equal(frame.index, drive.times)
    np.testing.assert_array_equal(frame["v [m/s]"], drive.mean[:, 3])
    np.testing.assert_allclose(frame["sd of r_x [m]"] ** 2, drive.covariance[:, 0, 0], atol=1e-15)
    np.testing.assert_array_equal(frame["a_v [m/s²]"][:-1], drive.controls[:, 0])
    assert np.isnan(frame["a_v [m/s²]"].iloc[-1])
    assert list(glide.to_frame()) == ["x[0]", "x[1]", "sd of x[0]", "sd of x[1]", "u[0]"]
    assert "height [m]" in plan(Named(), variance_weight=0.0).to_frame()


def test_wrong_names_are_named():
    named = Named()
    named.control_names = ("a", "b")
    with pytest.raises(ValueError, match=r"control_names of the problem must be 1 names"):
        plan(named, variance_weight=0.0).to_frame()


def test_a_dataset_has_named_dimensions():
    pytest.importorskip("xarray")
    steered = plan(Scenario.named("paper"), feedback=True)
    data = steered.to_xarray()
    picked = data["covariance"].sel(state="θ [rad]", other_state="r_x [m]").sel(time=2.5)
    assert float(picked) == steered.covariance[20, 2, 0]
    assert data["gains"].dims == ("interval", "control", "state")
    accelerations = data["controls"].sel(control="a_v [m/s²]")
    np.testing.assert_array_equal(accelerations, steered.controls[:, 0])
    assert data.attrs["status"] == "CONVERGED"


@pytest.mark.parametrize(
    ("package", "call"),
    [("pandas", Plan.to_frame), ("xarray", Plan.to_xarray), ("matplotlib", Plan.plot)],
)
def test_what_is_missing_is_named(package, call, glide, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setitem(sys.modules, f"{package}.pyplot", None)
    with pytest.raises(ImportError, match=rf"needs {package} .*: pip install {package}"):
        call(glide)

import numpy as np
import pytest
from scipy import stats

pytest.importorskip("matplotlib")

from matplotlib.patches import Circle, Ellipse

from slipcar.envs import Scenario
from slipcar.evaluation import compare, sample_paths
from slipcar.evaluation.figures import saved as plots
from slipcar.evaluation.figures.rows import drawn_ranks
from slipcar.evaluation.report.document import read_document
from slipcar.planner import OpenLoop, plan


@pytest.fixture(scope="module")
def planned():
    scenario = Scenario.named("paper")
    found = plan(scenario)
    states, _ = sample_paths(OpenLoop(found), scenario, 4096)
    return scenario, found, states


def test_figure_1_shows_every_accepted_iterate(planned):
    scenario, found, states = planned
    figure = plots.iterations_figure(scenario, found, states[:100])
    scene, v, omega, a_v, a_omega = figure.axes[:5]
    iterates = [iterate for iterate in found.history if iterate.accepted]
    for axes, quantity, index in ((v, "mean", 3), (omega, "mean", 4), (a_v, "controls", 0)):
        drawn = [line.get_ydata() for line in axes.lines[: len(iterates)]]
        for values, iterate in zip(drawn, iterates, strict=True):
            expected = getattr(iterate, quantity)[:, index]
            np.testing.assert_array_equal(values[: len(expected)], expected)
    assert a_omega.lines[0].get_drawstyle() == "steps-post"
    assert len(scene.collections[0].get_segments()) == 100
    circles = [patch for patch in scene.patches if isinstance(patch, Circle)]
    radii = sorted(circle.radius for circle in circles)
    expected = sorted([*scenario.obstacles[:, 2], *(scenario.obstacles[:, 2] + 0.13)])
    np.testing.assert_allclose(radii, expected)


def test_ellipses_hold_95_percent_of_the_paths(planned):
    scenario, found, states = planned
    figure = plots.covariance_figure(scenario, found, states)
    ellipses = [patch for patch in figure.axes[0].patches if isinstance(patch, Ellipse)]
    ellipses = [ellipse for ellipse in ellipses if not isinstance(ellipse, Circle)]
    assert len(ellipses) == 5
    late = ellipses[1:]  # at first the car hardly slips, and what it does is not Gaussian
    for ellipse, node in zip(late, (16, 24, 32, 40), strict=True):
        turn = np.radians(ellipse.angle)
        offset = states[:, node, :2] - ellipse.center
        along = offset @ np.array([np.cos(turn), np.sin(turn)]) / (ellipse.width / 2)
        across = offset @ np.array([-np.sin(turn), np.cos(turn)]) / (ellipse.height / 2)
        share = np.mean(along**2 + across**2 <= 1.0)
        assert share == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / len(states)))


def test_an_ellipse_is_that_of_its_covariance():
    from slipcar.evaluation.figures.plan import _draw_ellipse
    from slipcar.evaluation.figures.scene import new_figure

    S = np.array([[4.0, 1.5], [1.5, 1.0]])
    axes = new_figure(3, 3).subplots()
    _draw_ellipse(axes, np.zeros(2), S)
    (ellipse,) = axes.patches
    turn = np.radians(ellipse.angle)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    quantile = stats.chi2.ppf(0.95, 2)
    D = np.diag([(ellipse.width / 2) ** 2, (ellipse.height / 2) ** 2]) / quantile
    np.testing.assert_allclose(R @ D @ R.T, S, rtol=1e-12)


def test_rows_figures(paper, replay, turning):
    rows = {
        "a": replay(paper, turning),
        "b": replay(paper, (0.0, 0.0)),  # costs far more
        "c": replay(paper, 1.01 * turning),
    }
    states, _ = sample_paths(rows["a"], paper, 100)
    field = paper.replace(obstacles=(), goal=states[:, -1].mean(axis=0))  # nothing to hit
    c = compare(rows, field, 200, progress=False)
    (legend,) = plots.tradeoff_figure(c).legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert len(labels) == 3
    assert all("open loop" in label for label in labels)
    totals = {name: c.results[name].total for name in rows}
    assert totals["b"] > 5.0 * min(totals.values())
    assert ["off the axes" in label for label in labels] == [False, True, False]
    assert all("none observed" in label for label in labels if "axes" not in label)
    left, right = plots.distributions_figure(c).axes
    costs, share = left.lines[0].get_data()
    np.testing.assert_array_equal(np.sort(costs), np.sort(c.results["a"].metrics.total))
    assert share[-1] == 1.0
    assert right.lines[0].get_ydata()[0] == pytest.approx(1.0)


def test_no_two_rows_look_the_same(paper, replay):
    rows = {f"row {i}": replay(paper, (0.0, 0.0)) for i in range(14)}
    for i in range(0, 14, 3):
        rows[f"row {i}"].closed_loop = True
    c = compare(rows, paper, 20, progress=False)
    left, _ = plots.distributions_figure(c).axes
    looks = {(line.get_color(), str(line._unscaled_dash_pattern)) for line in left.lines}
    assert len(looks) == len(left.lines) == 14


@pytest.mark.parametrize("count", [1, 2, 4000, 4001, 100_000, 10_000_000])
def test_distributions_are_drawn_through_enough_points(count):
    ranks = drawn_ranks(count)
    assert (ranks[0], ranks[-1]) == (0, count - 1)
    assert len(ranks) <= 4200
    steps = np.diff(ranks)
    assert (steps >= 1).all()
    assert (steps <= 1 + count / 1999).all()  # of the share: less than a line is wide
    left = count - ranks  # how many cost at least so much
    assert (left[:-1] <= 1.01 * left[1:] + 1).all()  # of its logarithm likewise
    assert (np.diff(ranks[-100:]) == 1).all()


def test_everything_is_written(planned, tmp_path):
    scenario, found, _ = planned
    c = compare({"SCP": OpenLoop(found)}, scenario, 500, progress=False)
    written = c.save(tmp_path)
    names = {path.name for path in written}
    figures = ("tradeoff", "distributions", "iterations", "covariance")
    for figure in figures:
        assert {f"{figure}.png", f"{figure}.pdf", f"{figure}.svg"} <= names
    assert tuple(figure.stem for figure in read_document(tmp_path).figures) == figures
    for path in written:
        assert path.stat().st_size > 50
    assert (tmp_path / "tradeoff.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert (tmp_path / "tradeoff.pdf").read_bytes()[:4] == b"%PDF"


def test_a_plan_without_accepted_steps_can_be_drawn(planned):
    scenario, found, states = planned
    stuck = found.replace(history=())
    figure = plots.iterations_figure(scenario, stuck, states[:3])
    assert len(figure.axes) == 5  # no colour bar


def test_drawing_leaves_the_users_settings_alone(planned):
    import matplotlib as mpl

    scenario, _, states = planned
    before = dict(mpl.rcParams)
    plots.paths_figure(scenario, states[:30], "paths")
    assert dict(mpl.rcParams) == before


def test_paths_that_hit_are_counted(planned):
    scenario, _, states = planned
    figure = plots.paths_figure(scenario, states[:500], "paths")
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    hit = int((scenario.signed_distance(states[:500, 1:]) < 0).any(axis=1).sum())
    assert hit > 0
    assert {f"hits an obstacle ({hit})", f"free ({500 - hit})"} <= set(labels)


def test_iterates_of_a_free_final_time_end_when_their_horizons_do():
    found = plan(Scenario.named("paper"), free_final_time=True)
    states, _ = sample_paths(OpenLoop(found), found.problem, 2)
    axes = plots.iterations_figure(found.problem, found, states).axes[1]
    ends = [line.get_xdata()[-1] for line in axes.lines if len(line.get_xdata()) == 41]
    tried = [step for step in found.time_search if step.accepted]
    expected = np.repeat([t.final_time for t in tried], [t.iterations for t in tried])
    assert len({step.final_time for step in tried}) > 2
    np.testing.assert_allclose(ends, expected)

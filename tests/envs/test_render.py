"""What is drawn is where the state says, with and without a display."""

import itertools
import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled, Error, ResetNeeded

from slipcar.envs import Scenario, SlipCarEnv

pygame = pytest.importorskip("pygame")

from slipcar.envs.overlay import RADIUS, Overlay  # noqa: E402
from slipcar.envs.pictures.sprites import PLAN, speed_colours  # noqa: E402
from slipcar.envs.pictures.view import CAR_LENGTH, grid_step  # noqa: E402
from slipcar.envs.render import STRIP, WIDTH, Screen  # noqa: E402

PAPER = Scenario.named("paper")
WORLDS = [Scenario.named(name) for name in Scenario.names()]
RANDOM = [Scenario.random(seed, turned=True) for seed in range(40)]
FAR = [
    PAPER.replace(goal=[3e5, -2e5, 1, 0, 0]),
    PAPER.replace(start=[1e-3, 0, 0, 0, 0], goal=[0, 0, 0, 0, 0], obstacles=[]),
    PAPER.replace(obstacles=[[500, 0, 490.0]]),
]


@pytest.fixture
def dummy_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def screen(scenario=PAPER):
    return Screen(scenario, human=False, fps=8)


def trail(*states):
    return np.array(states, dtype=float)


def at(x, y, theta=0.0):
    return [x, y, theta, 0.5, 0.1]


def centre_of_change(a, b):
    """Mean (column, row) of the pixels of the scene in which two frames differ."""
    rows, columns = np.nonzero((a != b).any(axis=-1)[:-STRIP])
    return np.array([columns.mean(), rows.mean()])


# ------------------------------------------------------------------------------------- the view


@pytest.mark.parametrize("scenario", WORLDS + RANDOM + FAR)
def test_the_view_shows_start_goal_and_clearance_rings_with_a_margin(scenario):
    view = screen(scenario).view
    points = [scenario.start[:2], scenario.goal[:2]]
    for x, y, radius in scenario.obstacles:
        reach = radius + scenario.clearance
        points += [[x - reach, y], [x + reach, y], [x, y - reach], [x, y + reach]]
    pixels = view.pixels(np.array(points))
    assert (pixels > 5).all()
    assert (pixels[:, 0] < WIDTH - 5).all()
    assert (pixels[:, 1] < view.height - 5).all()


@pytest.mark.parametrize("scenario", WORLDS + FAR)
def test_scales_are_equal_and_y_points_up(scenario):
    view = screen(scenario).view
    metre = 0.1 / view.scale * 100
    origin, right, up = view.pixels(scenario.start[:2] + metre * np.array([[0, 0], [1, 0], [0, 1]]))
    np.testing.assert_allclose(right - origin, [10, 0], atol=1e-5)
    np.testing.assert_allclose(up - origin, [0, -10], atol=1e-5)


@pytest.mark.parametrize("scale", [1e-6, 0.3, 5.0, 39.0, 40.0, 170.0, 1e5])
def test_grid_lines_are_whole_metres_and_never_crowded(scale):
    step = grid_step(scale)
    assert step == int(step) >= 1
    assert step * scale >= 40.0
    assert step == 1 or step / 2.5 * scale < 40.0  # and no sparser than needed


def test_speed_colours_are_colours_whatever_the_speed():
    for colour in speed_colours(np.array([0.0, 0.4, 1.0, 7.0, -1.0, np.nan, np.inf])):
        assert all(isinstance(c, int) and 0 <= c <= 255 for c in colour)
    slow, fast = speed_colours(np.array([0.0, 1.0]))
    assert sum(fast) < sum(slow)  # darker is faster


# ------------------------------------------------------------------------------------ the frames


@pytest.mark.parametrize("scenario", WORLDS + RANDOM[:5] + FAR)
def test_frames_are_images_of_one_size(scenario):
    drawn = screen(scenario)
    for k in (1, 2, 30):
        frame = drawn.draw(np.tile(scenario.start, (k, 1)), collided=False)
        assert frame.dtype == np.uint8
        assert frame.shape == (drawn.size[1], WIDTH, 3)
        assert frame.shape[0] % 16 == 0  # what video codecs want
        assert frame.flags.writeable
        assert frame.std() > 2.0


def test_frames_depend_on_what_is_drawn_alone_and_belong_to_the_caller():
    drawn = screen()
    first = drawn.draw(trail(PAPER.start), collided=False)
    kept = first.copy()
    drawn.draw(trail(PAPER.start, at(1, 1)), collided=True)[:] = 0
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(drawn.draw(trail(PAPER.start), collided=False), kept)


@pytest.mark.parametrize("position", [(0.2, 2.9), (2.4, 0.1), (2.0, 1.0), (0.9, 2.6)])
def test_the_car_is_drawn_where_it_is(position):
    drawn = screen()
    nowhere = drawn.draw(trail(at(1e6, 0)), collided=False)  # an arrow at the edge
    frame = drawn.draw(trail(at(*position)), collided=False)
    where = drawn.view.pixels(np.array(position))
    column, row = np.round(where).astype(int)
    assert (frame[row - 1 : row + 2, column - 1 : column + 2] > 225).all()  # the white dot
    length = CAR_LENGTH * drawn.view.scale
    beside = [
        nowhere[row + y, column + x].tolist() != frame[row + y, column + x].tolist()
        for x, y in ((int(0.4 * length), 0), (-int(0.4 * length), 0))
    ]
    assert all(beside)


def test_the_car_points_along_its_heading():
    """Turned by π it looks different: the front is marked; turned by 2π it is the same."""
    drawn = screen()
    frames = [
        drawn.draw(trail(at(2.0, 1.0, angle)), collided=False)[:-STRIP]
        for angle in (0.0, np.pi, 2 * np.pi)
    ]
    np.testing.assert_array_equal(frames[0], frames[2])
    assert (frames[0] != frames[1]).any()
    # Heading π/2 is up: the body covers pixels above its centre that it does not cover at 0.
    upright = drawn.draw(trail(at(2.0, 1.0, np.pi / 2)), collided=False)
    column, row = np.round(drawn.view.pixels(np.array([2.0, 1.0]))).astype(int)
    reach = int(0.4 * CAR_LENGTH * drawn.view.scale)
    assert (upright[row - reach, column] != frames[0][row - reach, column]).any()
    # The windscreen lies ahead of the centre, on the right at 0 and above at π/2.
    ahead = int(0.18 * CAR_LENGTH * drawn.view.scale)
    assert frames[0][row, column + ahead].min() > 200 > frames[0][row, column - ahead].min()
    assert upright[row - ahead, column].min() > 200 > upright[row + ahead, column].min()


def test_the_trail_runs_along_the_path():
    drawn = screen()
    here, there = at(2.0, 0.6), at(2.4, 1.4)
    without = drawn.draw(trail(there), collided=False)
    with_trail = drawn.draw(trail(here, there), collided=False)
    middle = drawn.view.pixels(np.array([2.2, 1.0]))
    column, row = np.round(middle).astype(int)
    assert (without[row, column] != with_trail[row, column]).any()
    expected = drawn.view.pixels(np.array([2.15, 0.9]))  # the car covers the last third
    assert np.linalg.norm(centre_of_change(without, with_trail) - expected) < 0.2 * drawn.view.scale


def test_a_collision_is_red_and_said_so():
    drawn = screen()

    def red(frame):
        r, g, b = (frame[..., i].astype(int) for i in range(3))
        return int(((r > 180) & (g < 80) & (b < 80)).sum())

    path = trail(PAPER.start, at(1.5, 1.9), at(2.0, 1.0))  # through the centre of an obstacle
    clear = drawn.draw(path[[0, 2]], collided=False)
    hit = drawn.draw(path, collided=True)
    assert red(clear) == 0
    assert red(hit[:-STRIP]) > 200
    assert red(hit[-STRIP:]) > 20


@pytest.mark.parametrize(
    "position", [(-50, 0), (0, 50), (1e9, -1e9), (1e100, 0), (np.inf, 0), (0, np.nan), (2.75, 3.3)]
)
def test_a_car_that_leaves_the_view_is_no_trouble(position):
    drawn = screen()
    frame = drawn.draw(trail(PAPER.start, at(*position), at(*position)), collided=False)
    assert (frame != drawn.draw(trail(PAPER.start), collided=False)).any()


@pytest.mark.parametrize("heading", [1e9, -1e9, np.inf, np.nan])
def test_odd_headings_are_no_trouble(heading):
    assert screen().draw(trail(at(1, 1, heading)), collided=False) is not None


# --------------------------------------------------------------------- trails piece by piece


def wander(rng, nodes, scenario=PAPER):
    path = np.zeros((nodes, 5))
    path[:, :2] = rng.uniform(-0.5, 3.0, (nodes, 2))
    path[:, 2:] = rng.normal(size=(nodes, 3))
    path[0] = scenario.start
    return path


def test_frames_do_not_depend_on_what_was_drawn_before():
    """Trails grow, shrink, restart, part ways and are written over; a new screen draws the same."""
    rng, drawn = np.random.default_rng(0), screen()
    one, other = wander(rng, 12), wander(rng, 12)
    parted = np.vstack([one[:6], other[6:]])
    plans = Overlay(one[:, :2]), Overlay(other[:, :2]), None
    steps = [(one, 1), (one, 2), (one, 5), (one, 6), (one, 12), (parted, 8), (one, 3), (other, 12)]
    steps += [(one, 1), (parted, 12), (one, 12), (one, 12)]
    scratch = np.empty((12, 5))  # a caller may use the same memory again
    for i, (path, k) in enumerate(steps):
        overlay = plans[(i // 4) % 3]
        scratch[:k] = path[:k]
        frame = drawn.draw(scratch[:k], collided=bool(i % 2), overlay=overlay)
        fresh = screen().draw(path[:k], collided=bool(i % 2), overlay=overlay)
        np.testing.assert_array_equal(frame, fresh)


def test_another_world_is_drawn_in_frames_of_the_same_size():
    drawn, other = screen(), Scenario.named("slalom")
    before = drawn.draw(trail(PAPER.start), collided=False)
    drawn.enter(other)
    assert drawn.scenario is other
    after = drawn.draw(trail(other.start), collided=False)
    assert after.shape == before.shape
    assert (after != before).any()
    drawn.enter(PAPER)
    np.testing.assert_array_equal(drawn.draw(trail(PAPER.start), collided=False), before)


# ------------------------------------------------------------------------------------ overlays


def test_the_planned_path_is_drawn_where_it_is_and_under_the_car():
    drawn = screen()
    parked = trail(at(2.5, 0.2))
    plan = Overlay(np.array([[1.8, 0.9, 0.0], [2.4, 0.9, 0.0], [2.4, 0.2, 0.0]]))
    without = drawn.draw(parked, collided=False)
    frame = drawn.draw(parked, collided=False, overlay=plan)
    for position in ((2.0, 0.9), (2.3, 0.9), (2.4, 0.6)):
        column, row = np.round(drawn.view.pixels(np.array(position))).astype(int)
        near = frame[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).astype(int)
        assert np.abs(near - PLAN).sum(axis=1).min() < 60
        assert (without[row, column] > 200).all()
    column, row = np.round(drawn.view.pixels(np.array([2.5, 0.2]))).astype(int)
    np.testing.assert_array_equal(frame[row, column], without[row, column])
    np.testing.assert_array_equal(drawn.draw(parked, collided=False), without)


@pytest.mark.parametrize("towards", [(0.0, 0.0), (0.7, 0.1), (-0.1, -0.6)])
def test_the_tinted_region_is_the_95_percent_ellipse_moved_along_the_path(towards):
    drawn = screen()
    S = np.array([[0.02, 0.008], [0.008, 0.006]])
    path = np.array([1.9, 1.1]) + np.array([[0.0, 0.0], towards])
    parked = trail(at(0.0, 3.0))
    without = drawn.draw(parked, collided=False)
    frame = drawn.draw(parked, collided=False, overlay=Overlay(path, np.stack([S, S])))
    rows, columns = np.mgrid[120 : frame.shape[0] - STRIP : 2, 0:WIDTH:2]
    distance = np.full(rows.shape, np.inf)
    for share in np.linspace(0.0, 1.0, 41):
        centre = drawn.view.pixels(path[0] + share * (path[1] - path[0]))
        offset = np.stack([columns, rows], axis=-1) - centre
        offset = offset * (1.0, -1.0) / drawn.view.scale
        squared = np.einsum("...i,ij,...j", offset, np.linalg.inv(S), offset)
        distance = np.minimum(distance, np.sqrt(squared))
    changed = (frame != without).any(axis=-1)[rows, columns]
    pixel = 2.0 / (drawn.view.scale * np.sqrt(np.linalg.eigvalsh(S)[0]))
    assert changed[distance < RADIUS - pixel].all()
    assert not changed[distance > RADIUS + pixel].any()


@pytest.mark.parametrize("far", [1e3, 1e9])
def test_an_overlay_out_of_sight_is_no_trouble(far):
    plan = Overlay(np.array([[0.0, 0.0], [far, -far]]), far**2 * np.stack([np.eye(2)] * 2))
    assert screen().draw(trail(PAPER.start), collided=False, overlay=plan) is not None
    away = Overlay(np.full((3, 2), far), np.stack([np.eye(2)] * 3))
    assert screen().draw(trail(PAPER.start), collided=False, overlay=away) is not None


# ------------------------------------------------------------------------------- the environment


def test_pixels_change_as_the_car_moves():
    env = SlipCarEnv(render_mode="rgb_array")
    env.reset(seed=0)
    frames = [env.render()]
    for _ in range(PAPER.nodes - 1):
        env.step(np.array([0.6, 0.3]))
        frames.append(env.render())
    env.close()
    scenes = [frame[:-STRIP] for frame in frames]
    for before, after in itertools.pairwise(scenes[1:]):  # from rest the first is still
        assert (before != after).any()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), frames[0])  # also after close()


def test_rendering_does_not_touch_the_path():
    env, blind = SlipCarEnv(render_mode="rgb_array"), SlipCarEnv()
    for e in (env, blind):
        e.reset(seed=0)
    for _ in range(10):
        env.render()
        action = np.array([0.6, 0.3])
        np.testing.assert_array_equal(env.step(action)[0], blind.step(action)[0])


def test_rendering_needs_a_mode_and_a_reset():
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert SlipCarEnv().render() is None
    with pytest.raises(ResetNeeded, match=r"reset\(\) before render\(\)"):
        SlipCarEnv(render_mode="rgb_array").render()


def test_no_display_is_needed_off_screen():
    """In a process of its own, without anything that could tell SDL of a display."""
    program = (
        "import pygame\n"
        "from slipcar.envs import SlipCarEnv\n"
        "env = SlipCarEnv(render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "print(env.render().shape, pygame.display.get_init())\n"
    )
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "XDG_RUNTIME_DIR")
    result = subprocess.run(
        [sys.executable, "-c", program],
        env={k: v for k, v in os.environ.items() if k not in hidden},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1].endswith("640, 3) False")


def test_a_missing_pygame_is_explained(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = SlipCarEnv(render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(DependencyNotInstalled, match=r"pip install .*'pygame-ce>="):
        env.render()


# ------------------------------------------------------------------------------------ the window


@pytest.mark.usefixtures("dummy_display")
def test_a_window_shows_what_is_drawn_off_screen():
    env = gym.make("slipcar.envs:SlipCar-v0", render_mode="human")
    reference = SlipCarEnv(render_mode="rgb_array")
    for e in (env, reference):
        e.reset(seed=0)
        e.step(np.array([1.0, 0.5]))
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, reference.render())
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()


@pytest.mark.usefixtures("dummy_display")
def test_closing_the_window_stops_the_drawing_but_not_the_episode():
    env = SlipCarEnv(render_mode="human")
    env.reset(seed=0)
    env.step(np.zeros(2))
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    env.step(np.zeros(2))
    assert not pygame.display.get_init()
    for _ in range(PAPER.nodes - 3):
        *_, terminated, _, _ = env.step(np.zeros(2))
    assert terminated
    assert env.render() is None
    env.reset()
    assert not pygame.display.get_init()  # what its user closed stays closed
    env.close()
    env.close()


def test_a_window_without_a_display_is_an_error_that_says_what_to_do(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonesuch")
    env = SlipCarEnv(render_mode="human")
    with pytest.raises(Error, match=r"found no display .*use render_mode='rgb_array'"):
        env.reset(seed=0)


# -------------------------------------------------------------------------------------- the film


def test_gymnasium_records_videos_of_an_episode(tmp_path):
    pytest.importorskip("moviepy")
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    world = Scenario.named("open").replace(nodes=7)
    env = gym.make("slipcar.envs:SlipCar-v0", scenario=world, render_mode="rgb_array")
    env = gym.wrappers.RecordVideo(env, str(tmp_path / "videos"), disable_logger=True)
    env.reset(seed=0)
    last = env.render()
    for _ in range(world.nodes - 1):
        env.step(np.array([0.9, 0.2]))
        last = env.render()
    env.close()
    (film,) = tmp_path.glob("videos/*.mp4")
    pictures = ffmpeg.read_frames(str(film))
    about = next(pictures)
    assert about["size"] == last.shape[1::-1]
    assert about["fps"] == env.metadata["render_fps"]
    decoded = [np.frombuffer(raw, np.uint8).reshape(last.shape).astype(int) for raw in pictures]
    assert len(decoded) == world.nodes
    # What moves tells pictures apart: the last one decoded is the last one drawn.
    difference = [np.abs(picture - last).mean() for picture in decoded]
    assert np.argmin(difference) == world.nodes - 1
    assert difference[-1] < 4.0

"""Films show what happened and what was meant, whole or not at all."""

import dataclasses
import sys

import numpy as np
import pytest

from slipcar.baselines import straight
from slipcar.envs import Scenario
from slipcar.evaluation import sample_paths
from slipcar.evaluation.cli import main
from slipcar.evaluation.recording import overlay_of, record
from slipcar.planner import Feedback, OpenLoop, RecedingHorizon, plan
from slipcar.planner.actuation import Actuation

pytest.importorskip("pygame")

from slipcar.evaluation import film

PAPER = Scenario.named("paper")


@pytest.fixture(scope="module")
def planned():
    return plan(PAPER)


@pytest.fixture(scope="module")
def open_loop(planned):
    return record(OpenLoop(planned), PAPER, 2, seed=3)


class Wanderer:
    """Remembers how often it was asked, and previews a path of that length."""

    rows = 4

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        count = np.zeros(len(observation), int) if state is None else state
        return np.full((len(observation), 2), 0.3), count + 1

    def preview(self, state, row):
        return np.full((state[row], 2), float(row)), None


class Silent:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2)), None


# ------------------------------------------------------------------------------- what was meant


def test_a_recording_is_what_an_evaluation_drives(planned):
    for controller in (Feedback(planned), Silent(), Wanderer()):
        recording = record(controller, PAPER, 6, seed=1)
        np.testing.assert_array_equal(recording.states, sample_paths(controller, PAPER, 6, 1)[0])


def test_open_loop_shows_its_plan_and_feedback_what_is_left_of_its_noise(planned):
    shown, steered = overlay_of(OpenLoop(planned)), overlay_of(Feedback(planned))
    np.testing.assert_array_equal(shown.positions, planned.mean[:, :2])
    np.testing.assert_array_equal(shown.covariances, planned.covariance[:, :2, :2])
    states, _ = sample_paths(Feedback(planned), PAPER, 4096, 0)
    for k in (12, 24, 40):
        measured = np.cov(states[:, k, :2].T)
        error = np.abs(steered.covariances[k] - measured).max() / measured.max()
        assert error < 0.1
        assert np.abs(shown.covariances[k] - measured).max() / measured.max() > error


def test_a_plan_with_its_own_gains_shows_its_own_covariance(planned):
    own = plan(PAPER, feedback=True)
    np.testing.assert_array_equal(overlay_of(Feedback(own)).covariances, own.covariance[:, :2, :2])
    known = dataclasses.replace(Actuation.of(PAPER, 2), translators=())
    forgotten = planned.replace(problem=None, actuation=known)
    assert overlay_of(Feedback(forgotten)).covariances is None


def test_a_receding_horizon_shows_the_plan_of_each_node():
    controller = RecedingHorizon(PAPER)
    recording = record(controller, PAPER, 2, seed=5)
    for i in range(2):
        for k, meant in enumerate(recording.overlays[i]):
            assert len(meant.positions) == PAPER.nodes - k
            # From where it stands (observed in single precision), for certain, to the goal.
            np.testing.assert_allclose(meant.positions[0], recording.states[i, k, :2], atol=1e-6)
            assert not meant.covariances[0].any()
            assert np.linalg.norm(meant.positions[-1] - PAPER.goal[:2]) < 0.3
    meant = recording.overlays[0][20]
    assert np.linalg.eigvalsh(meant.covariances[1:])[:, 0].min() > 0.0
    assert (recording.overlays[1][20].positions != meant.positions).any()
    np.testing.assert_array_equal(overlay_of(controller).positions, controller.plan.mean[:, :2])
    with pytest.raises(ValueError, match="row must be one of the state's 2, not 7"):
        controller.preview(controller.predict(np.zeros((2, 6)))[1], 7)


def test_each_episode_gets_its_own_preview_at_each_node():
    recording = record(Wanderer(), PAPER, 6, seed=0)  # in chunks of four
    for i, meant in enumerate(recording.overlays):
        assert [len(overlay.positions) for overlay in meant] == list(range(1, PAPER.nodes))
        assert all((overlay.positions == i % 4).all() for overlay in meant)
    assert recording.overlay(0, PAPER.nodes - 1) is recording.overlays[0][-1]


def test_controllers_need_not_say_what_they_mean(planned):
    assert overlay_of(Silent()) is None
    assert record(Silent(), PAPER, 1).overlay(0, 17) is None
    assert record(OpenLoop(planned), PAPER, 1, overlay=False).overlay(0, 17) is None
    with pytest.raises(ValueError, match="at most 1024 to be recorded, not 1025"):
        record(Silent(), PAPER, 1025)


# ----------------------------------------------------------------------------------- the pictures


def test_one_picture_a_node_or_so_many_a_second(open_loop):
    at = film.times(open_loop, None)
    np.testing.assert_array_equal(at[: PAPER.nodes], PAPER.times)
    assert (at[PAPER.nodes :] == PAPER.times[-1]).all()
    smooth = film.times(open_loop, 24)
    assert at[-1] == smooth[-1] == PAPER.times[-1]
    np.testing.assert_allclose(np.diff(smooth[: 24 * 5 + 1]), 1 / 24)
    assert len(smooth) == 24 * 5 + 1 + 18  # the last stays for three quarters of a second
    assert film.length(open_loop) == 2 * len(at)
    assert film.length(open_loop, fps=24, tiled=True) == len(smooth)


def test_between_nodes_the_car_is_between_its_states(open_loop):
    path = open_loop.states[0]
    for k in (0, 17, PAPER.nodes - 1):
        node, trail = film._until(open_loop, 0, PAPER.times[k])
        assert node == k
        np.testing.assert_array_equal(trail, path[: k + 1])
    node, trail = film._until(open_loop, 0, PAPER.times[17] + 0.25 * PAPER.dt)
    assert node == 17
    np.testing.assert_array_equal(trail[:-1], path[:18])
    np.testing.assert_allclose(trail[-1], 0.75 * path[17] + 0.25 * path[18])


def test_collisions_count_from_the_node_where_they_happen(open_loop):
    hit = record(straight(PAPER), PAPER, 1, seed=0)
    inside = PAPER.signed_distance(hit.states[0]) < 0.0
    first = int(np.flatnonzero(inside)[0])
    assert not hit.collided(0, first - 1)
    assert hit.collided(0, first)
    assert hit.collided(0, PAPER.nodes - 1)
    assert not open_loop.collided(0, 0)


def test_films_are_drawn_as_the_environment_draws(open_loop):
    from slipcar.envs.render import Screen

    pictures = list(film.frames(open_loop))
    assert len(pictures) == film.length(open_loop)
    screen = Screen(PAPER, human=False, fps=8)
    expected = screen.draw(
        open_loop.states[1][:31],
        collided=open_loop.collided(1, 30),
        overlay=open_loop.overlay(1, 30),
    )
    np.testing.assert_array_equal(pictures[len(pictures) // 2 + 30], expected)


def test_tiles_of_a_film_run_together(open_loop):
    first, *_, last = film.frames(open_loop, tiled=True)
    half = first.shape[1] // 2
    assert (first != last)[:, :half].any()
    assert (first != last)[:, half:].any()


def test_a_window_plays_the_film(open_loop, monkeypatch):
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(pygame.time, "Clock", lambda: type("Clock", (), {"tick": lambda *_: 0})())
    film.show(open_loop, tiled=True)
    assert not pygame.display.get_init()


# -------------------------------------------------------------------------------------- the files


def squares(count, height=32, width=48):
    """Pictures told apart by how far a bright square has moved."""
    pictures = np.full((count, height, width, 3), 30, np.uint8)
    for i, picture in enumerate(pictures):
        picture[8:24, 2 * i : 2 * i + 16] = (40, 200, 90)
    return pictures


def decoded(path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    reader = ffmpeg.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    return about, np.stack(
        [np.frombuffer(raw, np.uint8).reshape(height, width, 3) for raw in reader]
    )


@pytest.mark.parametrize(("height", "width"), [(32, 48), (50, 46)])
def test_a_video_decodes_to_the_pictures_it_was_made_of(tmp_path, height, width):
    pytest.importorskip("imageio_ffmpeg")
    made = squares(9, height, width)
    path = film.save_video(tmp_path / "new" / "a.mp4", iter(made), fps=12)
    about, shown = decoded(path)
    assert (about["codec"], about["fps"]) == ("h264", 12)
    assert about["pix_fmt"].startswith("yuv420p")
    assert shown.shape == made.shape
    assert np.abs(shown.astype(int) - made).mean() < 4.0
    assert [file.name for file in path.parent.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("save", [film.save_video, film.save_gif])
def test_what_fails_on_the_way_leaves_the_old_file(tmp_path, save):
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / ("a.mp4" if save is film.save_video else "a.gif")
    path.write_bytes(b"old")

    def broken():
        yield from squares(70)[:, :, :48]
        raise RuntimeError("lights out")

    with pytest.raises(RuntimeError, match="lights out"):
        save(path, broken(), 8)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ValueError, match="at least one picture"):
        save(path, iter(()), 8)


def test_bad_names_and_sizes(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    with pytest.raises(ValueError, match=r"ends in .mp4, not 'a.avi'"):
        film.save_video(tmp_path / "a.avi", squares(1))
    with pytest.raises(ValueError, match=r"ends in .gif, not 'a.mp4'"):
        film.save_gif(tmp_path / "a.mp4", squares(1), 8)
    with pytest.raises(ValueError, match="even size, not 47 x 32"):
        film.save_video(tmp_path / "a.mp4", squares(1, 32, 47))


# ------------------------------------------------------------------------------- the command line


def test_simulate_films_a_video(tmp_path, capsys):
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "out.mp4"
    world = tmp_path / "short.json"
    world.write_text(Scenario.named("open").replace(nodes=9, horizon=1.0).to_json())
    arguments = ["--controller", "feedback", "--scenario", str(world), "--episodes", "2"]
    assert main(["simulate", *arguments, "--video", str(path)]) == 0
    assert str(path) in "".join(capsys.readouterr().out.split())
    about, shown = decoded(path)
    expected = record(Feedback(plan(Scenario.from_json(world.read_text()))), *_short(world))
    assert about["fps"] == film.FPS
    assert len(shown) == film.length(expected, fps=film.FPS)
    drawn = list(film.frames(expected, fps=film.FPS))
    assert shown.shape[1:] == drawn[0].shape
    assert np.abs(shown[-1].astype(int) - drawn[-1]).mean() < 3.0
    tiled = tmp_path / "tiled.mp4"
    assert main(["simulate", *arguments, "--tiled", "--no-overlay", "--video", str(tiled)]) == 0
    assert len(decoded(tiled)[1]) == film.length(expected, fps=film.FPS, tiled=True)


def _short(world):
    return Scenario.from_json(world.read_text()), 2, 0


def test_who_drives_is_said_once(capsys):
    words = ["--scenario", "open", "--episodes", "1"]
    assert main(["simulate", "straight", *words]) == 0
    by_place = capsys.readouterr().out
    assert main(["simulate", "--controller", "straight", *words]) == 0
    assert capsys.readouterr().out == by_place
    assert main(["simulate", "scp", "--controller", "straight", *words]) == 2
    assert "'scp' or --controller 'straight'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--video", "a.gif"], "ends in .mp4, not 'a.gif'"),
        (["--video", "a.mp4", "--episodes", "51"], "at most 50"),
        (["--video", "taken/a.mp4"], "taken is no folder"),
        (["--gif", "taken/b/a.gif"], "taken is no folder"),
        (["--frames", "taken"], "taken is no folder"),
        (["--video", "folder.mp4"], "is a folder"),
    ],
)
def test_bad_films_are_one_line_before_any_work(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("a file")
    (tmp_path / "folder.mp4").mkdir()
    assert main(["simulate", *arguments]) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert not said.out


def test_a_folder_that_may_not_be_written_to(tmp_path, capsys, monkeypatch):
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)  # whoever runs the tests
    assert main(["simulate", "--video", str(tmp_path / "a.mp4")]) == 2
    said = capsys.readouterr().err
    assert f"{tmp_path} does not let files be made (Permission denied)" in said


@pytest.mark.parametrize(
    ("module", "package"), [("imageio_ffmpeg", "imageio-ffmpeg>="), ("pygame", "pygame-ce>=")]
)
def test_what_is_missing_can_be_installed(module, package, capsys, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    assert main(["simulate", "--video", str(tmp_path / "a.mp4")]) == 2
    said = capsys.readouterr()
    assert "pip install" in said.err
    assert f"'{package}" in said.err
    assert not said.out

"""Gymnasium's own vector wrappers over the native environment."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import vector as wrappers

from slipcar.envs import Scenario

ENV_ID = "slipcar.envs:SlipCar-v0"
SHORT = Scenario.named("paper").replace(nodes=13)


def make(count=4, **options):
    options = {"scenario": SHORT, **options}
    return gym.make_vec(ENV_ID, count, vectorization_mode="vector_entry_point", **options)


def actions(count=4, steps=30):
    return np.random.default_rng(0).uniform(-1, 1, (steps, count, 2)).astype(np.float32)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_episode_statistics_are_returns_and_lengths(mode):
    envs = wrappers.RecordEpisodeStatistics(make(autoreset_mode=mode))
    plain = make(autoreset_mode=mode)
    envs.reset(seed=0), plain.reset(seed=0)
    total, seen = np.zeros(4), 0
    for a in actions():
        _, _, over, _, info = envs.step(a)
        total += plain.step(a)[1]
        if over.any():
            np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-6)
            np.testing.assert_array_equal(info["episode"]["l"], SHORT.nodes - 1)
            total[:], seen = 0.0, seen + 1
    assert seen == 2


def test_normalised_observations_have_mean_zero_and_variance_one():
    envs = wrappers.NormalizeObservation(make(200))
    envs.reset(seed=0)
    late = [envs.step(a)[0] for a in actions(200, 130)][-52:]
    # cos θ and the like hardly vary in the first steps; over whole episodes all do.
    values = np.concatenate(late)
    assert np.abs(values.mean(axis=0)).max() < 0.2
    assert np.abs(values.std(axis=0) - 1.0).max() < 0.2


def test_normalised_rewards_and_clipped_actions():
    envs = wrappers.NormalizeReward(wrappers.ClipAction(make(50)))
    envs.reset(seed=0)
    rewards = [envs.step(3.0 * a)[1] for a in actions(50, 120)]
    assert np.isfinite(rewards).all()
    assert np.abs(rewards).max() < 20.0


def test_numpy_to_torch():
    torch = pytest.importorskip("torch")
    envs, plain = wrappers.NumpyToTorch(make(obstacle_slots=4)), make(obstacle_slots=4)
    observation, _ = envs.reset(seed=0)
    expected, _ = plain.reset(seed=0)
    assert observation.dtype == torch.float32
    np.testing.assert_array_equal(observation.numpy(), expected)
    for a in actions(4, 3):
        got, wanted = envs.step(torch.from_numpy(a)), plain.step(a)
        for mine, theirs in zip(got[:4], wanted[:4], strict=True):
            np.testing.assert_array_equal(mine.numpy(), theirs)


def test_infos_as_a_list():
    envs = wrappers.DictInfoToList(make())
    _, infos = envs.reset(seed=0)
    assert len(infos) == 4
    assert infos[0]["collision"] is np.False_ or not infos[0]["collision"]
    *_, infos = envs.step(actions()[0])
    assert set(infos[0]) >= {"effort", "obstacle", "goal", "cost", "clearance", "is_success"}


def test_recorded_video_shows_all_sub_environments(tmp_path):
    pytest.importorskip("pygame")
    pytest.importorskip("moviepy")
    reader = pytest.importorskip("imageio_ffmpeg")
    envs = wrappers.RecordVideo(
        make(render_mode="rgb_array", scenario="family:easy"),
        str(tmp_path / "films"),
        episode_trigger=lambda _: True,
        video_length=6,
        disable_logger=True,
    )
    envs.reset(seed=0)
    for a in actions(4, 8):
        envs.step(a)
    envs.close()
    (film,) = (tmp_path / "films").glob("*.mp4")
    frames = reader.read_frames(str(film))
    size = next(frames)["size"]
    assert sum(1 for _ in frames) in (6, 7)  # with or without the first, by version
    pictures = make(render_mode="rgb_array", scenario="family:easy")
    pictures.reset(seed=0)
    height, width, _ = pictures.render()[0].shape
    assert size[0] >= width
    assert size[1] >= height
    assert pictures.unwrapped.render_tiled().ndim == 3


def test_rendering_needs_a_mode_and_a_reset():
    pytest.importorskip("pygame")
    with pytest.raises(ValueError, match=r"unknown render_mode 'rgb'; allowed are None and"):
        make(render_mode="rgb")
    with pytest.raises(ValueError, match="num_envs must be at most 64 for it, not 65"):
        make(65, render_mode="rgb_array")
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) before render"):
        make(render_mode="rgb_array").unwrapped.render()
    with pytest.warns(UserWarning, match="without a render_mode does nothing"):
        assert make().unwrapped.render() is None


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_go_on_alike_and_draw(duplicate):
    pytest.importorskip("pygame")
    env = gym.make(ENV_ID, render_mode="rgb_array").unwrapped
    for each in (env, make(render_mode="rgb_array").unwrapped):
        each.reset(seed=0)
        each.render()
        again = duplicate(each)
        action = np.full(each.action_space.shape, 0.5, dtype=np.float32)
        for _ in range(3):
            mine, theirs = each.step(action), again.step(action)
        np.testing.assert_array_equal(mine[0], theirs[0])
        np.testing.assert_array_equal(each.render(), again.render())
    scenario = duplicate(SHORT)
    assert scenario == SHORT
    with pytest.raises(ValueError, match="read-only"):
        scenario.obstacles[0, 0] = 1.0

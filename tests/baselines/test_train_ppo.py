"""Training: repeatable and resumable to the bit, polite to its caller, and it learns."""

import dataclasses
import itertools
import random
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch

from slipcar.baselines import PPOConfig, load_policy, score, train_ppo
from slipcar.baselines.files import write_atomically
from slipcar.baselines.learner import make_learner
from slipcar.baselines.session import training_session
from slipcar.baselines.validation import validation_worlds
from slipcar.envs import Family, Scenario

PAPER = Scenario.named("paper")
COARSE = PAPER.replace(nodes=11)  # ten steps an episode
TINY = PPOConfig(
    total_steps=12 * 8 * 10,
    environments=8,
    minibatches=2,
    epochs=2,
    hidden=(8, 8),
    evaluate_every=2,
    validation_episodes=4,
    checkpoint_every=3,
)


class PowerCutError(Exception):
    pass


def stop_at(iteration, error=PowerCutError):
    def callback(progress):
        if progress.iteration == iteration:
            raise error

    return callback


def train(folder=None, config=TINY, **options):
    return train_ppo(COARSE, config, folder=folder, progress=False, **options)


def same(a, b):
    arrays = zip(
        (*a.weights, *a.biases, a.log_std), (*b.weights, *b.biases, b.log_std), strict=True
    )
    return all(np.array_equal(x, y) for x, y in arrays)


def untimed(record):
    """A training record without what differs from run to run: seconds."""
    if isinstance(record, dict):
        return {k: untimed(v) for k, v in record.items() if not k.endswith("seconds")}
    return [untimed(v) for v in record] if isinstance(record, list) else record


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    train(folder)
    return folder


@pytest.mark.parametrize("cuts", [[7], [3], [2, 5, 8], [12]])
def test_a_resumed_run_is_bit_identical(uninterrupted, tmp_path, cuts):
    for cut in cuts:
        with pytest.raises(PowerCutError):
            train(tmp_path, callback=stop_at(cut))
        torch.rand(3), np.random.rand(3)  # noqa: NPY002  a new process has other random states
    best = train(tmp_path)
    for name in ("policy", "last"):
        assert same(load_policy(tmp_path / name), load_policy(uninterrupted / name))
    assert same(best, load_policy(tmp_path / "policy"))
    record, whole = untimed(best.training), untimed(load_policy(uninterrupted).training)
    assert record == whole
    assert [entry["steps"] for entry in record["history"]] == [160 * i for i in range(1, 7)]


def test_resuming_skips_what_is_done(tmp_path):
    seen = []
    with pytest.raises(PowerCutError):
        train(tmp_path, callback=stop_at(7))
    train(tmp_path, callback=lambda progress: seen.append(progress.iteration))
    assert seen == [7, 8, 9, 10, 11, 12]  # the checkpoint stood at 6
    again = train(tmp_path, callback=lambda progress: seen.append("more"))
    assert "more" not in seen
    assert same(again, load_policy(tmp_path / "policy"))


def test_the_folder_does_not_change_the_result(uninterrupted):
    assert same(train(), load_policy(uninterrupted))


def test_seeds_differ(uninterrupted):
    assert not same(train(seed=1), load_policy(uninterrupted))


def test_keyboard_interrupt_says_where_the_checkpoint_is(tmp_path):
    with pytest.raises(KeyboardInterrupt, match=r"after 400 of 960 steps.*stands at 240"):
        train(tmp_path, callback=stop_at(5, KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt, match="nothing was kept"):
        train(None, callback=stop_at(1, KeyboardInterrupt))


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        (
            {"config": dataclasses.replace(TINY, learning_rate=0.5)},
            "learning_rate is 0.001, not 0.5",
        ),
        ({"config": dataclasses.replace(TINY, hidden=(9,))}, r"hidden is \[8, 8\], not \[9\]"),
        ({"seed": 5}, "seed is 0, not 5"),
        ({"scenario": COARSE.replace(clearance=0.2)}, "scenario.clearance is 0.13, not 0.2"),
    ],
)
def test_another_run_in_the_folder_is_refused(uninterrupted, options, difference):
    before = (uninterrupted / "checkpoint.safetensors").read_bytes()
    arguments = {"scenario": COARSE, "config": TINY, **options}
    with pytest.raises(ValueError, match=f"checkpoint of another run: .*{difference}"):
        train_ppo(**arguments, folder=uninterrupted, progress=False)
    assert (uninterrupted / "checkpoint.safetensors").read_bytes() == before


def test_starting_over_forgets_the_other_run(uninterrupted, tmp_path):
    with pytest.raises(PowerCutError):
        train(tmp_path, seed=9, callback=stop_at(7))
    with pytest.raises(PowerCutError):  # before the new run has a checkpoint of its own
        train(tmp_path, resume=False, callback=stop_at(1))
    assert same(train(tmp_path), load_policy(uninterrupted))
    assert same(train(tmp_path, resume=False), load_policy(uninterrupted))


def test_training_time_adds_up_over_sessions(tmp_path):
    seconds = []

    def callback(progress):
        seconds.append(progress.seconds)
        if len(seconds) == 3:
            raise PowerCutError

    with pytest.raises(PowerCutError):
        train(tmp_path, callback=callback)
    policy = train(tmp_path, callback=callback)
    assert seconds == sorted(seconds)
    assert policy.preparation_time >= round(seconds[-1], 1)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_checkpoint(tmp_path, share):
    with pytest.raises(PowerCutError):
        train(tmp_path, callback=stop_at(3))
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(ValueError, match=r"checkpoint.safetensors is truncated or corrupt"):
        train(tmp_path)


def test_a_checkpoint_without_its_description(tmp_path):
    with pytest.raises(PowerCutError):
        train(tmp_path, callback=stop_at(3))
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(ValueError, match=r"run.json is missing or corrupt"):
        train(tmp_path)


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def full_disk(self, content):
        self.open("wb").close()
        raise OSError("no space left")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OSError, match="no space"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_best_policy_is_the_one_with_the_lowest_validation_cost(tmp_path):
    seen = []
    best = train(tmp_path, callback=lambda progress: seen.append(progress.validation))
    totals = [validation.total for validation in seen if validation is not None]
    assert best.training["validation"]["total"] == min(totals)
    found = score(best, COARSE, TINY.validation_episodes, best.training["validation_seed"])
    assert found.total == pytest.approx(min(totals), rel=1e-12)
    assert load_policy(tmp_path / "last").training["validation"]["total"] == totals[-1]


def test_progress_counts_up_and_tensorboard_is_written(tmp_path):
    seen = []
    train(tmp_path, callback=seen.append)
    assert [p.steps for p in seen] == [80 * i for i in range(1, 13)]
    assert {p.total_steps for p in seen} == {960}
    assert all(a.seconds < b.seconds for a, b in itertools.pairwise(seen))
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    tags = events.Tags()["scalars"]
    assert {"validation/total", "rollout/ep_rew_mean", "train/value_loss"} <= set(tags)
    assert [e.step for e in events.Scalars("validation/total")] == [160 * i for i in range(1, 7)]


def test_the_callers_threads_and_random_states_are_put_back():
    torch.manual_seed(1), np.random.seed(1), random.seed(1)  # noqa: NPY002
    wanted = torch.rand(2), np.random.rand(2), random.random()  # noqa: NPY002
    torch.manual_seed(1), np.random.seed(1), random.seed(1)  # noqa: NPY002
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        train(callback=lambda progress: torch.get_num_threads() == 1 or pytest.fail("threads"))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    got = torch.rand(2), np.random.rand(2), random.random()  # noqa: NPY002
    assert torch.equal(got[0], wanted[0])
    np.testing.assert_array_equal(got[1], wanted[1])
    assert got[2] == wanted[2]


def test_other_scenarios_train_too(tmp_path):
    world = Scenario.random(seed=3, obstacles=2).replace(nodes=13, control_bounds=(1.0, 3.0))
    config = dataclasses.replace(TINY, total_steps=200)
    policy = train_ppo(world, config, folder=tmp_path, progress=False)
    assert policy.scenario == load_policy(tmp_path).scenario == world


FAMILY = Family.named("easy").replace(base=Scenario.named("open").replace(nodes=11))
FAMILIAR = dataclasses.replace(TINY, observation="egocentric", evaluate_every=3)


@pytest.mark.parametrize("slots", [None, 0, 3])
def test_a_family_is_learnt_repeatably_and_resumed_to_the_bit(tmp_path, slots):
    config = dataclasses.replace(FAMILIAR, obstacle_slots=slots)
    whole = train_ppo(FAMILY, config, progress=False)
    with pytest.raises(PowerCutError):
        train_ppo(FAMILY, config, folder=tmp_path, progress=False, callback=stop_at(7))
    resumed = train_ppo(FAMILY, config, folder=tmp_path, progress=False)
    assert same(whole, resumed)
    assert untimed(whole.training) == untimed(resumed.training)
    kept = load_policy(tmp_path)
    assert (kept.trained_on, kept.observation) == (FAMILY, "egocentric")
    assert kept.obstacle_slots == (2 if slots is None else slots)


def test_a_family_is_validated_in_worlds_of_its_own():
    worlds = validation_worlds(FAMILY, 50)
    assert len(set(worlds)) == 50
    assert not set(worlds) & set(FAMILY.held_out())
    policy = train_ppo(FAMILY, FAMILIAR, progress=False)
    found = score(policy, validation_worlds(FAMILY, 4), 4, policy.training["validation_seed"])
    assert found.total == pytest.approx(policy.training["validation"]["total"], rel=1e-12)


def test_another_family_in_the_folder_is_refused(tmp_path):
    train_ppo(FAMILY, FAMILIAR, folder=tmp_path, progress=False)
    other = FAMILY.replace(corridor=0.5)
    with pytest.raises(ValueError, match=r"family.corridor is 1\.2, not 0\.5"):
        train_ppo(other, FAMILIAR, folder=tmp_path, progress=False)


def test_too_few_slots_are_refused_before_training():
    with pytest.raises(ValueError, match="up to 2 obstacles and the observation shows 1"):
        train_ppo(FAMILY, dataclasses.replace(FAMILIAR, obstacle_slots=1), progress=False)


def test_every_rollout_is_one_whole_episode_in_every_environment():
    with training_session():
        learner = make_learner(COARSE, TINY, seed=0)
        learner.learn(2 * learner.n_envs * learner.n_steps)
    starts = learner.rollout_buffer.episode_starts
    assert starts.shape == (10, 8)
    assert starts[0].all()
    assert not starts[1:].any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        ({"scenario": PAPER.replace(control_bounds=None)}, "control_bounds is None"),
        ({"seed": -1}, "seed must be at least 0, not -1"),
        ({"seed": 0.5}, "seed must be an integer"),
    ],
)
def test_bad_arguments(options, message):
    with pytest.raises(ValueError, match=message):
        train_ppo(**{"scenario": "paper", "config": TINY, "progress": False, **options})


def test_it_learns():
    """300 k steps, some seconds: from standing still (1384) to parking at the goal."""
    standing = score(_Standing(), PAPER, 64, seed=7).total
    config = PPOConfig(total_steps=300_000)
    found = score(train_ppo(PAPER, config, progress=False), PAPER, 2000, seed=7)
    assert standing == pytest.approx(1384.0)  # 100 (2.2² + 3²)
    assert found.total < 20.0
    assert found.position_rms < 0.2


class _Standing:
    def predict(self, observation):
        return np.zeros((len(observation), 2)), None

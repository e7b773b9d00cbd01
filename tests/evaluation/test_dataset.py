"""Datasets hold what the environment returns, along the paths of an evaluation."""

import importlib.util
import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from slipcar.baselines import load_policy, straight
from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.evaluation.cli import main
from slipcar.evaluation.commands.inputs import read_controller
from slipcar.evaluation.episodes import record
from slipcar.evaluation.noise import block_noise, block_starts
from slipcar.planner import Feedback, OpenLoop, RecedingHorizon, plan

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

from slipcar.evaluation.dataset import write_dataset  # noqa: E402

EXAMPLE = Path(__file__).parents[2] / "examples" / "behaviour_cloning.py"
ID = "slipcar/paper/feedback-v0"


@pytest.fixture(scope="module")
def teacher():
    return Feedback(plan(Scenario.named("paper")))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    path = tmp_path / "datasets"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(path))
    return path


def replayed(env, scenario, episode, i, seed):
    """What the environment returns when it meets path i of a seed and the stored actions."""
    noise = np.stack(list(block_noise(seed, 0, scenario)))[:, i]
    start = block_starts(seed, 0, scenario)[i]
    seen, info = env.reset(options={"noise": noise, "start": start})
    rows = [(seen, 0.0, False, False, info)]
    rows += [env.step(action) for action in episode.actions]
    return [list(column) for column in zip(*rows, strict=True)]


#: Half of its paths collide, and some of these arrive all the same.
LOOSE = Scenario.named("paper").replace(goal_tolerance=0.4)
NOISY = Scenario.named("paper").replace(
    process_noise=(0.1, 0.0, 0.0, 0.05, 0.0), start_deviation=(0.3, 0.3, 0.1, 0.0, 0.0)
)
DRIVERS = {
    "teacher": lambda world, teacher: teacher,
    "feedback": lambda world, teacher: Feedback(plan(world)),
    "straight": lambda world, teacher: straight(world),
}


@pytest.mark.parametrize(
    ("driver", "world", "observation", "slots", "noise"),
    [
        ("teacher", "paper", "features", 0, 0.0),
        ("straight", LOOSE, "state", 0, 0.1),
        ("feedback", Scenario.random(3, 2, nodes=21), "egocentric", 4, 0.1),
        ("teacher", NOISY, "state", 0, 0.0),
    ],
    ids=["features", "state", "egocentric", "noisy"],
)
def test_stored_episodes_are_what_the_environment_returns(
    driver, world, observation, slots, noise, folder, teacher
):
    scenario = Scenario.of(world)
    written = write_dataset(
        DRIVERS[driver](scenario, teacher),
        world,
        ID,
        12,
        seed=5,
        observation=observation,
        obstacle_slots=slots,
        exploration_noise=noise,
    )
    dataset = minari.load_dataset(ID)
    assert dataset.total_episodes == written.episodes == 12
    assert dataset.total_steps == written.steps == 12 * (scenario.nodes - 1)
    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    assert env.unwrapped.scenario == scenario
    for i, e in enumerate(dataset.iterate_episodes()):
        seen, rewards, terminated, truncated, infos = replayed(env, scenario, e, i, 5)
        assert e.observations.dtype == e.actions.dtype == np.float32
        np.testing.assert_allclose(e.observations, seen, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(e.rewards, rewards[1:], rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(e.terminations, terminated[1:])
        np.testing.assert_array_equal(e.truncations, truncated[1:])
        assert e.terminations.tolist() == [False] * (scenario.nodes - 2) + [True]
        assert set(e.infos) == set(infos[0])
        for name, values in e.infos.items():
            wanted = np.array([info[name] for info in infos])
            assert values.dtype == wanted.dtype
            np.testing.assert_allclose(values, wanted, rtol=1e-9, atol=1e-12, err_msg=name)
        assert all(dataset.observation_space.contains(row) for row in e.observations)
        assert all(dataset.action_space.contains(row) for row in e.actions)


@pytest.mark.parametrize("kind", ["open loop", "feedback", "receding", "ppo"])
def test_returns_are_minus_the_costs_of_an_evaluation(kind, teacher):
    scenario, many = Scenario.named("paper"), 6 if kind == "receding" else 200
    make = {
        "open loop": lambda: OpenLoop(teacher.plan),
        "feedback": lambda: teacher,
        "receding": lambda: RecedingHorizon(scenario),
        "ppo": load_policy,
    }[kind]
    (part,) = record(make(), scenario, many, seed=2)
    measured = evaluate(make(), scenario, many, seed=2).metrics
    np.testing.assert_allclose(part.rewards.sum(axis=1), -measured.total, rtol=1e-12)
    np.testing.assert_array_equal(part.infos["collision"][:, -1], measured.collision)
    np.testing.assert_allclose(part.infos["clearance"][:, -1], measured.clearance)
    np.testing.assert_array_equal(part.infos["cost"].any(axis=1), measured.collision)


def test_an_episode_depends_on_the_seed_and_its_number_alone(teacher):
    options = {"seed": 4, "exploration_noise": 0.1}
    few = next(record(teacher, "paper", 3, **options))
    first, second = record(teacher, "paper", 1030, **options)
    assert (len(first), len(second)) == (1024, 6)
    for name in ("observations", "actions", "rewards"):
        np.testing.assert_array_equal(getattr(few, name), getattr(first, name)[:3])
    # Nor on how many a controller is asked for at once.
    slow = Feedback(teacher.plan)
    slow.rows = 2
    (slowly,) = record(slow, "paper", 7, **options)
    np.testing.assert_array_equal(slowly.actions, first.actions[:7])


def test_exploration_noise_is_normal_and_is_what_was_played(paper, replay):
    still = replay(paper, np.zeros((paper.nodes - 1, 2)))
    part, later = record(still, paper, 2048, exploration_noise=0.2)
    drawn = part.actions.astype(float)
    assert drawn.mean() == pytest.approx(0.0, abs=4 * 0.2 / np.sqrt(drawn.size))
    assert drawn.std() == pytest.approx(0.2, rel=0.02)
    for a, b in itertools.combinations([drawn[:-1, 0, 0], drawn[1:, 0, 0], drawn[:-1, 1, 1]], 2):
        assert abs(np.corrcoef(a, b)[0, 1]) < 4.5 / np.sqrt(len(a))
    controls = part.infos["control"][:, 1:]
    np.testing.assert_allclose(controls, drawn * paper.action_scale)
    effort = paper.dt * (controls**2).sum(axis=-1)
    np.testing.assert_allclose(part.infos["effort"][:, 1:], effort)
    (loud,) = record(still, paper, 100, exploration_noise=2.0)
    assert np.abs(loud.actions).max() == 1.0
    (other,) = record(still, paper, 1024, seed=1, exploration_noise=0.2)
    for unlike in (later, other):
        assert abs(np.corrcoef(unlike.actions.ravel(), drawn.ravel())[0, 1]) < 0.02


def test_metadata_say_how_to_repeat_it(folder, teacher):
    write_dataset(teacher, "paper", ID, 5, seed=9, author="A. Nonymous", exploration_noise=0.05)
    data = json.loads((folder / ID / "data" / "metadata.json").read_text(encoding="utf-8"))
    (again,) = record(
        teacher,
        Scenario.from_dict(data["scenario"]),
        data["total_episodes"],
        data["seed"],
        observation=data["observation"]["kind"],
        exploration_noise=data["exploration_noise"],
    )
    stored = minari.load_dataset(ID)
    for e, rewards in zip(stored.iterate_episodes(), again.rewards, strict=True):
        np.testing.assert_array_equal(e.rewards, rewards)
    returns = again.rewards.sum(axis=1)
    assert data["returns"]["mean"] == pytest.approx(returns.mean())
    assert data["returns"]["min"] == pytest.approx(returns.min())
    assert data["controller"] == f"Feedback:{teacher.fingerprint()}"
    assert data["author"] == ["A. Nonymous"]
    assert data["algorithm_name"] == "Feedback"
    assert data["provenance"]["versions"]["numpy"] == np.__version__


def test_the_environment_is_recovered_where_slipcar_was_never_imported(folder, teacher):
    write_dataset(teacher, Scenario.named("paper").replace(clearance=0.2), ID, 1)
    code = (
        "import minari, sys; assert 'slipcar' not in sys.modules\n"
        f"env = minari.load_dataset({ID!r}).recover_environment()\n"
        "env.reset(seed=0); print(env.unwrapped.scenario.clearance, env.spec.id)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0.2", "slipcar.envs:SlipCar-v0"]


def test_an_interrupted_write_leaves_nothing_and_an_old_dataset_as_it_was(folder, teacher):
    def interrupt(episodes):
        # Half written: Minari sees nothing of it.
        assert list(minari.list_local_datasets()) == before
        raise KeyboardInterrupt

    before = []
    with pytest.raises(KeyboardInterrupt):
        write_dataset(teacher, "paper", ID, 100, progress=interrupt)
    assert [path for path in folder.rglob("*") if path.is_file()] == []
    write_dataset(teacher, "paper", ID, 2)
    before = [ID]
    with pytest.raises(KeyboardInterrupt):
        write_dataset(teacher, "paper", ID, 100, overwrite=True, progress=interrupt)
    assert minari.load_dataset(ID).total_episodes == 2
    write_dataset(teacher, "paper", ID, 3, overwrite=True)
    assert minari.load_dataset(ID).total_episodes == 3
    assert [path.name for path in folder.iterdir()] == ["slipcar"]
    assert minari.namespace.list_local_namespaces() == ["slipcar", "slipcar/paper"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dataset_id": "slipcar/paper"}, "looks like slipcar/paper/scp-v0"),
        ({"dataset_id": "../up-v0"}, "looks like"),
        ({"dataset_id": "a//b-v0"}, "looks like"),
        ({"dataset_id": "taken-v0"}, "exists already"),
        ({"dataset_id": "taken-v0/b-v0"}, "taken-v0 is a dataset"),
        ({"episodes": 0}, "episodes must be at least 1, not 0"),
        ({"seed": -1}, "seed must be at least 0, not -1"),
        ({"exploration_noise": -0.1}, "exploration_noise must be finite and >= 0"),
        ({"exploration_noise": float("nan")}, "exploration_noise must be finite"),
        ({"observation": "pixels"}, "unknown observation 'pixels'"),
        ({"obstacle_slots": 2}, "obstacle_slots=4 or more"),
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        ({"controller": 3}, "a controller is an object with predict"),
    ],
)
def test_bad_requests_name_what_is_wrong_and_write_nothing(changes, message, folder, teacher):
    (folder / "taken-v0" / "data").mkdir(parents=True)
    request = {"controller": teacher, "scenario": "paper", "dataset_id": "new-v0", "episodes": 2}
    with pytest.raises(ValueError, match=message):
        write_dataset(**{**request, **changes})
    assert [path.name for path in folder.iterdir()] == ["taken-v0"]


def test_a_bad_action_is_named(folder, paper):
    class Broken:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.full((len(observation), 2), np.nan), state

    with pytest.raises(ValueError, match="nan for action") as caught:
        write_dataset(Broken(), paper, ID, 2)
    assert caught.value.__notes__ == ["the controller recorded is Broken"]
    assert not any(folder.iterdir())


# ------------------------------------------------------------------ the command line


def test_the_command_line_writes_a_dataset(tmp_path, capsys, monkeypatch):
    where = tmp_path / "here"
    arguments = ["dataset", "planned-feedback", "--id", "mine/gap-v2", "--folder", str(where)]
    options = ["--scenario", "gap", "--episodes", "5", "--seed", "3", "--observation", "state"]
    assert main([*arguments, *options]) == 0
    printed = capsys.readouterr().out
    assert "5 episodes, 200 steps" in printed
    assert f"MINARI_DATASETS_PATH={where}" in printed
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(where))
    dataset = minari.load_dataset("mine/gap-v2")
    assert dataset.recover_environment().unwrapped.scenario == Scenario.named("gap")
    gap = Scenario.named("gap")
    cost = evaluate(Feedback(plan(gap, feedback=True)), gap, 5, seed=3).metrics.total
    returns = [e.rewards.sum() for e in dataset.iterate_episodes()]
    np.testing.assert_allclose(returns, -cost, rtol=1e-9)
    assert main([*arguments, *options]) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert main([*arguments, *options, "--overwrite"]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["uber", "--id", "a-v0"], "unknown controller 'uber'"),
        (["scp", "--id", "a"], "looks like slipcar/paper/scp-v0"),
        (["scp", "--id", "a-v0", "--episodes", "0"], "episodes must be at least 1"),
        (["scp", "--id", "a-v0", "--observation", "pixels"], "unknown observation 'pixels'"),
        (["scp"], "--id"),
    ],
)
def test_bad_words_are_exit_code_2(arguments, message, capsys, folder):
    assert main(["dataset", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not folder.exists()


def test_without_minari_the_error_names_the_extra(capsys, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    monkeypatch.setitem(sys.modules, "minari.data_collector", None)
    assert main(["dataset", "scp", "--id", "a-v0"]) == 2
    assert "pip install 'minari[hdf5]>=" in capsys.readouterr().err


def test_words_for_controllers(tmp_path, monkeypatch):
    world = Scenario.named("open")
    driver, driven = read_controller("receding", world)
    assert isinstance(driver, RecedingHorizon)
    assert driven == world
    # A folder of that name does not take the word's place.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scp").mkdir()
    assert type(read_controller("scp", world)[0]) is OpenLoop


# ------------------------------------------------------------------ learning from it


def test_a_network_learns_from_a_dataset(folder, teacher):
    torch = pytest.importorskip("torch")
    spec = importlib.util.spec_from_file_location("behaviour_cloning", EXAMPLE)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    paper = Scenario.named("paper")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            net = example.network()
            untrained = evaluate(example.policy(net, paper), paper, 1000, seed=1)
            write_dataset(teacher, paper, ID, 200, exploration_noise=0.1)
            error = example.clone(net, minari.load_dataset(ID), epochs=30)
    finally:
        torch.set_num_threads(threads)
    assert error < 0.015  # of which 0.01 is the noise on the teacher's actions
    cloned = evaluate(example.policy(net, paper), paper, 1000, seed=1)
    blind = evaluate(OpenLoop(teacher.plan), paper, 1000, seed=1)
    assert cloned.total < 0.01 * untrained.total
    assert cloned.total < 0.9 * blind.total
    assert cloned.position_rms < 0.75 * blind.position_rms


def test_numpy_scalars_are_numbers_in_the_metadata(folder, teacher):
    numbers = {"episodes": np.int64(2), "seed": np.uint8(3), "obstacle_slots": np.int64(4)}
    write_dataset(teacher, "paper", ID, **numbers, exploration_noise=np.float32(0.5))
    stored = minari.load_dataset(ID).storage.metadata
    assert (stored["seed"], stored["exploration_noise"]) == (3, 0.5)
    assert stored["total_episodes"] == 2

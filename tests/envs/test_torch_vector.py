"""The fleet of tensors: the NumPy fleet's numbers, episodes, worlds and chance."""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from slipcar.envs import Family, Scenario, SlipCarVectorEnv

torch = pytest.importorskip("torch")

from slipcar.envs.torch_vector import SlipCarTorchEnv  # noqa: E402
from slipcar.envs.torch_worlds import TensorWorlds  # noqa: E402

SHORT = Scenario.named("paper").replace(nodes=6, goal_tolerance=(5.0, 5.0, 10.0, 4.0, 8.0))
NOISY = SHORT.replace(process_noise=(0.0, 0.1, 0.0, 0.2, 0.0))
FAMILY = Family(obstacles=(1, 5), slip=(0.05, 0.3), horizon=(1.0, 3.0), base=SHORT)
CPU = torch.device("cpu")


def actions_for(cars, steps, seed=0):
    return np.random.default_rng(seed).uniform(-1.3, 1.3, (steps, cars, 2)).astype(np.float32)


def same(ours, theirs, tolerance):
    assert isinstance(ours, torch.Tensor)
    theirs = np.stack(list(theirs)) if theirs.dtype == object else theirs
    assert ours.shape == theirs.shape
    assert (ours.dtype == torch.bool) == (theirs.dtype == np.bool_)
    np.testing.assert_allclose(ours.numpy(), theirs, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-10), ("float32", 1e-4)])
@pytest.mark.parametrize(
    ("source", "kind", "slots", "substeps"),
    [
        (SHORT, "features", None, 1),
        (NOISY, "egocentric", 4, 2),
        (SHORT.replace(obstacles=[]), "state", 1, 1),
        (FAMILY, "features", None, 1),
        (FAMILY, "egocentric", 7, 2),
    ],
)
def test_steps_are_the_numpy_fleets(source, kind, slots, substeps, dtype, tolerance):
    cars, steps = 30, 5
    options = {"observation": kind, "obstacle_slots": slots, "substeps": substeps, "dtype": dtype}
    ours = SlipCarTorchEnv(cars, source, seed=0, **options)
    theirs = SlipCarVectorEnv(cars, source, autoreset_mode="SameStep", **options)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.action_space == theirs.action_space
    shape = (cars, steps, substeps, ours.scenario.noise_dim)
    noise = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    seen, info = ours.reset(options={"noise": noise})
    wanted, known = theirs.reset(options={"noise": noise, "scenario": ours.scenarios})
    for action in actions_for(cars, steps):
        same(seen, wanted, 1e-4)  # both are float32
        assert seen.dtype == torch.float32
        for name, value in info.items():
            same(value, known[name], tolerance)
        seen, reward, over, cut, info = ours.step(torch.from_numpy(action))
        wanted, expected, ended, truncated, known = theirs.step(action)
        same(reward, expected, tolerance)
        same(over, ended, 0)
        same(cut, truncated, 0)
    assert over.all()
    for name in ("final_obs", "_final_obs", "_final_info"):
        same(info[name], known[name], 1e-4)
    for name, value in info["final_info"].items():
        same(value, known["final_info"][name], tolerance)
    assert 0 < info["final_info"]["is_success"].sum() < cars or source is not SHORT
    # The next episode has begun, in worlds of its own.
    wanted, known = theirs.reset(options={"scenario": ours.scenarios})
    same(seen, wanted, 1e-4)
    for name in ("effort", "obstacle", "goal", "cost", "collision", "clearance", "control"):
        same(info[name], known[name], tolerance)


def test_episodes_follow_one_another():
    envs = SlipCarTorchEnv(8, SHORT, dtype="float64")
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    envs.reset(seed=0)
    ends = []
    for _ in range(3):
        total = 0.0
        for k, action in enumerate(actions_for(8, 5, seed=9)):
            states = envs.states
            seen, reward, over, _, info = envs.step(torch.from_numpy(action))
            total = total + reward
            assert bool(over.all()) == bool(over.any()) == (k == 4)
            assert ("final_obs" in info) == (k == 4)
        assert not torch.equal(states, envs.states)
        np.testing.assert_array_equal(envs.states, np.tile(SHORT.start, (8, 1)))
        last = info["final_info"]
        assert (total < -last["goal"]).all()
        assert (last["clearance"] <= info["clearance"]).all()
        ends.append(info["final_obs"])
        assert not torch.equal(seen, ends[-1])
    # The same actions, but noise of its own for each.
    assert not any(torch.equal(ends[0], end) for end in ends[1:])


def test_seeds_decide_everything():
    def run(made_with, reset_with, source=FAMILY):
        envs = SlipCarTorchEnv(5, source, seed=made_with)
        seen = [envs.reset(seed=reset_with)[0]]
        return torch.stack(seen + [envs.step(torch.ones(5, 2))[0] for _ in range(11)])

    first = run(None, 3)
    assert torch.equal(first, run(3, None))
    assert torch.equal(first, run(4, 3))
    assert not torch.equal(first, run(None, 4))
    assert not torch.equal(run(None, None), run(None, None))


def test_worlds_are_the_familys():
    worlds = TensorWorlds(FAMILY, 40, 16, np.random.default_rng(0), CPU, torch.float32)
    luck = torch.Generator().manual_seed(0)
    worlds.choose(luck)
    chosen = worlds.which.tolist()
    assert set(chosen) <= set(range(16))
    assert len(set(chosen)) > 8
    scenarios = worlds.scenarios()
    drawn = FAMILY.draw(worlds.words)
    p = worlds.parameters
    for i, row in enumerate(chosen):
        assert scenarios[i] == FAMILY.world(worlds.words[row])
        assert p.horizon[i].item() == pytest.approx(drawn.horizon[row])
        assert p.dt[i].item() == pytest.approx(drawn.horizon[row] / 5)
        assert [a[i].item() for a in p.goal] == pytest.approx(drawn.goal[row].tolist())
        assert [a[i].item() for a in worlds.start] == pytest.approx(drawn.start[row].tolist())
    worlds.choose(luck)
    assert worlds.which.tolist() != chosen


def test_every_reset_draws_a_new_pool():
    envs = SlipCarTorchEnv(4, FAMILY, seed=0, pool=3)
    envs.reset()
    first = set(envs.scenarios)
    for _ in range(5):
        envs.step(torch.zeros(4, 2))
    assert len(set(envs.scenarios) | first) <= 3
    envs.reset()
    assert not first & set(envs.scenarios)


def test_chance_is_that_of_the_scenario():
    # At v = ω = 1 one interval spreads the pose by √dt (α², α², β²), whatever the substeps.
    cars = 20_000
    scenario = SHORT.replace(
        obstacles=[], start=(0.0, 0.0, 0.0, 1.0, 1.0), process_noise=(0.0, 0.0, 0.0, 0.0, 0.05)
    )
    envs = SlipCarTorchEnv(cars, scenario, seed=0, dtype="float64")
    envs.reset()
    envs.step(torch.zeros(cars, 2))
    wanted = scenario.dt**0.5 * torch.tensor([0.1, 0.1, 0.01, 0.0, 0.05], dtype=torch.float64)
    torch.testing.assert_close(envs.states.std(dim=0), wanted, rtol=0.03, atol=1e-12)
    mean = torch.tensor([scenario.dt, 0.0, scenario.dt, 1.0, 1.0], dtype=torch.float64)
    assert ((envs.states.mean(dim=0) - mean).abs() <= 4.0 * wanted / cars**0.5 + 1e-12).all()
    deviation = np.array([0.1, 0.2, 0.0, 0.3, 0.0])
    seen, _ = envs.reset(options={"scenario": scenario.replace(start_deviation=deviation)})
    np.testing.assert_allclose(envs.states.std(dim=0), deviation, rtol=0.03)
    np.testing.assert_allclose(seen[:, 4], envs.states[:, 3], rtol=1e-6)


def test_unchecked_actions_spoil_their_own_episode_alone():
    envs = SlipCarTorchEnv(3, SHORT, seed=0, check_actions=False)
    envs.reset()
    bad = torch.zeros(3, 2)
    bad[1, 0] = torch.nan
    for _ in range(5):
        seen, reward, *_ = envs.step(bad)
        assert torch.isfinite(reward).tolist() == [True, False, True]
    assert torch.isfinite(seen).all()
    assert torch.isfinite(envs.step(torch.zeros(3, 2))[1]).all()


def test_bad_arguments_are_named():
    for options, message in (
        ({"num_envs": 0}, "num_envs must be at least 1, not 0"),
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        ({"observation": "pixels"}, "unknown observation 'pixels'"),
        ({"obstacle_slots": 2}, "has up to 4 obstacles and the observation shows 2"),
        ({"substeps": 0}, "substeps must be at least 1, not 0"),
        ({"dtype": "int8"}, "unknown dtype 'int8'"),
        ({"device": "cuda:99"}, r"'cuda:99' .* available are \['cpu'"),
        ({"seed": -1}, "seed must be at least 0, not -1"),
        ({"pool": 0}, "pool must be at least 1, not 0"),
        ({"scenario": SHORT.replace(control_bounds=None)}, "control_bounds is None"),
    ):
        with pytest.raises(ValueError, match=message):
            SlipCarTorchEnv(**{"num_envs": 2, **options})


def test_bad_resets_and_actions_are_named():
    envs = SlipCarTorchEnv(2, SHORT)
    for call in (lambda: envs.step(torch.zeros(2, 2)), lambda: envs.states):
        with pytest.raises(ResetNeeded):
            call()
    for options, message in (
        ({"goal": 1}, r"unknown reset options \['goal'\]; known are \['scenario', 'noise'\]"),
        ({"noise": np.zeros((2, 5, 1, 4))}, r"noise must have shape \(2, 5, 1, 3\)"),
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.reset(options=options)
    envs.reset(seed=0)
    before = envs.states
    for action, message in (
        (torch.zeros(3, 2), r"action must have shape \(2, 2\), not \(3, 2\)"),
        ("left", "action must be an array of numbers, not 'left'"),
        (torch.tensor([[0.0, 0.0], [0.0, torch.inf]]), r"action\[1, 1\] is inf"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.step(action)
    assert torch.equal(before, envs.states)


def test_without_torch_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ImportError, match="pip install 'torch>="):
        SlipCarTorchEnv(1)


def test_benchmark_measures_what_it_says(monkeypatch, capsys):
    path = Path(__file__).parents[2] / "benchmarks" / "torch_speed.py"
    threads = torch.get_num_threads()
    arguments = ["--paths", "20", "--seconds", "0", "--eager"]
    monkeypatch.setattr(sys, "argv", ["torch_speed.py", *arguments])
    runpy.run_path(str(path), run_name="__main__")
    torch.set_num_threads(threads)
    found = json.loads(capsys.readouterr().out)
    assert found["paths"] == 20
    assert found["torch"] == torch.__version__
    whats = [row["what"] for row in found["rows"]]
    assert "SlipCarTorchEnv, family:random, 44 features" in whats
    assert len(set(whats)) == len(whats) == 4
    assert all(row["steps/s"] > 0 for row in found["rows"])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("source", [NOISY, FAMILY])
def test_on_a_gpu_steps_are_the_same_and_wait_for_nothing(source):
    # With one world in the pool and given noise, nothing is left to the device's own chance.
    options = {"dtype": "float64", "seed": 0, "pool": 1}
    theirs = SlipCarTorchEnv(30, source, device="cuda", **options)
    ours = SlipCarTorchEnv(30, source, **options)
    noise = np.random.default_rng(1).normal(size=(30, 5, 1, ours.scenario.noise_dim))
    for envs in (ours, theirs):
        envs.reset(options={"noise": noise})
    actions = torch.from_numpy(actions_for(30, 7))
    there = actions.cuda()
    torch.cuda.synchronize()
    before = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("error")
    try:
        found = [theirs.step(action) for action in there]
    finally:
        torch.cuda.set_sync_debug_mode(before)
    for action, other in zip(actions[:5], found, strict=False):
        for a, b in zip(ours.step(action)[:3], other, strict=False):
            torch.testing.assert_close(a, b.cpu(), rtol=1e-6, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("source", [NOISY, FAMILY])
def test_compiled_steps_are_the_same(source):
    options = {"scenario": source, "observation": "egocentric", "obstacle_slots": 5, "seed": 0}
    try:
        fast = SlipCarTorchEnv(50, compile=True, **options)
    except RuntimeError as error:
        pytest.skip(str(error))
    slow = SlipCarTorchEnv(50, **options)
    assert torch.equal(fast.reset()[0], slow.reset()[0])
    for action in actions_for(50, 12):
        ours, theirs = (envs.step(torch.from_numpy(action)) for envs in (fast, slow))
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
        for name in ("effort", "obstacle", "cost", "clearance", "control"):
            torch.testing.assert_close(ours[4][name], theirs[4][name], rtol=1e-4, atol=1e-4)


def test_what_is_handed_out_is_the_callers_own():
    envs, plain = (SlipCarTorchEnv(3, SHORT, seed=0) for _ in range(2))
    for each in (envs, plain):
        each.reset(seed=0)
    for action in torch.from_numpy(actions_for(3, 4)):
        observation, reward, _, _, info = envs.step(action)
        expected = plain.step(action)[4]
        torch.testing.assert_close(info["clearance"], expected["clearance"])
        for tensor in (observation, reward, *info.values()):
            if isinstance(tensor, torch.Tensor) and tensor.is_floating_point():
                tensor.fill_(-7.0)

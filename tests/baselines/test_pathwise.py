"""Pathwise gradients: right against differences, repeatable to the bit, and they learn."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from slipcar.baselines import PathwiseConfig, load_policy, score, train_pathwise
from slipcar.baselines.network import make_network, policy_of
from slipcar.baselines.pathwise_training import expected_cost
from slipcar.envs import Family, Scenario
from slipcar.envs.observation import Layout
from slipcar.envs.torch_worlds import TensorWorlds

COARSE = Scenario.named("paper").replace(nodes=11)
FAMILY = Family.named("easy").replace(base=Scenario.named("open").replace(nodes=11))
TINY = PathwiseConfig(
    iterations=6, paths=8, hidden=(8,), evaluate_every=2, validation_episodes=4, warm_up=2
)


def parts(source, layout, paths=16, dtype=torch.float64):
    """A network, worlds and noise of its own kind of number."""
    generator = torch.Generator().manual_seed(3)
    network = make_network((layout.size, 16, 2), generator).to(dtype)
    with torch.no_grad():  # the last layer starts near zero, where the car hardly moves
        network[-1].weight.mul_(30.0)
    rng = np.random.default_rng(5)
    worlds = TensorWorlds(source, paths, paths, rng, torch.device("cpu"), dtype)
    worlds.choose(generator)
    noise = torch.randn((10, 1, 3, paths), generator=generator, dtype=dtype)
    return network, worlds, noise


@pytest.mark.parametrize(
    ("source", "layout"), [(COARSE, Layout("features", 0)), (FAMILY, Layout("egocentric", 2))]
)
def test_the_gradient_is_the_slope_of_the_mean_cost(source, layout):
    network, worlds, noise = parts(source, layout)
    expected_cost(network, layout, worlds, noise).backward()
    parameters = list(network.parameters())
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        ways = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in parameters]
        slope = sum((p.grad * way).sum().item() for p, way in zip(parameters, ways, strict=True))
        ends = []
        h = 1e-6
        for sign in (1.0, -1.0):
            with torch.no_grad():
                for p, way in zip(parameters, ways, strict=True):
                    p.add_(sign * h * way)
                ends.append(expected_cost(network, layout, worlds, noise).item())
                for p, way in zip(parameters, ways, strict=True):
                    p.sub_(sign * h * way)
        assert (ends[0] - ends[1]) / (2.0 * h) == pytest.approx(slope, rel=1e-4)


def test_its_cost_is_the_environments():
    """The mean of other paths through the simulation of `score`: no two definitions."""
    layout = Layout("features", 0)
    network, worlds, noise = parts(COARSE, layout, paths=20_000, dtype=torch.float32)
    with torch.no_grad():
        ours = expected_cost(network, layout, worlds, noise).item()
    theirs = score(policy_of(network, COARSE, layout), COARSE, 20_000, seed=1)
    assert ours == pytest.approx(theirs.total, abs=6.0 * theirs.total_error)


@pytest.mark.parametrize("source", [COARSE, FAMILY])
def test_training_is_repeatable_and_kept(source, tmp_path):
    kind = "features" if source is COARSE else "egocentric"
    config = dataclasses.replace(TINY, observation=kind)
    runs = [
        train_pathwise(source, config, seed=seed, folder=tmp_path, progress=False)
        for seed in (1, 0, 0)
    ]
    assert runs[1].fingerprint() == runs[2].fingerprint() != runs[0].fingerprint()
    kept = load_policy(tmp_path)
    assert kept.fingerprint() == runs[2].fingerprint()
    assert (kept.trained_on, kept.layout) == (source, runs[2].layout)
    history = kept.training["history"]
    assert [entry["steps"] for entry in history] == [160, 320, 480]
    assert kept.training["validation"]["total"] == min(entry["total"] for entry in history)


def test_it_goes_on_from_another_policy():
    first = train_pathwise(COARSE, TINY, progress=False)
    options = {"seed": 1, "initial": first, "progress": False}
    more = train_pathwise(COARSE, dataclasses.replace(TINY, learning_rate=1e-9), **options)
    assert [entry["steps"] for entry in more.training["history"]][:2] == [480, 640]
    for a, b in zip(more.weights, first.weights, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    assert more.preparation_time >= first.preparation_time
    with pytest.raises(ValueError, match=r"layers \(12, 8, 2\).*\(12, 9, 2\)"):
        train_pathwise(COARSE, dataclasses.replace(TINY, hidden=(9,)), **options)


def test_it_learns():
    """150 gradients, some seconds: from standing still (1384) to about the goal."""
    config = PathwiseConfig(iterations=150, paths=256, validation_episodes=256)
    policy = train_pathwise(COARSE, config, progress=False)
    found = score(policy, COARSE, 1000, seed=7)
    assert found.total < 60.0
    assert found.position_rms < 0.5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenario": "moon"}, "unknown scenario 'moon'"),
        ({"scenario": COARSE.replace(control_bounds=None)}, "control_bounds is None"),
        ({"scenario": "uncertain"}, "needs a certain start"),
        ({"seed": -1}, "seed must be at least 0"),
    ],
)
def test_bad_arguments(options, message):
    with pytest.raises(ValueError, match=message):
        train_pathwise(**{"scenario": "paper", "config": TINY, "progress": False, **options})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"paths": 0}, "paths must be an integer >= 1, not 0"),
        ({"learning_rate": float("nan")}, "learning_rate must be finite and > 0"),
        ({"hidden": (8, 0)}, r"hidden\[1\] must be an integer >= 1"),
        ({"observation": "radar"}, "unknown observation 'radar'"),
        ({"obstacle_slots": -1}, "obstacle_slots must be at least 0"),
    ],
)
def test_bad_configurations(changes, message):
    with pytest.raises(ValueError, match=message):
        PathwiseConfig(**changes)

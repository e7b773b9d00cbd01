"""Policies as ONNX and TorchScript: they are given time and state, and answer as the original."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from slipcar import baselines  # noqa: E402
from slipcar.baselines import Policy, deployment  # noqa: E402
from slipcar.baselines.deployment import export_policy  # noqa: E402
from slipcar.envs import Scenario  # noqa: E402
from slipcar.envs.observation import KINDS, Layout, observe  # noqa: E402

CASES = [("ppo", "paper", None), ("pathwise", "random", "slalom"), ("ppo", "random", "open")]


def loaded(path):
    """The file as a function of arrays, by a runtime that knows nothing of slipcar."""
    if path.suffix == ".pt":
        module = torch.jit.load(str(path))
        return lambda t, x: module(torch.from_numpy(t), torch.from_numpy(x)).numpy()
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return lambda t, x: session.run(None, {"t": t, "x": x})[0]


def states(world, count, seed=3):
    rng = np.random.default_rng(seed)
    return world.horizon * rng.random(count), world.goal * rng.random((count, 5)) + 0.5 * (
        rng.standard_normal((count, 5))
    )


@pytest.mark.parametrize("target", ["onnx", "torchscript"])
@pytest.mark.parametrize(("method", "family", "name"), CASES)
@pytest.mark.parametrize("float32", [False, True])
def test_it_answers_as_the_original(target, method, family, name, float32, tmp_path):
    if target == "onnx":
        pytest.importorskip("onnx")
    policy = baselines.shipped_runs(method, family)[0]
    world = None if name is None else Scenario.named(name)
    path = tmp_path / f"policy{deployment.TARGETS[target]}"
    export_policy(policy, path, target, world, float32=float32)
    world, real = world or policy.scenario, np.float32 if float32 else np.float64
    run = loaded(path)
    for count in (1, 500):  # batches of any size, whatever it was exported with
        t, x = (a.astype(real) for a in states(world, count))
        wide = t.astype(float), x.astype(float)
        seen = observe(world, policy.observation, *wide, policy.obstacle_slots)
        expected = policy.predict(seen)[0] * world.action_scale
        got = run(t, x)
        assert got.dtype == real
        np.testing.assert_allclose(got, expected, atol=1e-4 if float32 else 1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("slots", [0, 3, 9])
def test_every_kind_of_observation_is_computed_inside(kind, slots, tmp_path):
    """Also with more slots than there are obstacles."""
    rng, world = np.random.default_rng(1), Scenario.named("paper")
    size = Layout(kind, slots).size
    shapes = ((16, size), (2, 16))
    policy = Policy(
        weights=tuple(rng.standard_normal(shape) / 4 for shape in shapes),
        biases=tuple(rng.standard_normal(shape[0]) / 4 for shape in shapes),
        log_std=np.zeros(2), trained_on=world, observation=kind, obstacle_slots=slots,
    )  # fmt: skip
    path = tmp_path / "policy.pt"
    assert export_policy(policy, path, "torchscript") < 1e-6
    t, x = states(world, 50)
    expected = policy.predict(observe(world, kind, t, x, slots))[0] * world.action_scale
    np.testing.assert_allclose(loaded(path)(t, x), expected, atol=1e-6)


def test_the_file_says_what_it_is(tmp_path):
    onnx = pytest.importorskip("onnx")
    policy = baselines.load_policy()
    path = tmp_path / "p.onnx"
    export_policy(policy, path, "onnx")
    model = onnx.load(path)
    about = json.loads({p.key: p.value for p in model.metadata_props}["slipcar"])
    assert Scenario.from_dict(about["scenario"]) == policy.scenario
    assert about["fingerprint"] == policy.fingerprint()
    sizes = {tensor.name: len(tensor.type.tensor_type.shape.dim) for tensor in model.graph.input}
    assert sizes == {"t": 1, "x": 2}


def test_what_cannot_be_exported_says_why(tmp_path):
    policy = baselines.load_policy()
    with pytest.raises(ValueError, match="unknown target 'c'"):
        export_policy(policy, tmp_path / "p", "c")
    with pytest.raises(ValueError, match="family of worlds"):
        export_policy(baselines.shipped_runs("ppo", "random")[0], tmp_path / "p.pt", "torchscript")
    for bad in (tmp_path, tmp_path / "nowhere" / "p.pt"):
        with pytest.raises(OSError, match="must be a file in a folder that is there"):
            export_policy(policy, bad, "torchscript")
    free = policy.scenario.replace(control_bounds=None)
    with pytest.raises(ValueError, match="control_bounds is None"):
        export_policy(policy, tmp_path / "p.pt", "torchscript", free)
    with pytest.raises(ValueError, match="unknown observation 'pixels'"):
        Policy(policy.weights, policy.biases, policy.log_std, policy.scenario, observation="pixels")


def test_a_file_that_answers_otherwise_is_not_passed_off(tmp_path, monkeypatch):
    policy = baselines.load_policy()
    monkeypatch.setattr(deployment, "TOLERANCE", {False: 0.0})
    with pytest.raises(ValueError, match="would differ from the policy"):
        export_policy(policy, tmp_path / "p.pt", "torchscript")
    assert not list(tmp_path.iterdir())

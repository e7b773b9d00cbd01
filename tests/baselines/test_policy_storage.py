"""Policies on disk: exact round trips, and every way a file can be wrong."""

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
import safetensors.numpy

from slipcar.baselines import Policy, load_policy, save_policy
from slipcar.envs import Family, Scenario
from slipcar.envs.observation import Layout

SCENARIO = Scenario.random(seed=4, obstacles=3)


def make(seed=0, width=5):
    rng = np.random.default_rng(seed)
    return Policy(
        weights=(rng.standard_normal((width, 12)), rng.standard_normal((2, width))),
        biases=(rng.standard_normal(width), rng.standard_normal(2)),
        log_std=rng.standard_normal(2),
        trained_on=SCENARIO,
        training={"seconds": 3.5, "config": {"gamma": 1.0}, "seed": seed},
    )


@pytest.fixture
def stem(tmp_path):
    return save_policy(make(), tmp_path / "lr0.001")


def edit_json(stem, change):
    path = stem.with_name(stem.name + ".json")
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def edit_tensors(stem, change):
    path = stem.with_name(stem.name + ".safetensors")
    tensors = safetensors.numpy.load_file(path)
    change(tensors)
    safetensors.numpy.save_file(tensors, path)


def test_round_trip_is_exact(stem):
    policy, loaded = make(), load_policy(stem)
    for a, b in zip(
        (*policy.weights, *policy.biases, policy.log_std),
        (*loaded.weights, *loaded.biases, loaded.log_std),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)
    assert loaded.scenario == loaded.trained_on == SCENARIO
    assert loaded.training == policy.training
    assert loaded.preparation_time == 3.5
    assert loaded.fingerprint() == policy.fingerprint()


@pytest.mark.parametrize(
    ("trained_on", "kind", "slots"),
    [
        (SCENARIO, "features", 3),
        (SCENARIO, "state", 0),
        (Family.named("slippery"), "egocentric", 8),
        (Family.named("easy"), "egocentric", 0),
    ],
)
def test_other_observations_and_families_round_trip(tmp_path, trained_on, kind, slots):
    size, rng = Layout(kind, slots).size, np.random.default_rng(2)
    policy = Policy(
        weights=(rng.standard_normal((2, size)),),
        biases=(np.zeros(2),),
        log_std=np.zeros(2),
        trained_on=trained_on,
        observation=kind,
        obstacle_slots=slots,
    )
    loaded = load_policy(save_policy(policy, tmp_path / "a"))
    assert loaded.fingerprint() == policy.fingerprint()
    assert (loaded.trained_on, loaded.layout) == (trained_on, policy.layout)
    observation = rng.standard_normal((5, size))
    np.testing.assert_array_equal(loaded.mean(observation), policy.mean(observation))


def test_a_family_has_no_single_scenario():
    policy = Policy((np.zeros((2, 12)),), (np.zeros(2),), np.zeros(2), Family.named("easy"))
    with pytest.raises(ValueError, match="trained on a family of worlds"):
        policy.scenario  # noqa: B018
    with pytest.raises(ValueError, match="a Scenario or a Family, not 'paper'"):
        Policy((np.zeros((2, 12)),), (np.zeros(2),), np.zeros(2), "paper")


def test_the_ways_to_name_it(tmp_path):
    wanted = make().fingerprint()
    for name in ("a", "b.safetensors", "c.json"):
        stem = save_policy(make(), tmp_path / "deep" / name)
        assert stem.name == name[0]
        for path in (stem, f"{stem}.safetensors", f"{stem}.json"):
            assert load_policy(path).fingerprint() == wanted
    assert save_policy(make(), tmp_path) == tmp_path / "policy"
    assert load_policy(str(tmp_path)).fingerprint() == wanted
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == [
        "policy.json",
        "policy.safetensors",
    ]  # and no temporary ones


def test_a_name_with_a_dot_is_found_again(tmp_path):
    policy = load_policy()
    assert save_policy(policy, tmp_path / "run.v1") == tmp_path / "run.v1"
    assert load_policy(tmp_path / "run.v1").fingerprint() == policy.fingerprint()
    assert sorted(f.name for f in tmp_path.iterdir()) == ["run.v1.json", "run.v1.safetensors"]


def test_what_cannot_be_written_is_named_as_it_was_asked_for(tmp_path):
    (tmp_path / "policy.safetensors").mkdir()
    with pytest.raises(OSError, match=r"policy\.safetensors'$"):
        save_policy(load_policy(), tmp_path / "policy.json")


@pytest.mark.parametrize("suffix", [".safetensors", ".json"])
def test_a_missing_file(stem, suffix):
    stem.with_name(stem.name + suffix).unlink()
    with pytest.raises(FileNotFoundError, match=rf"lr0\.001\{suffix}"):
        load_policy(stem)


@pytest.mark.parametrize("suffix", [".safetensors", ".json"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.7, 0.99])
def test_a_truncated_file(stem, suffix, share):
    path = stem.with_name(stem.name + suffix)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=rf"lr0\.001\{suffix}: .*(truncated|not JSON)"):
        load_policy(stem)


def test_flipped_bits_are_noticed(stem):
    path = stem.with_name(stem.name + ".safetensors")
    content = bytearray(path.read_bytes())
    content[-3] ^= 1  # in the numbers, where safetensors itself cannot see it
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"fingerprint .* different policies"):
        load_policy(stem)


def test_a_pickle_is_refused_and_never_run(stem, tmp_path):
    class Exploit:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    stem.with_name(stem.name + ".safetensors").write_bytes(pickle.dumps(Exploit()))
    with pytest.raises(ValueError, match="not safetensors"):
        load_policy(stem)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("layer.1.bias"), r"missing tensors \['layer.1.bias'\]"),
        (lambda t: t.update(extra=np.zeros(1)), r"unknown tensors \['extra'\]"),
        (
            lambda t: t.update({"layer.0.weight": np.zeros((5, 6), np.float32)}),
            r"'layer.0.weight' must be float32 of shape \(5, 12\), not float32 of shape \(5, 6\)",
        ),
        (lambda t: t.update(log_std=np.zeros(2)), "float32 of shape .2,., not float64"),
        (
            lambda t: t.update(log_std=np.array([0, np.nan], np.float32)),
            "'log_std' holds non-finite",
        ),
        (
            lambda t: t.update({"layer.1.bias": np.array([np.inf, 0], np.float32)}),
            "'layer.1.bias' holds non-finite",
        ),
    ],
)
def test_bad_tensors(stem, change, message):
    edit_tensors(stem, change)
    with pytest.raises(ValueError, match=message):
        load_policy(stem)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format=2), "format 2 is unknown; this version reads 1"),
        (lambda d: d.pop("format"), "format None is unknown"),
        (lambda d: d["observation"].update(kind="state"), "another observation layout"),
        (lambda d: d["observation"]["entries"].reverse(), "another observation layout"),
        (lambda d: d["action"].update(range=[0.0, 1.0]), "another action layout"),
        (lambda d: d["architecture"].update(activation="tanh"), "unknown activation 'tanh'"),
        (lambda d: d["architecture"].update(sizes=[6, 5, 2]), "from 12 observations to 2 actions"),
        (lambda d: d["architecture"].update(sizes=[12, -5, 2]), "positive integers"),
        (lambda d: d["architecture"].update(sizes=[12, 5.0, 2]), "positive integers"),
        (lambda d: d["architecture"].update(sizes="big"), "positive integers"),
        (lambda d: d["architecture"].update(sizes=[12, 5, 5, 2]), r"missing tensors"),
        (lambda d: d.pop("scenario"), "'scenario' is missing"),
        (lambda d: d.update(training=[1]), "'training' is missing or is not a dict"),
        (lambda d: d["scenario"].update(horizon=-1.0), "horizon must be finite and > 0"),
        (lambda d: d.update(fingerprint="0" * 16), "different policies"),
    ],
)
def test_bad_descriptions(stem, change, message):
    edit_json(stem, change)
    with pytest.raises(ValueError, match=message):
        load_policy(stem)


@pytest.mark.parametrize("text", ["[1, 2]", "null", "{", "\xff"])
def test_a_description_that_is_no_object(stem, text):
    stem.with_name(stem.name + ".json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match="JSON"):
        load_policy(stem)


def test_files_of_two_policies_do_not_mix(tmp_path):
    a, b = save_policy(make(0), tmp_path / "a"), save_policy(make(1), tmp_path / "b")
    a.with_suffix(".json").write_bytes(b.with_suffix(".json").read_bytes())
    with pytest.raises(ValueError, match="different policies"):
        load_policy(a)


def test_loading_and_driving_imports_no_torch():
    code = """
import sys, numpy as np
from slipcar.baselines import load_policy, train_ppo, PPOConfig
load_policy().predict(np.zeros(12))
heavy = {"torch", "stable_baselines3", "tensorboard", "pickle5"} & set(sys.modules)
assert not heavy, heavy
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)

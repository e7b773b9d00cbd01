"""Policies on disk: weights as safetensors, everything else as JSON beside them.

    <stem>.safetensors   layer.<i>.weight (out, in), layer.<i>.bias (out,), log_std (2,)
    <stem>.json          format, architecture, observation and action layout, the scenario or
                         family it was trained on, training (configuration, seed, versions,
                         seconds, history), fingerprint

Nothing here can run code: safetensors holds numbers alone, and no pickle is ever read.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from slipcar.baselines.files import write_atomically
from slipcar.baselines.policy import ACTION_DIM, Policy
from slipcar.baselines.shipped import DEFAULT, SUFFIXES, File, shipped_file, shipped_seeds
from slipcar.envs import Family, Scenario
from slipcar.envs.observation import KINDS, LAYOUTS, SLOT, Layout, describe
from slipcar.envs.sources import Source

FORMAT = 1
_ACTION = {
    "entries": ["a_v / bound", "a_omega / bound"],
    "range": [-1.0, 1.0],
}
_ACTIVATION = "relu"


def save_policy(policy: Policy, path: str | Path) -> Path:
    """Write a policy; :func:`load_policy` gives back the same numbers to the bit.

    Args:
        policy: what to write.
        path: a stem (`runs/mine` makes `runs/mine.safetensors` and `runs/mine.json`), either
            of these two files, or an existing folder (the stem is then `policy` inside it).

    Returns:
        The stem.
    """
    stem = _stem(Path(path))
    write_atomically(_beside(stem, ".safetensors"), safetensors.numpy.save(policy_tensors(policy)))
    text = json.dumps(_description(policy), indent=1, ensure_ascii=False) + "\n"
    write_atomically(_beside(stem, ".json"), text.encode())
    return stem


def load_policy(path: str | Path | None = None) -> Policy:
    """Read a policy.

    Args:
        path: as for :func:`save_policy`; None reads the policy shipped with slipcar, PPO of seed 0
            on the paper's scenario. :func:`shipped_runs` has the others.

    Raises:
        FileNotFoundError: if one of the two files is missing.
        ValueError: if one is truncated or corrupt, of another format or observation layout,
            if a tensor is missing, misshapen or not finite, or if the two do not belong
            together; the message names the file and what is wrong.
    """
    if path is None:
        return _read(*(shipped_file(*DEFAULT, suffix) for suffix in SUFFIXES))
    stem = _stem(Path(path))
    return _read(*(_beside(stem, suffix) for suffix in SUFFIXES))


def shipped_runs(method: str = "ppo", world: str = "paper") -> tuple[Policy, ...]:
    """The policies shipped of one method: one training for each seed, seed 0 first.

    Args:
        method: how they were trained; :func:`shipped_methods` lists them.
        world: what they were trained on: `paper`, or `random` (the family of that name).

    Raises:
        ValueError: for a method or a world of which none are shipped, listing those that are.
    """
    return tuple(
        _read(*(shipped_file(world, method, seed, suffix) for suffix in SUFFIXES))
        for seed in shipped_seeds(method, world)
    )


def _read(weights: File, description: File) -> Policy:
    for file, what in ((weights, "weights"), (description, "description")):
        if not file.is_file():
            raise FileNotFoundError(
                f"no {what} at {file}; a policy is two files, .safetensors and .json"
            )
    try:
        data = _read_description(description.read_bytes())
    except ValueError as error:
        raise ValueError(f"{description}: {error}") from error
    layout = _read_layout(data["observation"])
    try:
        tensors = _read_tensors(weights.read_bytes(), data["architecture"]["sizes"])
    except ValueError as error:
        raise ValueError(f"{weights}: {error}") from error
    policy = policy_from_tensors(tensors, _read_source(data), layout, data["training"])
    if policy.fingerprint() != data["fingerprint"]:
        raise ValueError(
            f"{weights} has fingerprint {policy.fingerprint()} but {description} describes "
            f"{data['fingerprint']}: the two files belong to different policies"
        )
    return policy


def _stem(path: Path) -> Path:
    if path.is_dir():
        return path / "policy"
    return path.with_suffix("") if path.suffix in (".safetensors", ".json") else path


def _beside(stem: Path, suffix: str) -> Path:
    # Not with_suffix: a stem may hold dots of its own, such as "lr0.001".
    return stem.with_name(stem.name + suffix)


def policy_tensors(policy: Policy) -> dict[str, np.ndarray]:
    """The policy's numbers under the names they have on disk."""
    tensors = {"log_std": policy.log_std}
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        tensors[f"layer.{i}.weight"], tensors[f"layer.{i}.bias"] = weight, bias
    return tensors


def policy_from_tensors(
    tensors: Mapping[str, np.ndarray],
    trained_on: Source,
    layout: Layout,
    training: Mapping[str, Any] | None = None,
) -> Policy:
    """The inverse of :func:`policy_tensors`.

    Args:
        tensors: by the names they have on disk.
        trained_on: a scenario or a family.
        layout: of the observations.
        training: how it was trained.

    Raises:
        ValueError: for missing, misshapen or non-finite tensors.
    """
    layers = range(sum(name.startswith("layer.") for name in tensors) // 2)
    names = [f"layer.{i}.{kind}" for i in layers for kind in ("weight", "bias")]
    missing = sorted({*names, "log_std"} - set(tensors))
    if missing:
        raise ValueError(f"missing tensors {missing}")
    return Policy(
        weights=tuple(tensors[f"layer.{i}.weight"] for i in layers),
        biases=tuple(tensors[f"layer.{i}.bias"] for i in layers),
        log_std=tensors["log_std"],
        trained_on=trained_on,
        training=training or {},
        observation=layout.kind,
        obstacle_slots=layout.slots,
    )


def _description(policy: Policy) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "fingerprint": policy.fingerprint(),
        "architecture": {"sizes": list(policy.sizes), "activation": _ACTIVATION},
        "observation": describe(policy.observation, policy.obstacle_slots),
        "action": _ACTION,
        **describe_source(policy.trained_on),
        "training": dict(policy.training),
    }


def describe_source(source: Source) -> dict[str, Any]:
    """A scenario or a family as plain data under its own key."""
    key = "family" if isinstance(source, Family) else "scenario"
    return {key: source.to_dict()}


def _read_source(data: Mapping[str, Any]) -> Source:
    if "family" in data:
        return Family.from_dict(data["family"])
    return Scenario.from_json(json.dumps(data["scenario"]))


def _read_layout(described: Mapping[str, Any]) -> Layout:
    """The layout that this is the description of.

    Raises:
        ValueError: if this version has none such.
    """
    kind, entries = described.get("kind"), described.get("entries")
    if kind not in KINDS or not isinstance(entries, list):
        raise ValueError(
            f"the policy was trained with another observation layout: {dict(described)}; "
            f"this version has {list(KINDS)}"
        )
    slots = max(0, len(entries) - len(LAYOUTS[kind])) // len(SLOT)
    if described != describe(kind, slots):
        raise ValueError(
            f"the policy was trained with another observation layout: {dict(described)}; "
            f"this version has {describe(kind, slots)}"
        )
    return Layout(kind, slots)


def _read_description(content: bytes) -> dict[str, Any]:
    try:
        data = json.loads(content)
    except ValueError as error:
        raise ValueError(f"not a policy's description: it is not JSON ({error})") from error
    if not isinstance(data, dict):
        raise ValueError(f"expected a JSON object, not {type(data).__name__}")
    if data.get("format") != FORMAT:
        raise ValueError(
            f"policy format {data.get('format')!r} is unknown; this version reads {FORMAT}"
        )
    expected = {
        "fingerprint": str, "architecture": dict, "observation": dict, "action": dict,
        "family" if "family" in data else "scenario": dict, "training": dict,
    }  # fmt: skip
    for name, kind in expected.items():
        if not isinstance(data.get(name), kind):
            raise ValueError(f"{name!r} is missing or is not a {kind.__name__}")
    if data["action"] != _ACTION:
        raise ValueError(
            f"the policy was trained with another action layout: {data['action']}; "
            f"this version has {_ACTION}"
        )
    size = _read_layout(data["observation"]).size
    activation = data["architecture"].get("activation")
    if activation != _ACTIVATION:
        raise ValueError(f"unknown activation {activation!r}; known is {_ACTIVATION!r}")
    sizes = data["architecture"].get("sizes")
    if (
        not isinstance(sizes, list)
        or len(sizes) < 2
        or not all(type(n) is int and n > 0 for n in sizes)
        or (sizes[0], sizes[-1]) != (size, ACTION_DIM)
    ):
        raise ValueError(
            f"architecture sizes must be positive integers from {size} observations "
            f"to {ACTION_DIM} actions, not {sizes}"
        )
    _read_source(data)
    return data


def _read_tensors(content: bytes, sizes: list[int]) -> dict[str, np.ndarray]:
    try:
        tensors = safetensors.numpy.load(content)
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError) as error:
        raise ValueError(f"truncated or not safetensors ({error})") from error
    shapes: dict[str, tuple[int, ...]] = {"log_std": (ACTION_DIM,)}
    for i, (width, out) in enumerate(itertools.pairwise(sizes)):
        shapes[f"layer.{i}.weight"], shapes[f"layer.{i}.bias"] = (out, width), (out,)
    missing, unknown = sorted(set(shapes) - set(tensors)), sorted(set(tensors) - set(shapes))
    if missing or unknown:
        raise ValueError(f"missing tensors {missing}, unknown tensors {unknown}")
    for name, shape in shapes.items():
        tensor = tensors[name]
        if tensor.shape != shape or tensor.dtype != np.float32:
            raise ValueError(
                f"tensor {name!r} must be float32 of shape {shape}, "
                f"not {tensor.dtype} of shape {tensor.shape}"
            )
        if not np.isfinite(tensor).all():
            raise ValueError(f"tensor {name!r} holds non-finite numbers")
    return tensors

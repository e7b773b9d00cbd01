"""A training run on disk: what it is, and where it stands.

run.json                 scenario or family, configuration, seed, versions: written once
checkpoint.safetensors   network parameters, Adam's moments, the best actor so far;
                         counters and its score in the header, so that one rename of one
                         file moves the run from one consistent state to the next
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from slipcar.baselines.config import PPOConfig
from slipcar.baselines.files import write_atomically
from slipcar.baselines.policy import Policy
from slipcar.baselines.storage import describe_source
from slipcar.envs.sources import Source

FORMAT = 2
_RUN, _CHECKPOINT, _HEADER = "run.json", "checkpoint.safetensors", "slipcar"
_PACKAGES = ("slipcar", "numpy", "gymnasium", "torch", "stable-baselines3", "safetensors")


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Where a run stands after some iterations.

    Attributes:
        iteration: how many are done.
        seconds: training time so far, all sessions together.
        state: what the next iteration starts from; `learner.get_state`.
        best: the actor with the lowest validation cost so far, as tensors; may be empty.
        best_record: when it stood and what it scored, as plain data.
        history: the validation scores so far; see `training.Session`.
        cpu_seconds: of this process's processor time so far, all sessions together.
    """

    iteration: int
    seconds: float
    state: dict[str, np.ndarray]
    best: dict[str, np.ndarray]
    best_record: dict[str, Any]
    history: list[dict[str, Any]]
    cpu_seconds: float


def versions() -> dict[str, str]:
    """Versions of Python and of the installed packages a training result depends on."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def describe_run(
    source: Source, config: PPOConfig, seed: int, initial: Policy | None = None
) -> dict[str, Any]:
    """What a run is, as plain data: equal descriptions give equal weights."""
    return {
        "format": FORMAT,
        **describe_source(source),
        "config": config.to_dict(),
        "seed": seed,
        "initial": None if initial is None else initial.fingerprint(),
    }


def start_run(folder: Path, run: dict[str, Any]) -> None:
    """Make `folder` the place of a new run; a checkpoint in it is deleted."""
    (folder / _CHECKPOINT).unlink(missing_ok=True)
    text = json.dumps({**run, "versions": versions()}, indent=1) + "\n"
    write_atomically(folder / _RUN, text.encode())


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the folder's checkpoint in one step."""
    tensors = dict(checkpoint.state)
    tensors.update({f"best.{name}": array for name, array in checkpoint.best.items()})
    header = {
        "format": FORMAT,
        "iteration": checkpoint.iteration,
        "seconds": checkpoint.seconds,
        "best": checkpoint.best_record,
        "history": checkpoint.history,
        "cpu_seconds": checkpoint.cpu_seconds,
    }
    content = safetensors.numpy.save(tensors, metadata={_HEADER: json.dumps(header)})
    write_atomically(folder / _CHECKPOINT, content)


def read_checkpoint(folder: Path, run: dict[str, Any]) -> Checkpoint | None:
    """The checkpoint to continue from, or None if the folder holds none.

    Args:
        folder: of the run; may be missing.
        run: what is about to be trained, from :func:`describe_run`.

    Raises:
        ValueError: if the folder holds another run, naming what differs, or if a file in it
            is corrupt.
    """
    if not (folder / _CHECKPOINT).is_file():
        return None
    try:
        stored = json.loads((folder / _RUN).read_bytes())
    except (FileNotFoundError, ValueError) as error:
        raise ValueError(
            f"{folder / _RUN} is missing or corrupt ({error}), so it is unknown what the "
            "checkpoint beside it belongs to; choose another folder or resume=False"
        ) from error
    differences = list(_differences(stored, run))
    if differences:
        raise ValueError(
            f"{folder} holds a checkpoint of another run: {'; '.join(differences)}. "
            "Choose another folder, or resume=False to start over in this one"
        )
    return _read(folder / _CHECKPOINT)


def _read(path: Path) -> Checkpoint:
    try:
        with safetensors.safe_open(path, framework="np") as file:
            header = json.loads((file.metadata() or {})[_HEADER])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return Checkpoint(
            iteration=int(header["iteration"]),
            seconds=float(header["seconds"]),
            state={k: v for k, v in tensors.items() if not k.startswith("best.")},
            best={k.removeprefix("best."): v for k, v in tensors.items() if k.startswith("best.")},
            best_record=dict(header["best"]),
            history=list(header["history"]),
            cpu_seconds=float(header["cpu_seconds"]),
        )
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} is truncated or corrupt ({error!r}); resume=False starts over"
        ) from error


def _differences(stored: Any, wanted: Any, name: str = "") -> Any:
    """One line for each leaf of `wanted` that `stored` has otherwise."""
    if isinstance(wanted, dict):
        other = stored if isinstance(stored, dict) else {}
        for key in wanted:
            yield from _differences(other.get(key), wanted[key], f"{name}.{key}" if name else key)
    elif stored != wanted:
        yield f"{name} is {stored}, not {wanted}"

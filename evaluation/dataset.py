"""Episodes of any controller as a Minari dataset, to learn from offline.

    write_dataset(Feedback(plan(scenario)), scenario, "slipcar/paper/feedback-v0", episodes=1000)
    dataset = minari.load_dataset("slipcar/paper/feedback-v0")
    dataset.recover_environment()

What is stored is what `gym.make("slipcar.envs:SlipCar-v0", ...)` would have returned: episode i of
a seed is driven along the Brownian path that :func:`slipcar.evaluation.evaluate` drives it along,
so its return is minus the cost found there. Needs Minari (the extra `data`); format
and names are Minari 0.5's (https://minari.farama.org/content/dataset_standards).
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from slipcar.envs import observation as layouts
from slipcar.envs.extras import install
from slipcar.envs.scenario import Scenario
from slipcar.envs.validate import checked_int
from slipcar.evaluation.cells import controller_fingerprint
from slipcar.evaluation.controller import Controller, controller_name
from slipcar.evaluation.episodes import Episodes, checked_recording, record
from slipcar.evaluation.provenance import provenance
from slipcar.evaluation.rollout import solver_failures

ENVIRONMENT = "slipcar.envs:SlipCar-v0"
#: Episodes written at a time, so that a progress bar moves.
_WRITTEN = 64
#: Minari's own pattern, with the version that it needs and no empty name between slashes.
_ID = re.compile(r"(?:[-\w]+/)*[-\w]+-v\d+", re.ASCII)


@dataclasses.dataclass(frozen=True)
class Written:
    """What :func:`write_dataset` wrote.

    Attributes:
        dataset_id: its name for `minari.load_dataset`.
        path: its folder.
        episodes: how many.
        steps: of all episodes together.
        returns: of each episode, (episodes,).
        collision_rate: share of episodes that touch an obstacle.
        failures: solves behind the controller that failed.
    """

    dataset_id: str
    path: Path
    episodes: int
    steps: int
    returns: np.ndarray
    collision_rate: float
    failures: int


def write_dataset(
    controller: Controller,
    scenario: Scenario | str,
    dataset_id: str,
    episodes: int = 1000,
    seed: int = 0,
    *,
    observation: str = "features",
    obstacle_slots: int = 0,
    exploration_noise: float = 0.0,
    folder: str | Path | None = None,
    overwrite: bool = False,
    algorithm_name: str | None = None,
    author: str | None = None,
    code_permalink: str | None = None,
    description: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Written:
    """Record episodes and store them as a Minari dataset (HDF5).

    The dataset appears when it is complete; an interrupted call leaves nothing behind. The
    metadata hold all that is needed to repeat it: scenario, seed, controller's fingerprint,
    versions, commit.

    Args:
        controller: who drives; see :func:`record`.
        scenario: a scenario or the name of one.
        dataset_id: `namespace/name-v0`, of letters, digits, `_` and `-`; namespaces may be
            nested or absent.
        episodes: how many, >= 1.
        seed: see :func:`record`.
        observation: see :func:`record`.
        obstacle_slots: see :func:`record`.
        exploration_noise: see :func:`record`.
        folder: where Minari keeps datasets; None is MINARI_DATASETS_PATH if set, else
            ~/.minari/datasets.
        overwrite: replace a dataset of this id.
        algorithm_name: what drove, in words; None is the controller's class.
        author: who made it.
        code_permalink: where the code that made it can be read.
        description: of the dataset; None writes one.
        progress: called with the number of episodes stored since the last call.

    Raises:
        ValueError: for a bad argument or id, or a dataset that exists.
        ImportError: if Minari or h5py is missing.
    """
    scenario = Scenario.of(scenario)
    root = check_request(dataset_id, folder, overwrite)
    episodes, seed, exploration_noise = checked_recording(episodes, seed, exploration_noise)
    obstacle_slots = checked_int("obstacle_slots", obstacle_slots, at_least=0)
    parts = record(
        controller,
        scenario,
        episodes,
        seed,
        observation=observation,
        obstacle_slots=obstacle_slots,
        exploration_noise=exploration_noise,
    )
    storage_of, buffer_of = _minari()
    env, spec = _environment(scenario, observation, obstacle_slots)
    returns, collisions = [], 0
    with _published(root, dataset_id) as staged:
        storage = storage_of.new(
            staged,
            observation_space=env.observation_space,
            action_space=env.action_space,
            env_spec=spec,
            data_format="hdf5",
        )
        for part in parts:
            returns.append(part.rewards.sum(axis=1))
            collisions += int(part.infos["collision"][:, -1].sum())
            for first in range(0, len(part), _WRITTEN):
                rows = range(first, min(first + _WRITTEN, len(part)))
                storage.update_episodes([_buffer(buffer_of, part, i) for i in rows])
                if progress is not None:
                    progress(len(rows))
        written = Written(
            dataset_id=dataset_id,
            path=root / dataset_id,
            episodes=episodes,
            steps=episodes * (scenario.nodes - 1),
            returns=np.concatenate(returns),
            collision_rate=collisions / episodes,
            failures=solver_failures(controller),
        )
        metadata = {
            **_metadata(written, controller, scenario, algorithm_name, description),
            "seed": seed,
            "exploration_noise": exploration_noise,
            "observation": layouts.describe(observation, obstacle_slots),
        }
        optional = {"author": author and {author}, "code_permalink": code_permalink}
        storage.update_metadata(metadata | {k: v for k, v in optional.items() if v})
    return written


def check_request(
    dataset_id: str, folder: str | Path | None = None, overwrite: bool = False
) -> Path:
    """Whether a dataset can be written at all; asked before a controller is planned.

    Returns:
        The folder where Minari keeps datasets.

    Raises:
        ValueError: for an id unlike `namespace/name-v0`, or one that is taken.
        ImportError: if Minari or h5py is missing.
    """
    if not isinstance(dataset_id, str) or not _ID.fullmatch(dataset_id):
        raise ValueError(
            f"a dataset's id looks like slipcar/paper/scp-v0: names of letters, digits, _ and - "
            f"between slashes, and a version -v0 at the end; not {dataset_id!r}"
        )
    _minari()
    root = Path(folder).absolute() if folder is not None else _default_folder()
    path = root / dataset_id
    if _is_dataset(path) and not overwrite:
        raise ValueError(
            f"the dataset {dataset_id} exists already in {root}; pass --overwrite "
            "(overwrite=True) to replace it, or choose another id"
        )
    if path.exists() and not _is_dataset(path):
        raise ValueError(f"{path} exists and is no dataset; choose another id")
    for parent in _namespaces(dataset_id):
        if _is_dataset(root / parent):
            raise ValueError(f"{parent} is a dataset and cannot be the namespace of {dataset_id}")
    return root


def _namespaces(dataset_id: str) -> list[str]:
    """`a/b` and `a` for `a/b/c-v0`."""
    return [parent.as_posix() for parent in PurePosixPath(dataset_id).parents][:-1]


def _buffer(buffer_of: Any, part: Episodes, i: int) -> Any:
    terminated = np.zeros(part.rewards.shape[1], dtype=bool)
    truncated = terminated.copy()
    terminated[-1] = True  # the horizon belongs to the problem; nothing is bootstrapped there
    return buffer_of(
        observations=part.observations[i],
        actions=part.actions[i],
        rewards=part.rewards[i],
        terminations=terminated,
        truncations=truncated,
        infos={name: values[i] for name, values in part.infos.items()},
    )


def _environment(scenario: Scenario, kind: str, slots: int) -> tuple[Any, Any]:
    """The environment, and its spec as plain data, so that it survives as JSON."""
    import gymnasium as gym

    name = scenario_name(scenario)
    world = scenario.to_dict() if name is None else name
    arguments: dict[str, Any] = {"scenario": world, "observation": kind}
    if slots:
        arguments["obstacle_slots"] = slots
    env = gym.make(ENVIRONMENT, **arguments)
    assert env.spec is not None
    # With its module, so that it can be made by id wherever slipcar is installed.
    return env, dataclasses.replace(env.spec, id=ENVIRONMENT)


def scenario_name(scenario: Scenario) -> str | None:
    """Its name, if it is one of the named ones."""
    return next((n for n in Scenario.names() if Scenario.named(n) == scenario), None)


def _metadata(
    written: Written,
    controller: Controller,
    scenario: Scenario,
    algorithm_name: str | None,
    description: str | None,
) -> dict[str, Any]:
    returns = written.returns
    algorithm = algorithm_name or controller_name(controller)
    name = scenario_name(scenario)
    world = "a scenario without a name" if name is None else f"scenario {name}"
    origin = provenance()
    version = origin["versions"].get("slipcar")
    return {
        "dataset_id": written.dataset_id,
        "minari_version": importlib.metadata.version("minari"),
        "algorithm_name": algorithm,
        "description": description
        or f"A car that slips when it turns at speed is driven past obstacles to a goal pose "
        f"({world}) by: {algorithm}.",
        "requirements": [f"slipcar>={version}"] if version else [],
        "scenario": scenario.to_dict(),
        "controller": controller_fingerprint(controller),
        "solver_failures": written.failures,
        "returns": {
            "mean": float(returns.mean()),
            "std": float(returns.std()),
            "min": float(returns.min()),
            "max": float(returns.max()),
        },
        "collision_rate": written.collision_rate,
        "provenance": origin,
    }


def _minari() -> tuple[Any, Any]:
    try:
        if importlib.util.find_spec("h5py") is None:
            raise ImportError("h5py is missing")  # Minari would say so late, and less plainly
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_storage import MinariStorage
    except ImportError as error:
        raise ImportError(
            f"writing a dataset needs Minari and h5py ({error}): {install('data')}"
        ) from error
    return MinariStorage, EpisodeBuffer


def _default_folder() -> Path:
    named = os.environ.get("MINARI_DATASETS_PATH")
    return Path(named) if named else Path.home() / ".minari" / "datasets"


def _is_dataset(path: Path) -> bool:
    return (path / "data").is_dir()


@contextlib.contextmanager
def _published(root: Path, dataset_id: str) -> Iterator[Path]:
    """A folder to fill; afterwards it is the dataset, or, after an error, gone.

    It is filled beside the datasets, hidden from Minari's listings, and renamed into its place in
    one step of the file system.
    """
    from minari.namespace import NAMESPACE_METADATA_FILENAME

    root.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=".slipcar-", dir=root))
    new, old, final = staging / "new", staging / "old", root / dataset_id
    try:
        (new / "data").mkdir(parents=True)
        yield new / "data"
        for parent in _namespaces(dataset_id):
            (root / parent).mkdir(parents=True, exist_ok=True)
            about = root / parent / NAMESPACE_METADATA_FILENAME
            if not about.exists():
                about.write_text(json.dumps({}), encoding="utf-8")
        if final.exists():
            final.rename(old)
        try:
            new.rename(final)
        except OSError:
            if old.exists():
                old.rename(final)
            raise
    finally:
        shutil.rmtree(staging, ignore_errors=True)

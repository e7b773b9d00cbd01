"""A Stable-Baselines3 model from its .zip: which algorithm wrote it, whether it fits, its answers.

Loading one unpickles what is in it, so it runs code: only with the user's word for it. Which
algorithm it is of is read from its `data` without unpickling.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from slipcar.envs.extras import install
from slipcar.evaluation.controller import observation_layout
from slipcar.evaluation.own.as_controller import check_spaces

__all__ = ["StoredModel", "algorithm_of", "load_model"]

#: Algorithm -> the package it is in.
ALGORITHMS = {
    **dict.fromkeys(("PPO", "A2C", "SAC", "TD3", "DDPG"), "stable_baselines3"),
    **dict.fromkeys(("TQC", "RecurrentPPO"), "sb3_contrib"),
}


@dataclasses.dataclass(frozen=True)
class StoredModel:
    """A loaded model as a controller: its deterministic actions.

    Attributes:
        model: of Stable-Baselines3.
        observation: what it is shown.
        obstacle_slots: how many obstacles besides.
        digest: of the file.
    """

    model: Any
    observation: str
    obstacle_slots: int
    digest: str

    closed_loop = True

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """The model's."""
        return self.model.predict(
            observation, state=state, episode_start=episode_start, deterministic=deterministic
        )

    def fingerprint(self) -> str:
        """Digest of the file."""
        return self.digest


def load_model(path: str | Path, *, trust: bool = False) -> StoredModel:
    """The model that `model.save(path)` wrote.

    Args:
        path: the .zip.
        trust: whether to load it, which unpickles what is in it and so runs its code.

    Raises:
        ValueError: without `trust`, for a file that is no such model, and for one trained on
            other observations or actions than the car's.
        OSError: if it cannot be read.
        ImportError: if Stable-Baselines3 is not installed.
    """
    path = Path(path)
    algorithm = algorithm_of(path)
    if not trust:
        raise ValueError(
            f"{path} is a {algorithm} model of Stable-Baselines3, and loading one runs the code "
            f"that is pickled in it: if you trust where it comes from, say so (--trust, "
            f"trust=True)"
        )
    package = ALGORITHMS[algorithm]
    try:
        cls = getattr(importlib.import_module(package), algorithm)
    except ImportError as error:
        raise ImportError(
            f"{path} is a {algorithm} model, which needs {package} ({error}): "
            f"{install('rl')}" + (" sb3-contrib" if package == "sb3_contrib" else "")
        ) from error
    try:
        model = _loaded(cls, path)
    except Exception as error:  # whatever unpickling someone's file raises
        raise ValueError(
            f"{path} cannot be loaded as {algorithm}: {type(error).__name__}: {error}"
        ) from error
    check_spaces(model, path.name)
    layout = observation_layout(model)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    return StoredModel(model, layout.kind, layout.slots, digest)


def _loaded(cls: Any, path: Path) -> Any:
    """A model on the processor; in float32, as it was trained, whatever torch's default is now."""
    import torch

    dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        return cls.load(path, device="cpu")
    finally:
        torch.set_default_dtype(dtype)


def algorithm_of(path: str | Path) -> str:
    """Which algorithm a model's .zip is of, without running anything in it.

    Raises:
        ValueError: if it is no model of Stable-Baselines3, or of an algorithm for discrete actions
            or that is not known.
        OSError: if it cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
        if not isinstance(data, dict) or "policy_class" not in data:
            raise ValueError("its data say nothing of a policy")
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise ValueError(f"{path} is no model of Stable-Baselines3: {error}") from error
    policy = str(dict(data["policy_class"]).get("__module__", ""))
    # By what only one of them has: the policies' module is the user's own where they wrote one.
    if "exploration_fraction" in data or "maskable" in policy:
        raise ValueError(f"{path} is a model for discrete actions, which the car has not")
    if "top_quantiles_to_drop_per_net" in data:
        return "TQC"
    if "target_noise_clip" in data:
        # DDPG is TD3 without its three additions.
        plain = data.get("policy_delay") == 1 and data["target_noise_clip"] == 0.0
        return "DDPG" if plain else "TD3"
    if "target_entropy" in data:
        return "SAC"
    if "n_epochs" in data:
        return "RecurrentPPO" if "recurrent" in policy else "PPO"
    if "gae_lambda" in data and "cg_max_steps" not in data and "delta_std" not in data:
        return "A2C"
    raise ValueError(
        f"{path} is a model of an algorithm that is not known here (its policy is of {policy}); "
        f"known: {list(ALGORITHMS)}; load it yourself in a file of your own and name it as "
        f"file.py:object"
    )

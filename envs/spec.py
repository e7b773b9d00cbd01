"""`env.spec` as plain data, so that `env.spec.to_json()` says which world it is of.

Gymnasium keeps the arguments of `gym.make` as they were given and writes them with `json`, which
knows neither scenarios nor NumPy's numbers. Here they are turned into what `from_json` reads back
to make the same environment.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from slipcar.envs.families import Family
from slipcar.envs.scenario import Scenario


class PlainSpec:
    """A descriptor of environments: their `spec`, with arguments as plain data."""

    def __get__(self, env: Any, owner: Any = None) -> EnvSpec | None:
        return None if env is None else vars(env).get("_spec")

    def __set__(self, env: Any, spec: EnvSpec | None) -> None:
        vars(env)["_spec"] = spec and dataclasses.replace(spec, kwargs=plain(spec.kwargs))


def plain(value: Any) -> Any:
    """An argument of an environment as what JSON can say, where it can; otherwise as it is."""
    if isinstance(value, (Scenario, Family)):
        return value.to_dict()
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, np.dtype) or (isinstance(value, type) and issubclass(value, np.generic)):
        return np.dtype(value).name
    return value

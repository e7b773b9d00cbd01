"""What is shipped: the files of policies trained before, by world, method and seed.

weights/<world>/<method>-<seed>.safetensors, .json
"""

from __future__ import annotations

import importlib.resources
import re
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TypeAlias

SUFFIXES = (".safetensors", ".json")
#: World, method and seed of the policy that `load_policy()` gives.
DEFAULT = ("paper", "ppo", 0)
File: TypeAlias = Path | Traversable

_NAME = re.compile(r"(?P<method>[a-z0-9-]+)-(?P<seed>\d+)\.json")


def shipped_methods(world: str = "paper") -> tuple[str, ...]:
    """Methods of which policies for this world are shipped, in alphabetical order.

    Args:
        world: `paper`, or `random` (the family of that name).

    Raises:
        ValueError: for a world of which none are shipped, listing those that are.
    """
    return tuple(sorted(_seeds(world)))


def shipped_seeds(method: str, world: str) -> tuple[int, ...]:
    """Seeds of the policies shipped of this method and world, in order.

    Raises:
        ValueError: for a method or a world of which none are shipped, listing those that are.
    """
    methods = _seeds(world)
    if method not in methods:
        raise ValueError(
            f"no policies of method {method!r} are shipped for {world!r}; those that are: "
            f"{sorted(methods)}"
        )
    return tuple(sorted(methods[method]))


def shipped_file(world: str, method: str, seed: int, suffix: str) -> File:
    """Where such a policy's file is, or would be."""
    return _folder() / world / f"{method}-{seed}{suffix}"


def _folder() -> Traversable:
    return importlib.resources.files("slipcar.baselines") / "weights"


def _seeds(world: str) -> dict[str, list[int]]:
    """Seeds by method."""
    worlds = sorted(entry.name for entry in _folder().iterdir() if entry.is_dir())
    if world not in worlds:
        raise ValueError(f"no policies are shipped for world {world!r}; the worlds are {worlds}")
    found: dict[str, list[int]] = {}
    for entry in (_folder() / world).iterdir():
        if match := _NAME.fullmatch(entry.name):
            found.setdefault(match["method"], []).append(int(match["seed"]))
    return found

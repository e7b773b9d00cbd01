"""Finished pieces of an evaluation on disk: written atomically, reused only where all agrees.

A cell is a stretch of episodes of one row. Its key holds everything that its numbers depend on:
scenario, seed, episodes, substeps, what drives, the source that computes it and the versions of
the libraries below. The file is named by the key, so a changed option finds what it touches
missing and all else in place, and more episodes add cells to those that are there.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np

from slipcar.baselines import Policy
from slipcar.baselines.files import remove_leftovers, write_atomically
from slipcar.evaluation.metrics import FIELDS, EpisodeMetrics
from slipcar.evaluation.noise import BLOCK
from slipcar.evaluation.own.digest import behaviour_digest
from slipcar.evaluation.provenance import code_digest, versions
from slipcar.evaluation.rollout import Measured, Stretch
from slipcar.planner import Feedback, OpenLoop

FORMAT = 2
_SCALARS = tuple(f.name for f in dataclasses.fields(Measured) if f.name != "metrics")
#: Whose versions count: for planners, and for what may use anything.
_PLANNING = ("numpy", "scipy", "llvmlite")
_ANY = (*_PLANNING, "gymnasium", "torch", "stable-baselines3", "sb3-contrib", "cvxpy", "osqp")


def cell_size(controller: Any) -> int:
    """Episodes in one cell: many of what is quick, one block of what may be slow."""
    return BLOCK * (8 if isinstance(controller, (OpenLoop, Feedback, Policy)) else 1)


def cell_key(stretch: Stretch, fingerprint: str | None) -> dict[str, Any] | None:
    """All that a cell depends on, as plain data; None if what drives cannot be identified.

    Args:
        stretch: the cell.
        fingerprint: of what drives, from :func:`controller_fingerprint`.
    """
    if fingerprint is None:
        return None
    return {
        "format": FORMAT,
        "scenario": stretch.scenario.to_dict(),
        "seed": stretch.seed,
        "first": stretch.first,
        "episodes": stretch.episodes,
        "substeps": stretch.substeps,
        "controller": fingerprint,
        **_software(stretch.controller),
    }


def _software(controller: Any) -> dict[str, Any]:
    """Source and library versions that a controller's numbers depend on."""
    parts: tuple[str, ...]
    packages: tuple[str, ...]
    if type(controller) is Policy:
        parts, packages = ("envs", "policy", "core"), ("numpy",)
    elif type(controller).__module__.startswith("slipcar.planner."):
        parts, packages = ("envs", "planner", "core"), _PLANNING
    else:  # anybody's: it may use all of it
        parts, packages = ("envs", "planner", "policy", "core"), _ANY
    return {
        "code": code_digest(*parts),
        "python": platform.python_version(),
        "versions": {name: found for name, found in _versions() if name in packages},
    }


@functools.cache
def _versions() -> tuple[tuple[str, str], ...]:
    return tuple(versions().items())


def controller_fingerprint(controller: Any) -> str | None:
    """What identifies a controller's behaviour, or None if that cannot be told.

    Slipcar's own controllers say it themselves; of anybody else's the digest covers the code, what
    it refers to, and the numbers it holds (:mod:`slipcar.evaluation.own.digest`). Where it cannot
    be had nothing is reused: better done twice than wrong.
    """
    own = getattr(controller, "fingerprint", None)
    if type(controller).__module__.startswith("slipcar.") and callable(own):
        told = own()
        return None if told is None else f"{type(controller).__qualname__}:{told}"
    return behaviour_digest(controller)


class Store:
    """Where finished cells are kept: in a folder, or in memory alone.

    Attributes:
        folder: with a folder `cells`, or None.
        resume: whether cells that were there before may be used.
        trouble: what went wrong when writing, said once; then cells stay in memory.
    """

    def __init__(self, folder: str | Path | None = None, resume: bool = True) -> None:
        self.folder = None if folder is None else Path(folder) / "cells"
        for place in () if folder is None else (Path(folder), Path(folder) / "cells"):
            if place.exists() and not place.is_dir():
                raise NotADirectoryError(f"{place} is a file, and results need a folder")
        self.resume = resume
        self.trouble = ""
        if folder is not None and self.folder is not None:
            remove_leftovers(Path(folder))
            remove_leftovers(self.folder)
        self._memory: dict[str, Measured] = {}
        self._asked: set[str] = set()

    def get(self, key: dict[str, Any] | None) -> Measured | None:
        """The cell with this key, or None if it is not there, or damaged."""
        if key is None:
            return None
        name = cell_name(key)
        new = name not in self._asked
        self._asked.add(name)
        if name in self._memory:
            return self._memory[name]
        if self.folder is None or (new and not self.resume):
            return None
        return read_cell(self.folder / name, key)

    def put(self, key: dict[str, Any] | None, measured: Measured) -> None:
        """Keep a finished cell; what cannot be written (a full disk) is kept in memory."""
        if key is None:
            return
        name = cell_name(key)
        if self.folder is not None and not self.trouble:
            try:
                write_cell(self.folder / name, key, measured)
            except OSError as error:
                self.trouble = (
                    f"finished work cannot be kept in {self.folder} ({error}); it goes on without"
                )
            else:
                return
        self._memory[name] = measured

    def foreign(self) -> int:
        """How many cells are there that nothing asked for so far: other options or versions."""
        if self.folder is None or not self.folder.is_dir():
            return 0
        return sum(path.name not in self._asked for path in self.folder.glob("*.npz"))


def cell_name(key: dict[str, Any]) -> str:
    """File name of a cell: a digest of its key."""
    return hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:32] + ".npz"


def write_cell(path: Path, key: dict[str, Any], measured: Measured) -> None:
    """Write a cell; a reader sees all of it or nothing.

    Raises:
        OSError: if it cannot be written; nothing is left then.
    """
    scalars = {field: getattr(measured, field) for field in _SCALARS}
    content = io.BytesIO()
    arrays: dict[str, Any] = {
        "header": np.array(json.dumps({"key": key, **scalars})),
        **measured.metrics.to_dict(),
    }
    np.savez(content, **arrays)
    write_atomically(path, content.getvalue())


def read_cell(path: Path, key: dict[str, Any]) -> Measured | None:
    """The cell at `path`, or None if there is none, its key differs, or the file is damaged."""
    try:
        with np.load(path, allow_pickle=False) as data:
            header = json.loads(str(data["header"]))
            if header["key"] != json.loads(json.dumps(key)):
                return None
            metrics = EpisodeMetrics(**{field: data[field] for field in FIELDS})
        return Measured(metrics=metrics, **{field: header[field] for field in _SCALARS})
    except Exception:  # whatever NumPy, zipfile and zlib make of a damaged file
        return None

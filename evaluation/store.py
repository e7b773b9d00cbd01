"""Finished rows of a comparison on disk: written atomically, reused only where the key agrees.

The key holds all that the numbers depend on: scenario, seed, episodes, substeps, the
controller's fingerprint, slipcar's source and the versions of Python and NumPy.
"""

from __future__ import annotations

import hashlib
import inspect
import io
import json
import pickle
import platform
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from slipcar.baselines.files import write_atomically
from slipcar.envs.scenario import Scenario
from slipcar.evaluation.metrics import FIELDS, EpisodeMetrics, Result
from slipcar.evaluation.noise import BLOCK
from slipcar.evaluation.provenance import code_digest

_FORMAT = 1
_SCALARS = (
    "seed", "substeps", "closed_loop", "failures", "inference_time", "preparation_time",
    "wall_time",
)  # fmt: skip


def row_key(
    controller: Any, scenario: Scenario, episodes: int, seed: int, substeps: int
) -> dict[str, Any] | None:
    """All that a row depends on, as plain data; None if the controller cannot be identified."""
    fingerprint = controller_fingerprint(controller)
    if fingerprint is None:
        return None
    return {
        "format": _FORMAT,
        "scenario": scenario.to_dict(),
        "seed": seed,
        "episodes": episodes,
        "substeps": substeps,
        "block": BLOCK,
        "controller": fingerprint,
        "code": code_digest(),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def controller_fingerprint(controller: Any) -> str | None:
    """What identifies a controller's behaviour: its own `fingerprint()`, else a digest.

    The digest covers its pickle and the source file of its class. Where that cannot be had
    the answer is None and the row is not reused: better done twice than wrong.
    """
    own = getattr(controller, "fingerprint", None)
    if callable(own):
        return f"{type(controller).__qualname__}:{own()}"
    try:
        data = pickle.dumps(controller)
        source = Path(inspect.getfile(type(controller))).read_bytes()
    except Exception:  # whatever a user's object raises when pickled: it has no fingerprint
        return None
    return hashlib.sha256(data + source).hexdigest()


def row_path(folder: str | Path, name: str) -> Path:
    """File of a row: its name made safe, and a digest that keeps similar names apart."""
    safe = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:48]
    return Path(folder) / "rows" / f"{safe}-{hashlib.sha256(name.encode()).hexdigest()[:8]}.npz"


def save_row(folder: str | Path, name: str, key: dict[str, Any], result: Result) -> Path:
    """Write a finished row; a reader sees the old file or the new one, never half of one."""
    path = row_path(folder, name)
    scalars = {field: getattr(result, field) for field in _SCALARS}
    header = json.dumps({"name": name, "key": key, **scalars})
    content = io.BytesIO()
    arrays: dict[str, Any] = {"header": np.array(header), **result.metrics.to_dict()}
    np.savez(content, **arrays)
    write_atomically(path, content.getvalue())
    return path


def load_row(folder: str | Path, name: str, key: dict[str, Any]) -> Result | None:
    """The stored row, or None if there is none, its key differs, or the file is damaged."""
    try:
        with np.load(row_path(folder, name), allow_pickle=False) as data:
            header = json.loads(str(data["header"]))
            if header["key"] != json.loads(json.dumps(key)):
                return None
            metrics = EpisodeMetrics(**{field: data[field] for field in FIELDS})
        return Result(metrics=metrics, **{field: header[field] for field in _SCALARS})
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        return None

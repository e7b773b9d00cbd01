"""Where a number comes from: versions, machine, code. Stored beside every table."""

from __future__ import annotations

import datetime
import functools
import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

PACKAGES = (
    "slipcar", "numpy", "scipy", "pandas", "gymnasium", "array-api-compat", "safetensors",
    "joblib", "distributed", "matplotlib", "torch", "stable-baselines3", "sb3-contrib", "osqp",
    "cvxpy", "llvmlite",
)  # fmt: skip
_FOLDERS = ("envs", "planner", "baselines", "evaluation")


def provenance() -> dict[str, Any]:
    """Versions, Python, processor, operating system, date and commit, as plain data."""
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "python": platform.python_version(),
        "cpu": cpu_model(),
        "cpu_count": os.cpu_count(),
        "os": platform.platform(),
        "commit": commit(),
        "code": code_digest(),
    }


def versions() -> dict[str, str]:
    """Installed version of each package that can change a number; absent ones are left out."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


@functools.cache
def cpu_model() -> str:
    """The processor's name, as far as the system tells."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()


@functools.cache
def commit() -> str | None:
    """The checkout's commit, `+changes` appended if it has some; None outside a checkout."""
    folder = Path(__file__).resolve().parent
    try:
        head = _git(folder, "rev-parse", "HEAD")
        changes = _git(folder, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+changes" if changes else "")


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(folder), *arguments],
        capture_output=True,
        text=True,
        timeout=5,
        check=True,
    )
    return done.stdout.strip()


#: What numbers depend on: name -> folders and files of the source. Commands, tables, figures and
#: pictures are nobody's: a change of theirs leaves finished work as it is.
PARTS = {
    "envs": ("envs/*.py",),
    "planner": ("planner/**/*.py",),
    "policy": ("baselines/policy.py",),
    "core": (
        "baselines/deterministic.py",
        "baselines/straight.py",
        "evaluation/own/*.py",
        *(
            f"evaluation/{name}.py"
            for name in (
                *("between", "cells", "controller", "makers", "metrics", "noise", "rollout"),
                "threads",
            )
        ),
    ),
}


@functools.cache
def code_digest(*parts: str) -> str:
    """Digest of slipcar's own source: stored numbers of another version are never reused.

    The version number does not change between two edits; this does.

    Args:
        *parts: names of :data:`PARTS`; none takes the whole source.
    """
    digest = hashlib.sha256()
    patterns = [pattern for part in parts for pattern in PARTS[part]]
    for pattern in patterns or [f"{folder}/**/*.py" for folder in _FOLDERS]:
        folder, _, names = pattern.partition("/")
        spec = importlib.util.find_spec(f"slipcar.{folder}")
        for root in spec.submodule_search_locations or () if spec else ():
            for path in sorted(Path(root).glob(names)):
                digest.update(f"{folder}/{path.relative_to(root).as_posix()}".encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]

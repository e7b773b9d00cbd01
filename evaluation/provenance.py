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
    "joblib", "matplotlib", "torch", "stable-baselines3", "osqp", "cvxpy", "numba",
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


@functools.cache
def code_digest() -> str:
    """Digest of slipcar's own source: stored rows of another version are never reused.

    The version number does not change between two edits; this does.
    """
    digest = hashlib.sha256()
    for folder in _FOLDERS:
        spec = importlib.util.find_spec(f"slipcar.{folder}")
        for root in spec.submodule_search_locations or () if spec else ():
            for path in sorted(Path(root).rglob("*.py")):
                digest.update(path.relative_to(root).as_posix().encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]

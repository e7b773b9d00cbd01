"""Oldest and newest: the package against the ends of what pyproject.toml admits.

    python benchmarks/matrix.py [--pythons 3.11 3.13] [--keep FOLDER]     # or: make matrix

A wheel is built, and installed with every extra into an environment of its own for each Python
from 3.11 to 3.14 that this machine has (in ~/.pyenv, or where `uv` finds it) and for either end:
the oldest version of each direct dependency that has a wheel for that Python, and the newest of
all. Then `matrix_smoke.py` runs there (import, plan, environments, comparison, files) and the quick
part of the tests. The environments are temporary and apart from the checkout's; PyPI is needed, and
`uv` is taken from it if it is missing.

torch is installed only where it is asked for (--torch torch==2.13.0, by pip with its own settings),
as a build for a GPU has gigabytes; without it the extra `rl` is left out.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
#: Resolution of uv for either end of what is admitted.
ENDS = {"oldest": "lowest-direct", "newest": "highest"}
EXTRAS = ("plot", "qp", "video", "data", "cluster", "report")
LEARNING = "rl"
MINUTES = 15
TESTING = ("pytest", "pytest-timeout", "hypothesis", "packaging")
#: The quick part of the tests: half a minute, every package, no tool of developers.
QUICK = (
    "envs/test_car.py", "envs/test_cost.py", "envs/test_scenario.py", "envs/test_slip_car.py",
    "envs/test_observation.py", "envs/test_registration.py", "planner/test_trace_graph.py",
    "planner/test_moments.py", "planner/test_plan_file.py", "planner/test_newton_kernels.py",
    "planner/test_certificate.py", "planner/test_feedback_gains.py",
    "evaluation/test_statistics.py", "evaluation/test_metrics.py", "baselines/test_policy.py",
    "baselines/test_policy_storage.py",
)  # fmt: skip


def main() -> int:
    """Try every environment and print a table; the exit code is 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pythons", nargs="+", default=PYTHONS, help="which versions to try")
    parser.add_argument("--ends", nargs="+", default=list(ENDS), choices=list(ENDS))
    parser.add_argument("--torch", default="", help="what pip installs first: torch==2.13.0")
    parser.add_argument("--torch-pythons", nargs="+", default=["3.11"], help="where it does")
    parser.add_argument("--keep", type=Path, help="make the environments here, and leave them")
    chosen = parser.parse_args()
    rows = []
    with _folder(chosen.keep) as folder:
        uv = find_uv(folder)
        wheel = built(uv, folder)
        for version in chosen.pythons:
            python = find_python(uv, version)
            for end in chosen.ends:
                torch = chosen.torch if version in chosen.torch_pythons else ""
                if python is None:
                    rows.append((version, end, "not tried", "no such Python on this machine"))
                else:
                    rows.append((version, end, *tried(uv, folder, wheel, python, end, torch)))
                print(f"Python {version}, {end}: {rows[-1][2]}", flush=True)
    print("\n| Python | versions | outcome | |\n|---|---|---|---|")
    for row in rows:
        print("| " + " | ".join(row) + " |")
    return int(any(row[2] == "FAILED" for row in rows))


@contextlib.contextmanager
def _folder(kept: Path | None) -> Iterator[Path]:
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        yield kept.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="slipcar-matrix-") as folder:
        yield Path(folder)


def run(*words: Any, check: bool = True, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command, its output as text; without the checkout's packages."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    certificates = Path("/etc/ssl/certs/ca-certificates.crt")
    if certificates.is_file():  # uv has its own, and knows none of an institution's
        environment.setdefault("SSL_CERT_FILE", str(certificates))
    done = subprocess.run(
        [str(word) for word in words],
        env=environment, capture_output=True, text=True, check=False, timeout=60 * MINUTES,
        **options,
    )  # fmt: skip
    if check and done.returncode:
        raise SystemExit(f"{' '.join(map(str, words))}:\n{done.stdout}{done.stderr}")
    return done


def find_uv(folder: Path) -> Path:
    """uv as it is installed, else from PyPI into a folder of the matrix."""
    if found := shutil.which("uv"):
        return Path(found)
    place = folder / "uv"
    if not (place / "bin/uv").is_file():
        run(sys.executable, "-m", "venv", place)
        run(place / "bin/python", "-m", "pip", "-qq", "install", "uv")
    return place / "bin/uv"


def find_python(uv: Path, version: str) -> Path | None:
    """An interpreter of this version that is on the machine."""
    homes = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    if homes:
        return homes[-1]
    found = run(uv, "python", "find", "--no-python-downloads", version, check=False)
    return Path(found.stdout.strip()) if found.returncode == 0 else None


def built(uv: Path, folder: Path) -> Path:
    """A wheel of the checkout, made from a copy: a build leaves its folders behind."""
    source = folder / "source"
    shutil.rmtree(source, ignore_errors=True)
    source.mkdir()
    for name in ("planner", "envs", "baselines", "evaluation"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    run(uv, "build", "-q", "--wheel", "--out-dir", folder / "wheel", source)
    return next((folder / "wheel").glob("*.whl"))


def tried(
    uv: Path, folder: Path, wheel: Path, python: Path, end: str, torch: str
) -> tuple[str, str]:
    """What came of one environment: the outcome, and versions or the error."""
    place = folder / f"{python.parent.parent.name}-{end}"
    run(uv, "venv", "-q", "--clear", "--seed", "--python", python, place)
    interpreter = place / "bin/python"
    if torch:
        run(interpreter, "-m", "pip", "-qq", "install", torch)
    names = [*EXTRAS, *([LEARNING] if torch else [])]
    installed = run(
        uv, "pip", "install", "-q", "--python", interpreter, "--resolution", ENDS[end],
        "--only-binary", ":all:", wheel, *requirements(names), check=False,
    )  # fmt: skip
    if installed.returncode:
        return "FAILED", "install: " + _last(installed.stderr)
    smoke = run(
        interpreter, "-W", "default", Path(__file__).with_name("matrix_smoke.py"),
        check=False, cwd=place,
    )  # fmt: skip
    (place / "smoke.txt").write_text(smoke.stdout + smoke.stderr)
    if smoke.returncode:
        return "FAILED", _last(smoke.stderr)
    run(uv, "pip", "install", "-q", "--python", interpreter, *TESTING)
    tests = run(
        interpreter, "-m", "pytest", "-q", "-p", "no:cacheprovider",
        *(ROOT / "tests" / name for name in QUICK), check=False, cwd=ROOT,
    )  # fmt: skip
    (place / "tests.txt").write_text(tests.stdout + tests.stderr)
    if tests.returncode:
        return "FAILED", "tests: " + _last(tests.stdout)
    return "passed", smoke.stdout.strip().splitlines()[-1]


def requirements(extras: list[str]) -> list[str]:
    """Of the package and these extras, so that they are direct ones: uv takes their lowest."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = list(project["dependencies"])
    for extra in extras:
        wanted += project["optional-dependencies"][extra]
    return [name for name in wanted if not name.startswith("torch")]


def _last(text: str) -> str:
    lines = [line.strip() for line in text.strip().splitlines() if line.strip()]
    errors = [line for line in lines if "Error" in line]
    return " ".join((errors or lines)[-1:])[:300].replace("|", "/")


if __name__ == "__main__":
    raise SystemExit(main())

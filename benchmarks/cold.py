"""Cold start: a fresh process, import, first plan; and what is compiled for a new kind of problem.

The interpreter's own start is a row of its own. Object code is kept in a folder of the benchmark's:
one that is filled beforehand for a warm cache, an empty one for each process otherwise. "Without
llvmlite" means that the import fails as it does where it is not installed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from report import Section
from rich.console import Console
from rich.progress import track

ABOUT = """\
A fresh process that imports, plans for the paper's case, plans again and exits. *Warm cache*:
object code is found on disk, in the folder `SLIPCAR_CACHE_DIR`; *empty cache*: that folder is
empty, as in a new installation or with a new version. `plan(s, risk=0.01)` checks its promise by
Monte Carlo, which has a column of its own and is in the time; a *receding-horizon episode* is a
`RecedingHorizon` and 40 steps of the environment. *Without llvmlite*: as where it is not installed,
NumPy runs the same steps. A first plan contains what is set up for it; CasADi's rows build their
programme, and import the scenario from slipcar too.

A *new kind of problem* is one whose trace has another structure: pendulums coupled by springs (n
states, n/2 controls), with an empty cache, in a process that has planned for the paper's case
before. *Compiling* is what the first plan takes longer than the second.
"""

_CHILD = Path(__file__).resolve().parent / "cold_plan.py"
#: What the child is asked for, whether the cache is empty, and what the row is called.
CASES = {
    "Python alone": ("nothing", False),
    "slipcar, warm cache": ("plan", False),
    "slipcar, empty cache": ("plan", True),
    "slipcar, empty cache, plan(s, risk=0.01)": ("risk", True),
    "slipcar, empty cache, receding-horizon episode": ("receding", True),
    "slipcar, without llvmlite": ("numpy", False),
    "CasADi + fatrop": ("fatrop", False),
    "CasADi + IPOPT": ("ipopt", False),
}
#: Pendulums of a new kind of problem: half of its states.
PENDULUMS = (1, 2, 3, 6)
KINDS = {f"{2 * count} states": (f"pendulums:{count}", True) for count in PENDULUMS}
ROUNDS = 7

Seconds = dict[str, float]


def section(rounds: int = ROUNDS) -> Section:
    """All of it, to be printed and kept."""
    told, skipped = measure(rounds)
    first = [_row(name, told[name]) for name in CASES if name in told]
    return Section(
        part="cold",
        title="Cold start",
        about=ABOUT,
        tables={
            "Import and first plan": first,
            "A new kind of problem": [_kind(name, told[name]) for name in KINDS if name in told],
        },
        notes=tuple(f"skipped {name}: {why}" for name, why in skipped.items()),
        raw={"seconds": told},
    )


def measure(rounds: int) -> tuple[dict[str, list[Seconds]], dict[str, str]]:
    """Seconds of each run by row, in turns, and why some rows are missing."""
    told: dict[str, list[Seconds]] = {}
    skipped: dict[str, str] = {}
    console = Console(stderr=True)
    with tempfile.TemporaryDirectory(prefix="slipcar-bench-") as warm:
        for turn in track(range(rounds + 1), "cold start: in turns", console=console):
            for name, (case, empty) in {**CASES, **KINDS}.items():
                if name in skipped:
                    continue
                try:
                    measured = _with_empty_cache(case) if empty else _fresh_process(case, warm)
                except subprocess.CalledProcessError as error:
                    skipped[name] = error.stderr.strip().rpartition("\n")[2]
                    print(f"skipped cold start of {name}: {skipped[name]}")
                    continue
                if turn > 0:  # the first one fills the warm cache, and the system's own
                    told.setdefault(name, []).append(measured)
    return told, skipped


def _with_empty_cache(case: str) -> Seconds:
    with tempfile.TemporaryDirectory(prefix="slipcar-bench-") as empty:
        return _fresh_process(case, empty)


def _fresh_process(case: str, cache: str) -> Seconds:
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, str(_CHILD), case],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "SLIPCAR_CACHE_DIR": cache},
    )
    whole = time.perf_counter() - began
    return {"whole": whole, **json.loads(done.stdout)}


def _column(measured: list[Seconds], key: str) -> np.ndarray:
    return np.array([one.get(key, np.nan) for one in measured])


def _row(name: str, measured: list[Seconds]) -> dict[str, Any]:
    def median(values: np.ndarray) -> float:
        return float(np.median(values))

    whole, imported, first, second, simulated = (
        _column(measured, key) for key in ("whole", "import", "first", "second", "Monte Carlo")
    )
    low, middle, high = np.quantile(whole, [0.25, 0.5, 0.75])
    return {
        "fresh process": name,
        "whole [s] (median)": float(middle),
        "quartiles": f"{low:.3g}–{high:.3g}",
        "import + first plan [s]": median(imported + first),
        "import [s]": median(imported),
        "first plan [s]": median(first),
        "of it Monte Carlo [s]": median(simulated),
        "second plan [ms]": 1e3 * median(second),
        "start and exit [s]": median(whole - np.nan_to_num(imported + first + second)),
        "runs": len(measured),
    }


def _kind(name: str, measured: list[Seconds]) -> dict[str, Any]:
    first, second = _column(measured, "first"), _column(measured, "second")
    low, middle, high = np.quantile(first - second, [0.25, 0.5, 0.75])
    return {
        "kind": name,
        "compiling [s] (median)": float(middle),
        "quartiles": f"{low:.3g}–{high:.3g}",
        "first plan [s]": float(np.median(first)),
        "second plan [ms]": 1e3 * float(np.median(second)),
        "runs": len(measured),
    }

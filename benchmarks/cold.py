"""Cold start: a fresh process, import, first plan.

The interpreter's own start is a row of its own. numba's cache is on disk (a call beforehand sees
to that), and in one row, measured once, it is empty; "without numba" means that the import fails
as it does where it is not installed.
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
A fresh process that imports, plans for the paper's case, plans again and exits. *slipcar, numba*
finds its compiled code in numba's cache on disk; *first plan ever* is the same with an empty
cache, once: what a new installation, or a new version, pays one time. *Without numba*: as where it
is not installed. A first plan contains what is set up for it; CasADi's rows build their programme,
and import the scenario from slipcar too.
"""

_CHILD = Path(__file__).resolve().parent / "cold_plan.py"
#: What the child is asked for, and what its row is called.
CASES = {
    "nothing": "Python alone",
    "numba": "slipcar, numba",
    "numpy": "slipcar, without numba",
    "fatrop": "CasADi + fatrop",
    "ipopt": "CasADi + IPOPT",
}
FIRST_EVER = "slipcar, numba, first plan ever"
ROUNDS = 7

Seconds = dict[str, float]


def section(rounds: int = ROUNDS) -> Section:
    """All of it, to be printed and kept."""
    told, skipped = measure(rounds)
    return Section(
        part="cold",
        title="Cold start",
        about=ABOUT,
        tables={"Import and first plan": [_row(name, measured) for name, measured in told.items()]},
        notes=tuple(f"skipped {name}: {why}" for name, why in skipped.items()),
        raw={"seconds": told},
    )


def measure(rounds: int) -> tuple[dict[str, list[Seconds]], dict[str, str]]:
    """Seconds of each run by row, in turns, and why some rows are missing."""
    told: dict[str, list[Seconds]] = {}
    skipped: dict[str, str] = {}
    console = Console(stderr=True)
    for turn in track(range(rounds + 1), "cold start: in turns", console=console):
        for case, name in CASES.items():
            if name in skipped:
                continue
            try:
                measured = _fresh_process(case)
            except subprocess.CalledProcessError as error:
                skipped[name] = error.stderr.strip().rpartition("\n")[2]
                print(f"skipped cold start of {name}: {skipped[name]}")
                continue
            if turn > 0:  # the first one fills the caches on disk
                told.setdefault(name, []).append(measured)
    if CASES["numba"] in told:
        with tempfile.TemporaryDirectory(prefix="slipcar-bench-") as empty:
            told[FIRST_EVER] = [_fresh_process("numba", NUMBA_CACHE_DIR=empty)]
    return told, skipped


def _fresh_process(case: str, **environment: str) -> Seconds:
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, str(_CHILD), case],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **environment},
    )
    whole = time.perf_counter() - began
    return {"whole": whole, **json.loads(done.stdout)}


def _row(name: str, measured: list[Seconds]) -> dict[str, Any]:
    def column(key: str) -> np.ndarray:
        return np.array([one.get(key, np.nan) for one in measured])

    low, median, high = np.quantile(column("whole"), [0.25, 0.5, 0.75])
    inside = np.nan_to_num(column("import") + column("first") + column("second"))
    return {
        "fresh process": name,
        "whole [s] (median)": float(median),
        "quartiles": f"{low:.3g}–{high:.3g}",
        "import + first plan [s]": float(np.median(column("import") + column("first"))),
        "import [s]": float(np.median(column("import"))),
        "first plan [s]": float(np.median(column("first"))),
        "second plan [ms]": 1e3 * float(np.median(column("second"))),
        "start and exit [s]": float(np.median(column("whole") - inside)),
        "runs": len(measured),
    }

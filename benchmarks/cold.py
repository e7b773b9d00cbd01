"""Cold start: a fresh process, import, first plan.

The interpreter's own start is a row of its own. numba's cache is on disk (a call beforehand sees
to that); "without numba" means that the import fails as it does where it is not installed.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

_CHILD = Path(__file__).resolve().parent / "cold_plan.py"
#: What the child is asked for, and what its row is called.
CASES = {
    "nothing": "Python alone",
    "numba": "slipcar, numba",
    "numpy": "slipcar, without numba",
    "fatrop": "CasADi + fatrop",
    "ipopt": "CasADi + IPOPT",
}
ROUNDS = 7


def rows(rounds: int = ROUNDS) -> list[dict[str, Any]]:
    """Seconds by case: whole process, import, set-up and first plan, second plan."""
    told: dict[str, list[dict[str, float]]] = {}
    console = Console(stderr=True)
    for turn in track(range(rounds + 1), "cold start: in turns", console=console):
        for case in CASES:
            try:
                measured = _fresh_process(case)
            except subprocess.CalledProcessError as error:
                if turn == 0:
                    last = error.stderr.strip().rpartition("\n")[2]
                    print(f"skipped cold start of {CASES[case]}: {last}")
                continue
            if turn > 0:  # the first one fills the caches on disk
                told.setdefault(case, []).append(measured)
    return [_row(CASES[case], measured) for case, measured in told.items()]


def _fresh_process(case: str) -> dict[str, float]:
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, str(_CHILD), case], capture_output=True, text=True, check=True
    )
    whole = time.perf_counter() - began
    return {"whole": whole, **json.loads(done.stdout)}


def _row(name: str, measured: list[dict[str, float]]) -> dict[str, Any]:
    def column(key: str) -> np.ndarray:
        return np.array([one.get(key, np.nan) for one in measured])

    low, median, high = np.quantile(column("whole"), [0.25, 0.5, 0.75])
    inside = np.nan_to_num(column("import") + column("first") + column("second"))
    return {
        "fresh process": name,
        "whole [s] (median)": float(median),
        "quartiles": f"{low:.3g}–{high:.3g}",
        "import [s]": float(np.median(column("import"))),
        "first plan, set-up included [s]": float(np.median(column("first"))),
        "second plan [ms]": 1e3 * float(np.median(column("second"))),
        "start and exit [s]": float(np.median(column("whole") - inside)),
        "runs": len(measured),
    }

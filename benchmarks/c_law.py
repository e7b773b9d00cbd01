"""What a call of an exported law takes, in C and in Python, and how far the two are apart."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from report import Section

from slipcar.envs import Scenario
from slipcar.planner import Feedback, plan
from slipcar.planner.c_code import write_c
from slipcar.planner.law import Law

ABOUT = """\
`slipcar export --to c` of a plan with feedback for each named world, compiled with `cc -O2`; a time
is a call, the mean over 10⁶ of them in C at states round the plan. The difference is the largest
from `Feedback.control` at 2000 states, per unit of 1 + |u|.
"""
_CALLS, _CASES = 1_000_000, 2000
_LOOP = """
#include "law.h"
double run(const law_real *t, const law_real *x, int cases, int calls)
{
    double sum = 0;
    law_real u[LAW_CONTROLS];
    for (int i = 0, c = 0; i < calls; ++i, c = c + 1 < cases ? c + 1 : 0) {
        law_control(t[c], x + c * LAW_STATES, u);
        sum += (double)u[0];
    }
    return sum;
}
"""


def section() -> Section:
    """All named worlds, in either precision; nothing without a compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return Section("c_law", "A plan's law in C", ABOUT, {}, notes=("no C compiler (cc)",))
    rows = [row(name, compiler) for name in Scenario.names()]
    return Section("c_law", "A plan's law in C", ABOUT, {"A call": rows})


def row(name: str, compiler: str) -> dict[str, Any]:
    """One world."""
    planned = plan(Scenario.named(name), feedback=True)
    law, feedback = Law.of(planned), Feedback(planned)
    rng = np.random.default_rng(0)
    k = rng.integers(len(law.controls), size=_CASES)
    t = law.times[k] + (0.1 + 0.8 * rng.random(_CASES)) * np.diff(law.times)[k]
    x = law.mean[k] + 0.1 * rng.standard_normal((_CASES, law.mean.shape[1]))
    cells: dict[str, Any] = {"world": name}
    for real in (np.float64, np.float32):
        word = "double" if real is np.float64 else "float"
        seconds, got = in_c(law, t, x, real, compiler)
        cells[f"{word} [µs]"] = 1e6 * seconds
        expected = np.array([feedback.control(*case) for case in zip(t, x, strict=True)])
        cells[f"{word}: difference"] = float(
            (np.abs(got - expected) / (1 + np.abs(expected))).max()
        )
    began = time.perf_counter()
    for case in zip(t, x, strict=True):
        feedback.control(*case)
    return {**cells, "Python [µs]": 1e6 * (time.perf_counter() - began) / _CASES}


def in_c(
    law: Law, t: np.ndarray, x: np.ndarray, real: Any, compiler: str
) -> tuple[float, np.ndarray]:
    """Seconds of a call, and the controls of each case, (cases, m)."""
    t, x = t.astype(real), np.ascontiguousarray(x.astype(real))
    kind = np.ctypeslib.as_ctypes_type(real)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_c(law, folder, "law", float32=real is np.float32)
        (folder / "loop.c").write_text(_LOOP)
        command = [compiler, "-O2", "-shared", "-fPIC", "law.c", "loop.c", "-o", "law.so"]
        subprocess.run(command, cwd=folder, check=True)
        library = ctypes.CDLL(str(folder / "law.so"))
    pointer = ctypes.POINTER(kind)
    library.run.restype = ctypes.c_double
    library.law_control.argtypes = [kind, pointer, pointer]
    given = t.ctypes.data_as(pointer), x.ctypes.data_as(pointer), len(t)
    library.run(*given, 1000)
    began = time.perf_counter()
    library.run(*given, _CALLS)
    seconds = (time.perf_counter() - began) / _CALLS
    u = np.empty((len(t), law.gains.shape[1]), dtype=real)
    for row, (time_, state) in zip(u, zip(t, x, strict=True), strict=True):
        library.law_control(time_, state.ctypes.data_as(pointer), row.ctypes.data_as(pointer))
    return seconds, u.astype(np.float64)

"""A law as C: one header and one source in C99, without a dependency, an allocation or a loop of
unknown length, and a test of its own.

    NAME.h         sizes, and  int NAME_control(t, x, u)
    NAME.c         the law's numbers as constants
    NAME_test.c    calls it where Python was asked, and prints the largest difference

Not even the C library is needed: the interval is found by bisection, angles are wrapped in
integers, a ball is projected onto by a bisection of 60 halvings.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from slipcar.planner.law import Law

Array = np.ndarray

#: Points at which the test compares with Python, and how far it may be off per 1 + |u|.
CASES = 200
TOLERANCE = {"double": 1e-9, "float": 1e-4}

_HEADER = """\
/* @NAME@: the control law of a plan, made by `slipcar export`.

     u(t, x) = P[ u_k + K_k wrap(x - mean_k) ],   k the interval that t lies in

   C99 and C++; no dependency, no allocation, bounded time. Do not compile it with -ffast-math. */
#ifndef @GUARD@_H
#define @GUARD@_H

#ifdef __cplusplus
extern "C" {
#endif

typedef @REAL@ @NAME@_real;

enum { @GUARD@_STATES = @n@, @GUARD@_CONTROLS = @m@, @GUARD@_INTERVALS = @K@ };

/* Writes the controls for state x at time t [s] to u, and returns the interval. Where t or x is not
   finite (or an angle is off by more than 1e6 turns) it returns -1, and u is the plan's own at the
   interval of t, the first one if t is not a number. */
int @NAME@_control(@NAME@_real t, const @NAME@_real x[@n@], @NAME@_real u[@m@]);

#ifdef __cplusplus
}
#endif

#endif
"""

_SOURCE = """\
/* @NAME@: made by `slipcar export`; see @NAME@.h. */
#include "@NAME@.h"

typedef @NAME@_real real;

enum { N = @n@, M = @m@, K = @K@ };

static const real times[K] = {@times@};
static const real planned[K][M] = {@controls@};
static const real mean[K][N] = {@mean@};
static const real gains[K][M][N] = {@gains@};
static const real lower[M] = {@lower@};
static const real upper[M] = {@upper@};
static const real slack = @slack@; /* an interval begins so early [s] */

static int interval_of(real t)
{
    int low = 0, high = K; /* times[low - 1] <= t + slack < times[high] */
    while (low < high) {
        const int middle = (low + high) / 2;
        if (times[middle] <= t + slack)
            low = middle + 1;
        else
            high = middle;
    }
    return low > 0 ? low - 1 : 0;
}

static real clipped(real value, int i)
{
    value = value < lower[i] ? lower[i] : value;
    return value > upper[i] ? upper[i] : value;
}
@WRAP@@BALL@
int @NAME@_control(@NAME@_real t, const @NAME@_real x[@n@], @NAME@_real u[@m@])
{
    const int k = interval_of(t);
    int good = t - t == 0;
    real error[N];
    int i, j;
    for (j = 0; j < N; ++j)
        error[j] = x[j] - mean[k][j];
@WRAPPED@    for (j = 0; j < N; ++j)
        good = good && error[j] - error[j] == 0;
    for (i = 0; i < M; ++i) {
        real sum = 0;
        for (j = 0; good && j < N; ++j)
            sum += gains[k][i][j] * error[j];
        u[i] = planned[k][i] + sum;
    }
    @PROJECT@
    return good ? k : -1;
}
"""

_WRAP = """
static int wrap(real *error)
{
    const real circle = @circle@, turns = *error / circle;
    long whole;
    real rest;
    if (!(turns > (real)-1e6 && turns < (real)1e6))
        return 0;
    whole = (long)turns;
    rest = turns - (real)whole; /* rounded to the nearest whole, halves to the even one */
    if (rest > (real)0.5 || (rest == (real)0.5 && whole % 2 != 0))
        ++whole;
    else if (rest < (real)-0.5 || (rest == (real)-0.5 && whole % 2 != 0))
        --whole;
    *error -= circle * (real)whole;
    return 1;
}
"""

_BALL = """
static const real radius = @radius@;

static int outside(const real u[M], real factor)
{
    real sum = 0;
    int i;
    for (i = 0; i < M; ++i)
        sum += clipped(factor * u[i], i) * clipped(factor * u[i], i);
    return sum > radius * radius;
}

static void project(real u[M])
{
    real low = 0, high = 1;
    int i;
    if (outside(u, 1)) {
        for (i = 0; i < 60; ++i) {
            const real middle = (low + high) / 2;
            if (outside(u, middle))
                high = middle;
            else
                low = middle;
        }
    } else {
        low = 1;
    }
    for (i = 0; i < M; ++i)
        u[i] = clipped(low * u[i], i);
}
"""
_CLIP = "for (i = 0; i < M; ++i)\n        u[i] = clipped(u[i], i);"

_TEST = """\
/* Compares @NAME@.c with what Python gave when it was exported:
     cc @NAME@.c @NAME@_test.c -o @NAME@_test && ./@NAME@_test */
#include <stdio.h>
#include "@NAME@.h"

enum { CASES = @cases@ };

static const @NAME@_real t[CASES] = {@t@};
static const @NAME@_real x[CASES][@n@] = {@x@};
static const double expected[CASES][@m@] = {@u@};

int main(void)
{
    double largest = 0;
    int c, i;
    for (c = 0; c < CASES; ++c) {
        @NAME@_real u[@m@];
        if (@NAME@_control(t[c], x[c], u) < 0)
            largest = 1e300;
        for (i = 0; i < @m@; ++i) {
            const double size = expected[c][i] < 0 ? -expected[c][i] : expected[c][i];
            const double off = ((double)u[i] - expected[c][i]) / (1 + size);
            largest = off > largest ? off : -off > largest ? -off : largest;
        }
    }
    printf("%d cases, largest difference per 1 + |u|: %.3g (allowed: @tolerance@)\\n", CASES,
           largest);
    return largest <= @tolerance@ ? 0 : 1;
}
"""


def c_files(law: Law, name: str, *, float32: bool = False) -> dict[str, str]:
    """Header, source and test of a law by file name.

    Args:
        law: what they compute.
        name: of the files, and of everything in the header.
        float32: in single precision instead of double.

    Raises:
        ValueError: if the name is no identifier of C, or a number is too large for float32.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,40}", name):
        raise ValueError(
            f"a law's name in C has small letters, digits and _, and begins with a letter: "
            f"not {name!r}"
        )
    real = "float" if float32 else "double"
    K, m, n = law.gains.shape
    ball = np.isfinite(law.radius)
    words = {
        "NAME": name, "GUARD": name.upper(), "REAL": real,
        "n": str(n), "m": str(m), "K": str(K),
        "times": _braced(law.times[:-1], real), "controls": _braced(law.controls, real),
        "mean": _braced(law.mean, real), "gains": _braced(law.gains, real),
        "lower": _braced(law.lower, real), "upper": _braced(law.upper, real),
        "slack": _number(law.slack, real), "circle": _number(2.0 * np.pi, real),
        "radius": _number(law.radius, real),
    }  # fmt: skip
    wrapped = "".join(f"    good = wrap(&error[{i}]) && good;\n" for i in law.angles)
    parts = {
        "WRAP": _WRAP if law.angles else "", "WRAPPED": wrapped,
        "BALL": _BALL if ball else "", "PROJECT": "project(u);" if ball else _CLIP,
    }  # fmt: skip
    source = _filled(_filled(_SOURCE, parts), words)
    return {
        f"{name}.h": _filled(_HEADER, words),
        f"{name}.c": source,
        f"{name}_test.c": _filled(_TEST, {**words, **_cases(law, real)}),
    }


def write_c(law: Law, folder: Path, name: str, *, float32: bool = False) -> list[Path]:
    """Write :func:`c_files` to a folder, which is made.

    Raises:
        OSError: if that cannot be done.
        ValueError: as :func:`c_files`.
    """
    files = c_files(law, name, float32=float32)
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        (folder / file).write_text(text, encoding="ascii")
    return [folder / file for file in files]


def _cases(law: Law, real: str) -> dict[str, str]:
    """Times and states round the plan, and far from it, and what the law gives there."""
    rng = np.random.default_rng(0)
    K, _, n = law.gains.shape
    interval = rng.integers(K, size=CASES)
    # Away from the borders: single precision may take a time for one on the other side.
    inside = 0.1 + 0.8 * rng.random(CASES)
    t = law.times[interval] + inside * (law.times[interval + 1] - law.times[interval])
    spread = 1.0 + np.abs(law.mean).max(axis=0)
    far = np.where(rng.random((CASES, 1)) < 0.5, 0.01, 1.0)
    x = law.mean[interval] + far * spread * rng.standard_normal((CASES, n))
    if real == "float":
        t, x = np.float32(t).astype(float), np.float32(x).astype(float)
    u = np.array([law.control(*case) for case in zip(t, x, strict=True)])
    tolerance = f"{TOLERANCE[real]:g}"
    return {
        "cases": str(CASES), "t": _braced(t, real), "x": _braced(x, real),
        "u": _braced(u, "double"), "tolerance": tolerance,
    }  # fmt: skip


def _filled(text: str, words: dict[str, str]) -> str:
    return re.sub(r"@(\w+)@", lambda found: words.get(found[1], found[0]), text)


def _braced(values: Array, real: str) -> str:
    """A C initialiser, a line a row."""
    if values.ndim == 1:
        return _wrapped(_number(value, real) for value in values)
    return "\n" + ",\n".join(f"    {{{_braced(row, real).strip()}}}" for row in values)


def _wrapped(numbers: Iterable[str]) -> str:
    listed = list(numbers)
    rows = [", ".join(listed[i : i + 8]) for i in range(0, len(listed), 8)]
    return ",\n    ".join(rows)


def _number(value: float, real: str) -> str:
    """A literal that reads back as the same number; what is unbounded is the largest there is."""
    kind = np.float32 if real == "float" else np.float64
    largest = np.finfo(kind).max
    if np.isfinite(value) and abs(value) > largest:
        raise ValueError(f"{value:g} is too large for float32: export in double precision")
    text = repr(float(np.clip(value, -float(largest), float(largest))))
    if real == "float":
        text = np.format_float_scientific(np.float32(text), unique=True)
    text = text if any(c in text for c in ".e") else f"{text}.0"
    return f"{text.replace('.e', '.0e')}f" if real == "float" else text

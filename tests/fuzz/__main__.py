"""The campaign: so many random inputs of every idea, every finding, exit 1 if there are any.

`make fuzz ARGS="--count 1000 --seed 3 --only problems"`; an input that a finding prints is tried
again by `make fuzz ARGS="--only problems --input '(Recipe(seed=3), {})'"`.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections import Counter
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings

from . import inputs, ipopt
from .ideas import IDEAS, Idea, Scope

#: Examples of a finding that are printed.
SHOWN = 2


def run(name: str, idea: Idea, count: int, scope: Scope) -> int:
    """Try an idea; print findings with their inputs as they are made; how many inputs had any."""
    sorts: Counter[str] = Counter()
    bad, done, began, told = 0, 0, time.perf_counter(), time.perf_counter()

    @seed(scope.seed)
    @settings(
        max_examples=count, database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(idea.inputs(scope))
    def each(case: Any) -> None:
        nonlocal bad, done, told
        begun = time.perf_counter()
        found = idea.check(case)
        done, bad = done + 1, bad + bool(found)
        for finding in found:
            sorts[_sort(finding)] += 1
            if sorts[_sort(finding)] <= SHOWN:
                print(f"  {finding}\n    {case!r}", flush=True)
        if (took := time.perf_counter() - begun) > 10.0:
            print(f"  {took:.0f} s: {case!r}", flush=True)
        if time.perf_counter() - told > 60.0:
            told = time.perf_counter()
            print(f"  ... {done} inputs, {bad} with findings, {told - began:.0f} s", flush=True)

    print(f"{name}:", flush=True)
    each()
    print(f"{name}: {done} inputs, {bad} with findings, {time.perf_counter() - began:.0f} s")
    for sort, times in sorts.most_common():
        print(f"  {times:5d} x {sort}", flush=True)
    return bad


def _sort(finding: str) -> str:
    """A finding without its numbers."""
    return re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "#", finding)[:70]


def main() -> int:
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="inputs, over all ideas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", type=int, default=120, help="structures of problems")
    parser.add_argument("--only", nargs="+", choices=sorted(IDEAS), default=sorted(IDEAS))
    parser.add_argument("--input", help="one input of one idea, as a finding prints it")
    asked = parser.parse_args()
    if asked.input:
        found = IDEAS[asked.only[0]].check(eval(asked.input, vars(inputs)))
        print(*(found or ["nothing found"]), sep="\n")
        return 1 if found else 0
    if ipopt.MISSING:
        print(f"INFEASIBLE is not asked of IPOPT: {ipopt.MISSING}")
    shares = sum(IDEAS[name].share for name in asked.only)
    bad = 0
    for name in asked.only:
        count = max(1, round(asked.count * IDEAS[name].share / shares))
        bad += run(name, IDEAS[name], count, Scope(asked.kinds, asked.seed))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())

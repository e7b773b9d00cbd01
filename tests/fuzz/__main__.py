"""The campaign: so many random inputs of every idea, all findings, exit 1 if there are any.

cd tests && python -m fuzz --count 1000 --seed 0 --only problems worlds
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings

from .ideas import IDEAS, Idea

#: Examples of a finding that are printed.
SHOWN = 2


def run(name: str, idea: Idea, count: int, kinds: int, number: int) -> int:
    """Try an idea; print each finding with its input when it is made; return how many inputs had any."""
    kinds_found: Counter[str] = Counter()
    bad, done, began = 0, 0, time.perf_counter()

    @seed(number)
    @settings(
        max_examples=count, database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(idea.inputs(kinds, number))
    def each(case: Any) -> None:
        nonlocal bad, done
        begun = time.perf_counter()
        found = idea.check(case)
        done, bad = done + 1, bad + bool(found)
        for finding in found:
            kinds_found[_sort(finding)] += 1
            if kinds_found[_sort(finding)] <= SHOWN:
                print(f"  {finding}\n    {case!r}", flush=True)
        if (took := time.perf_counter() - begun) > 10.0:
            print(f"  {took:.0f} s: {case!r}", flush=True)

    print(f"{name}:", flush=True)
    each()
    print(f"{name}: {done} inputs, {bad} with findings, {time.perf_counter() - began:.0f} s")
    for sort, times in kinds_found.most_common():
        print(f"  {times:5d} x {sort}", flush=True)
    return bad


def _sort(finding: str) -> str:
    """A finding without its numbers."""
    return "".join("#" if c.isdigit() else c for c in finding)[:60].replace("##", "#")


def main() -> int:
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="inputs, over all ideas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", type=int, default=120, help="structures of problems")
    parser.add_argument("--only", nargs="+", choices=sorted(IDEAS), default=sorted(IDEAS))
    asked = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    shares = sum(IDEAS[name].share for name in asked.only)
    bad = 0
    for name in asked.only:
        count = max(1, round(asked.count * IDEAS[name].share / shares))
        bad += run(name, IDEAS[name], count, asked.kinds, asked.seed)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())

"""Measure on the command line, a row at a time: python -m benchmarks.systems default Arm CSTR."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from . import measure
from .catalogue import SYSTEMS


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.systems", description=__doc__)
    parser.add_argument(
        "what",
        nargs="?",
        default="default",
        choices=("default", "guesses", "units", "all"),
        help="the default call beside IPOPT; disturbed guesses; other units",
    )
    parser.add_argument("names", nargs="*", help=f"systems, of {' '.join(SYSTEMS)}")
    parser.add_argument("--count", type=int, default=measure.GUESSES, help="disturbed guesses")
    parser.add_argument("--own", action="store_true", help="disturbed guesses as initial_guess")
    parser.add_argument("--fresh", action="store_true", help="default: time IPOPT anew")
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path("results/bench/systems-ipopt"),
        help="of IPOPT's answers (default: %(default)s)",
    )
    asked = parser.parse_args()
    for what in ("default", "guesses", "units") if asked.what == "all" else (asked.what,):
        names = measure.chosen(asked.names, what)
        if what == "default":
            records: Iterable[Any] = measure.default(names, None if asked.fresh else asked.folder)
        elif what == "guesses":
            records = measure.guesses(names, asked.folder, asked.count, own=asked.own)
        else:
            records = measure.units(names)
        print(f"\n{what}", flush=True)
        for number, record in enumerate(records):
            row = record.row()
            widths = [max(len(key), _WIDTHS.get(key, 9)) for key in row]
            if number == 0:
                print("  ".join(k.rjust(w) for k, w in zip(row, widths, strict=True)))
            cells = zip(row.values(), widths, strict=True)
            print("  ".join(str(v).rjust(w) for v, w in cells), flush=True)


_WIDTHS = {"system": 11, "status": 13, "status there": 13, "cost": 10, "how": 3, "certified": 3,
           "IPOPT": 10, "units": 10}  # fmt: skip

if __name__ == "__main__":
    main()

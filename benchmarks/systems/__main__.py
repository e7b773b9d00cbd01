"""Measure on the command line, a row at a time: python -m benchmarks.systems default Arm CSTR."""

from __future__ import annotations

import argparse
from pathlib import Path

from . import measure_default, measure_guesses, measure_units
from .catalogue import IN_UNITS, SYSTEMS, chosen
from .table import printed

WHAT = ("default", "guesses", "units")


def main() -> None:
    asked = _arguments()
    for what in WHAT if asked.what == "all" else (asked.what,):
        print(f"\n{what}", flush=True)
        names = asked.names or list(IN_UNITS if what == "units" else SYSTEMS)
        if what == "default":
            lines = measure_default.summary(list(printed(measure_default.measure(names))))
        elif what == "guesses":
            found = measure_guesses.measure(names, asked.folder, asked.count, own=asked.own)
            lines = measure_guesses.summary(list(printed(found)))
        else:
            lines = measure_units.summary(list(printed(measure_units.measure(names))))
        print("\n".join(lines), flush=True)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.systems", description=__doc__)
    parser.add_argument(
        "what",
        nargs="?",
        default="default",
        choices=(*WHAT, "all"),
        help="the default call beside IPOPT; disturbed guesses; other units",
    )
    parser.add_argument(
        "names", nargs="*", help=f"beginnings of systems' names, of {' '.join(SYSTEMS)}"
    )
    parser.add_argument("--count", type=int, default=measure_guesses.COUNT, help="guesses of each")
    parser.add_argument("--own", action="store_true", help="disturbed guesses as initial_guess()")
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path("results/bench/systems-ipopt"),
        help="of IPOPT's answers (default: %(default)s)",
    )
    asked = parser.parse_args()
    try:
        asked.names = chosen(asked.names)
    except ValueError as error:
        parser.error(str(error))
    return asked


if __name__ == "__main__":
    main()

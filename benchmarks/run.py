"""All benchmarks in one run on one machine: `make bench`.

Absolute numbers belong to the machine they are printed with; what carries over are ratios within
the run. Tables, figure and every single time go to the folder.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import cold
import growth
import peers
import planners
import report
import simulation
import turns
import worlds

PARTS = ("planners", "growth", "cold", "simulation")
#: Minutes; on request.
LONG_PARTS = ("worlds",)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only",
        choices=PARTS + LONG_PARTS,
        nargs="+",
        default=PARTS,
        help="parts to run (default: %(default)s)",
    )
    parser.add_argument("--seeds", type=int, default=worlds.SEEDS, help="random worlds")
    parser.add_argument("--rounds", type=int, default=turns.ROUNDS, help="plans per contender")
    parser.add_argument(
        "--peers-python",
        default=peers.default_python(),
        metavar="PYTHON",
        help="interpreter that has crocoddyl and OpenSCvx (default: %(default)s)",
    )
    parser.add_argument("--folder", type=Path, default=Path("results/bench"), help="for results")
    arguments = parser.parse_args()
    if arguments.rounds < 1:
        parser.error(f"--rounds must be at least 1, not {arguments.rounds}")
    if arguments.seeds < 1:
        parser.error(f"--seeds must be at least 1, not {arguments.seeds}")
    began = time.perf_counter()
    tables: dict[str, report.Table] = {}
    notes: list[str] = []
    raw: dict[str, Any] = {"rounds": arguments.rounds, "skipped": {}, "seconds": {}}

    if "planners" in arguments.only:
        timings, skipped = planners.measure(arguments.rounds, arguments.peers_python)
        tables["Planning, paper case, N = 41, warm"] = planners.rows(timings)
        tables["How many times as long as ours the others take"] = planners.ratios(timings)
        notes += planners.disagreements(timings)
        raw["skipped"] |= skipped
        raw["seconds"]["planners"] = {
            f"{t.contender.name}, {t.contender.tolerance}": t.seconds.tolist() for t in timings
        }
    if "growth" in arguments.only:
        curves, skipped = growth.measure(max(arguments.rounds // 2, 1))
        tables["Growth with the number of nodes"] = growth.rows(curves)
        tables["Exponents p of ms ∝ N^p"] = growth.fits(curves)
        raw["skipped"] |= skipped
        raw["seconds"]["growth"] = {
            curve.name: {
                N: t.seconds.tolist() for N, t in zip(curve.nodes, curve.timings, strict=True)
            }
            for curve in curves
        }
        notes += [f"Figure: {path}" for path in growth.draw(curves, arguments.folder)]
    if "cold" in arguments.only:
        tables["Cold start"] = cold.rows()
    if "simulation" in arguments.only:
        tables["Environment, features observation"] = simulation.environment_rows()
        tables["Evaluation"] = simulation.evaluation_rows()
    if "worlds" in arguments.only:
        found = worlds.measure(arguments.seeds, arguments.folder)
        tables["Random worlds"] = worlds.rows(found)
        raw["worlds"] = worlds.raw(found)
        notes += worlds.notes(found)
        notes += [f"Figure: {path}" for path in worlds.draw(found, arguments.folder)]

    notes += [f"skipped {name}: {why}" for name, why in raw["skipped"].items()]
    told = report.where()
    text = report.markdown(tables, told, notes)
    print(text)
    # Worlds alone leave the tables of the other parts in place.
    name = "worlds" if set(arguments.only) == {"worlds"} else "bench"
    written = report.save(arguments.folder, tables, told, text, raw, name)
    print(f"written: {', '.join(map(str, written))} ({time.perf_counter() - began:.0f} s)")


if __name__ == "__main__":
    main()

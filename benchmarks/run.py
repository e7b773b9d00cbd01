"""All benchmarks in one run on one machine: `make bench`; into the docs: `make bench-docs`.

Absolute numbers belong to the machine they are printed with; what carries over are ratios within
the run. Tables, figures and every single time go to the folder, a file for each part.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable
from pathlib import Path

import c_law
import cold
import control_loop
import environment
import growth
import live_page
import page
import peers
import planners
import report
import risk_paper
import risk_path
import risk_times
import risk_worlds
import simulation
import systems.section
import turns
import which_way
import worlds

PARTS = ("planners", "growth", "cold", "simulation", "environment", "risk_times")
#: Minutes; on request.
LONG_PARTS = (
    "worlds", "systems", "which_way", "risk_paper", "risk_path", "risk",
    "live_page", "control_loop", "c_law",
)  # fmt: skip
#: Pages of the docs: file, heading and parts.
PAGES = (
    ("benchmarks.md", "Benchmarks", ("planners", "growth", "cold", "simulation", "worlds")),
    (
        "benchmarks-risk.md",
        "Benchmarks: risk, feedback, receding horizon",
        ("risk_paper", "risk_path", "risk_times", "risk"),
    ),
    ("benchmarks-systems.md", "Benchmarks: users' systems", ("systems", "which_way")),
    (
        "benchmarks-live.md",
        "Benchmarks: live page, control loop, C",
        ("live_page", "control_loop", "c_law"),
    ),
    ("benchmarks-environment.md", "Benchmarks: environment", ("environment",)),
)


def main() -> None:
    arguments = _arguments()
    folder = arguments.folder
    sections: dict[str, Callable[[], report.Section]] = {
        "planners": functools.partial(planners.section, arguments.rounds, arguments.peers_python),
        "growth": functools.partial(growth.section, max(arguments.rounds // 2, 1), folder),
        "cold": cold.section,
        "simulation": simulation.section,
        "environment": environment.section,
        "risk_times": functools.partial(risk_times.section, arguments.rounds),
        "worlds": functools.partial(worlds.section, arguments.seeds, folder),
        "systems": functools.partial(systems.section.section, folder),
        "which_way": functools.partial(which_way.section, folder),
        "risk_paper": risk_paper.section,
        "live_page": live_page.section,
        "control_loop": control_loop.section,
        "c_law": c_law.section,
        "risk_path": risk_path.section,
        "risk": functools.partial(risk_worlds.section, arguments.risk_worlds, folder),
    }
    for part in arguments.only:
        began = time.perf_counter()
        told = report.where()
        section = sections[part]()
        print(report.markdown(section, told))
        written = report.save(folder, section, told)
        print(f"written: {', '.join(map(str, written))} ({time.perf_counter() - began:.0f} s)\n")
    for name, title, parts in PAGES if arguments.docs else ():
        if set(parts) & set(arguments.only):
            pages = page.write(folder, parts, name=name, title=title)
            print(f"written: {', '.join(map(str, pages))}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only",
        choices=PARTS + LONG_PARTS,
        nargs="*",
        help=f"parts to run (default: {' '.join(PARTS)}, all with --docs)",
    )
    parser.add_argument(
        "--docs",
        action="store_true",
        help="write the pages of docs/ that the parts belong to, the other parts from the folder",
    )
    parser.add_argument("--seeds", type=int, default=worlds.SEEDS, help="random worlds")
    parser.add_argument(
        "--risk-worlds",
        type=int,
        default=risk_worlds.WORLDS,
        help="random worlds of either family for the risk (default: %(default)s)",
    )
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
    if arguments.risk_worlds < 1:
        parser.error(f"--risk-worlds must be at least 1, not {arguments.risk_worlds}")
    if arguments.only is None:
        arguments.only = PARTS + LONG_PARTS if arguments.docs else PARTS
    return arguments


if __name__ == "__main__":
    main()

"""All benchmarks in one run on one machine: `make bench`.

Absolute numbers belong to the machine they are printed with; what carries over are ratios
within the run.
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path

import pandas as pd
import planners
import simulation


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=planners.ROUNDS, help="plans per solver")
    parser.add_argument("--out", type=Path, default=Path("results/bench.json"), help="JSON file")
    arguments = parser.parse_args()
    tables = {
        "planning, paper case, N = 41, warm": planners.rows(arguments.rounds),
        "environment, features observation": simulation.environment_rows(),
        "evaluation": simulation.evaluation_rows(),
    }
    cpu = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next(line.split(":")[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        pass
    print(f"Python {platform.python_version()}, {cpu}\n")
    for title, rows in tables.items():
        print(f"## {title}\n\n{pd.DataFrame(rows).to_markdown(index=False, floatfmt='.4g')}\n")
    ours = {row["planner"]: row["ms (median)"] for row in next(iter(tables.values()))}
    ipopt = ours.get(planners.IPOPT)
    if ipopt is not None:
        for name in ours:
            print(f"{name}: {ipopt / ours[name]:.2f} x as fast as CasADi + IPOPT in this run")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps({"cpu": cpu, "tables": tables}, indent=1))
    print(f"written: {arguments.out}")


if __name__ == "__main__":
    main()

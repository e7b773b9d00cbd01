"""Kill a comparison at random moments, again and again: nothing finished may be lost.

    python benchmarks/kills.py                      20 kills of a small suite, some minutes
    python benchmarks/kills.py --kills 50 --seed 3

One run is left alone. The other is killed (SIGKILL, the whole process group: planner, workers and
all) after a random time, started again with the same command, and so on; after the last kill it
may finish. Checked each time: every file that had its final name is whole, and none has gone. In
the end: the tables are the same bytes, and nothing that was finished was computed twice.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

TABLES = ("table.csv", "cells.csv")


def command(folder: Path, arguments: list[str]) -> list[str]:
    return [
        *(sys.executable, "-m", "slipcar.evaluation", "compare", "--folder", str(folder)),
        *arguments,
    ]


def cells(folder: Path) -> dict[str, bytes]:
    """Name -> content of the finished cells; raises if one is not whole."""
    found = {}
    for path in sorted((folder / "cells").glob("*.npz")):
        with np.load(path, allow_pickle=False) as data:
            for name in data.files:
                data[name]  # reads it: a half-written file raises
        found[path.name] = path.read_bytes()
    return found


def same_tables(one: Path, other: Path) -> None:
    for name in TABLES:
        assert (one / name).read_bytes() == (other / name).read_bytes(), f"{name} differs"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    arguments = ["--suite", "horizon", "--episodes", "8192", "--no-figures"]
    arguments += ["--workers", str(options.workers)]
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as place:
        calm, killed = Path(place) / "calm", Path(place) / "killed"
        began = time.monotonic()
        subprocess.run(command(calm, arguments), check=True, stdout=subprocess.DEVNULL)
        whole = time.monotonic() - began
        began = time.monotonic()
        subprocess.run(command(calm, arguments), check=True, stdout=subprocess.DEVNULL)
        idle = time.monotonic() - began
        print(
            f"undisturbed: {whole:.1f} s, {len(cells(calm))} cells; {idle:.1f} s to find them all "
            "done",
            flush=True,
        )
        before: dict[str, bytes] = {}
        kill = 0
        while kill < options.kills:
            run = subprocess.Popen(
                command(killed, arguments),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            # Some kills fall into the start; most into the work, a little of which is done then.
            wait = idle * rng.uniform(0.3, 1.0) + rng.uniform(0.0, 3.0 * whole / options.kills)
            try:
                run.wait(timeout=wait)
            except subprocess.TimeoutExpired:
                os.killpg(run.pid, signal.SIGKILL)
                run.wait()
            else:  # it was done before: what it made must be right, and all begins anew
                same_tables(calm, killed)
                shutil.rmtree(killed)
                before = {}
                print("finished, the same tables; once more from nothing", flush=True)
                continue
            kill += 1
            now = cells(killed)
            lost = [name for name in before if now.get(name) != before[name]]
            assert not lost, f"kill {kill}: lost or changed {lost}"
            print(f"kill {kill}, after {wait:.1f} s: {len(now)} cells, none lost", flush=True)
            before = now
        subprocess.run(command(killed, arguments), check=True, stdout=subprocess.DEVNULL)
        assert all(cells(killed)[name] == content for name, content in before.items())
        same_tables(calm, killed)
        left = [str(path) for path in killed.rglob(".*")]
        assert not left, f"half-written files: {left}"
        print(f"{', '.join(TABLES)}: the same bytes; no half-written file")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

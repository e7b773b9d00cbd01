"""Two workers of Dask against two of loky: the same suite, the same bytes, the ratio of times.

    python benchmarks/cluster.py

The paper's table with every row, computed from nothing by either; times include starting the
workers. Both once before, so that nothing is compiled in what is measured.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from joblib.externals.loky import get_reusable_executor

from slipcar.envs import Scenario
from slipcar.evaluation import compare
from slipcar.evaluation.rows import REFERENCE, default_rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3, help="the best of so many")
    options = parser.parse_args()
    paper = Scenario.named("paper")
    rows, _ = default_rows(paper)

    def run(cluster: str, episodes: int) -> tuple[float, bytes]:
        # loky would keep its workers from one round to the next, Dask's are new each time.
        get_reusable_executor().shutdown(wait=True, kill_workers=True)
        began = time.perf_counter()
        done = compare(
            rows,
            paper,
            episodes,
            reference=REFERENCE,
            n_jobs=options.workers,
            cluster=cluster,
            progress=False,
        )
        seconds = time.perf_counter() - began
        assert not done.errors, done.errors
        with tempfile.TemporaryDirectory() as place:
            done.save(place, figures=False)
            return seconds, (Path(place) / "table.csv").read_bytes()

    times: dict[str, float] = {}
    tables = {}
    for cluster in ("loky", "dask"):
        run(cluster, 1024 * options.workers)
    for _ in range(options.rounds):
        for cluster in ("loky", "dask"):
            seconds, tables[cluster] = run(cluster, options.episodes)
            times[cluster] = min(seconds, times.get(cluster, seconds))
            print(f"{cluster}: {seconds:.1f} s", flush=True)
    same = tables["loky"] == tables["dask"]
    print(
        f"{options.workers} workers, {options.episodes:,} episodes, {len(rows)} rows: loky "
        f"{times['loky']:.1f} s, Dask {times['dask']:.1f} s, ratio "
        f"{times['dask'] / times['loky']:.2f}; table.csv {'the same bytes' if same else 'DIFFERS'}"
    )
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())

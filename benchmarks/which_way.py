"""Which guess, which way: `plan(starts=k)` beside the best of many IPOPT starts, world by world.

    python benchmarks/which_way.py --worlds 50 --obstacles 8 --starts 1 8 16

The deterministic problem (w = 0). IPOPT starts from the scenario's own guess and from random
smooth paths, none of which the planner sees; its answers are kept on disk. Times are minima over
repetitions of the call, in this process, kernels compiled and traces known.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from report import Section

from slipcar.envs import Scenario, routes
from slipcar.planner import plan

#: Starts of IPOPT in each world, and the standard deviation of a random path's first half wave, in
#: parts of the distance; the k-th has a k-th of it.
PEER_STARTS, BUMP, WAVES = 30, 0.7, 3
#: What is dearer by no more counts as good.
GOOD, WORST = 1.01, 1.1
#: Of the docs' table.
WORLDS, COUNTS = 50, (1, 8, 16)
ABOUT = """\
Random worlds of eight obstacles, no noise (w = 0): the cost of `plan(world, starts=k)` beside the
best that is known, IPOPT's best of thirty guesses (the world's own and random smooth paths, which
the planner does not see) or ours. Shares of the worlds in which a plan is at most 1 % and 10 %
dearer, the worst ratio, iterations over all starts, and the median time of a call.
"""


@dataclasses.dataclass(frozen=True)
class Row:
    """One number of starts: what it cost against the best known, and the time of each call [s]."""

    starts: int
    ratios: np.ndarray
    seconds: np.ndarray
    iterations: np.ndarray

    def cells(self) -> dict[str, str]:
        """A row of the docs' table."""
        return {
            "starts": str(self.starts),
            f"<= {GOOD}": f"{np.mean(self.ratios <= GOOD):.0%}",
            f"<= {WORST}": f"{np.mean(self.ratios <= WORST):.0%}",
            "worst": f"{self.ratios.max():.3f}",
            "iterations": f"{self.iterations.mean():.0f}",
            "ms": f"{1e3 * np.median(self.seconds):.1f}",
        }

    def line(self) -> str:
        """Shares of good and acceptable worlds, the worst with their seeds, and times."""
        good, fair = np.mean(self.ratios <= GOOD), np.mean(self.ratios <= WORST)
        dear = [i for i in np.argsort(-self.ratios) if self.ratios[i] > GOOD]
        named = ", ".join(f"{i}: {self.ratios[i]:.3f}" for i in dear[:12])
        ms = 1e3 * self.seconds
        return (
            f"starts={self.starts:<3} ≤ {GOOD}: {good:6.1%}   ≤ {WORST}: {fair:6.1%}   "
            f"worst {self.ratios.max():.3f}   ms {np.median(ms):6.2f} (mean {ms.mean():.2f}, max "
            f"{ms.max():.1f})   iterations {self.iterations.mean():.0f}   [{named}]"
        )


def random_guess(scenario: Scenario, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A smooth random path past the straight line, driven in one of the gears."""
    rng = np.random.default_rng(seed)
    s = scenario.times / scenario.horizon
    along = scenario.goal[:2] - scenario.start[:2]
    sideways = np.array([-along[1], along[0]])
    order = np.arange(1, WAVES + 1)
    offset = np.sin(np.pi * np.outer(s, order)) @ (rng.normal(0.0, BUMP, WAVES) / order)
    path = scenario.start[:2] + np.outer(s, along) + np.outer(offset, sideways)
    travel = math.atan2(*(path[1] - path[0])[::-1])
    middle = 0.5 * (scenario.start[2] + scenario.goal[2])
    half_turns = round((middle - travel) / math.pi) + (int(rng.integers(-1, 2)) if seed % 3 else 0)
    return routes.trajectory(scenario, path, half_turns)


def best_of_peer(scenario: Scenario, folder: Path, count: int) -> float:
    """The least cost that IPOPT finds from `count` guesses."""
    from systems.judge import judge  # needs CasADi
    from systems.memory import solved
    from systems.transcription import Programme

    programme = Programme(scenario, tolerance=1e-8)
    costs = [math.inf]
    for seed in range(count):
        guess = None if seed == 0 else random_guess(scenario, seed)
        answer = solved(programme, guess, folder)
        judged = judge(scenario, answer.states, answer.controls)
        if answer.converged and judged.feasible:
            costs.append(judged.cost)
    return min(costs)


def measure(
    worlds: Sequence[Scenario], folder: Path, counts: Sequence[int], repeats: int
) -> list[Row]:
    """A row for each number of starts."""
    best = np.array([best_of_peer(world, folder, PEER_STARTS) for world in worlds])
    costs, seconds, iterations = (np.full((len(counts), len(worlds)), np.inf) for _ in range(3))
    for i, world in enumerate(worlds):
        for _ in range(repeats):
            for j, starts in enumerate(counts):
                began = time.perf_counter()
                found = plan(world, starts=starts, variance_weight=0.0)
                seconds[j, i] = min(seconds[j, i], time.perf_counter() - began)
                costs[j, i] = found.cost if found.status.ok else np.inf
                rows = found.alternatives or ()
                iterations[j, i] = sum(row.iterations for row in rows) or found.iterations
    known = np.minimum(best, costs.min(axis=0))
    print(f"{len(worlds)} worlds; the best plan beats IPOPT's best in "
          f"{int((costs.min(axis=0) < best / GOOD).sum())}")  # fmt: skip
    return [Row(k, costs[j] / known, seconds[j], iterations[j]) for j, k in enumerate(counts)]


def section(folder: Path) -> Section:
    """Worlds of eight obstacles, of two kinds; IPOPT's answers are kept in the folder."""
    tables, raw = {}, {}
    for title, turned in (("Start and goal ahead", False), ("Start and goal turned anyhow", True)):
        worlds = [Scenario.random(seed, obstacles=8, turned=turned) for seed in range(WORLDS)]
        rows = measure(worlds, folder / "which-way-ipopt", COUNTS, repeats=3)
        tables[title] = [row.cells() for row in rows]
        raw[title] = [{**row.cells(), "ratios": row.ratios.tolist()} for row in rows]
    return Section("which_way", "Which way round", ABOUT, tables, raw=raw)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--obstacles", type=int, default=8)
    parser.add_argument("--turned", action="store_true", help="start and goal turned anyhow")
    parser.add_argument("--starts", type=int, nargs="+", default=[1, 8, 16])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=Path("results/bench/which-way-ipopt"))
    asked = parser.parse_args()
    worlds = [
        Scenario.random(seed, obstacles=asked.obstacles, turned=asked.turned)
        for seed in range(asked.first, asked.first + asked.worlds)
    ]
    for row in measure(worlds, asked.folder, asked.starts, asked.repeats):
        print(row.line())


if __name__ == "__main__":
    main()

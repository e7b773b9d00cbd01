"""How the time for a plan grows with the number of nodes N, with fitted exponents.

    log ms = log c + p log N,  least squares over the medians

A method with banded linear algebra has p near 1 if its number of iterations does not grow.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import ours
from contenders import Contender, available, judge
from report import Section
from turns import Timing, take_turns

from slipcar.envs import Scenario

ABOUT = """\
The paper's case on finer and finer grids, w = 0, every solver to an answer of the same exactness:
costs agree to six digits. All sizes and solvers take turns in one run. The exponent p of ms ∝ N^p
is that of the least-squares line through the medians; the steepest piece shows what a line hides.
"""

NODES = (41, 81, 161, 321, 641)


@dataclasses.dataclass(frozen=True)
class Curve:
    """One contender over N.

    Attributes:
        name: of the contender.
        nodes: N, ascending.
        timings: one for each.
    """

    name: str
    nodes: tuple[int, ...]
    timings: tuple[Timing, ...]

    @property
    def medians(self) -> np.ndarray:
        """Median ms, (len(nodes),)."""
        return np.array([timing.ms[1] for timing in self.timings])


def measure(rounds: int, nodes: Sequence[int] = NODES) -> tuple[list[Curve], dict[str, str]]:
    """Time every contender at every N, all of them in turns."""
    contenders: list[tuple[int, Contender]] = []
    skipped: dict[str, str] = {}
    for N in nodes:
        found, missing = available(
            makers(Scenario.named("paper").replace(nodes=N)), _told_once(skipped)
        )
        contenders += [(N, contender) for contender in found]
        skipped |= missing
    timings = take_turns([contender for _, contender in contenders], rounds, "growth")
    curves: dict[str, list[tuple[int, Timing]]] = {}
    for (N, contender), timing in zip(contenders, timings, strict=True):
        curves.setdefault(contender.name, []).append((N, timing))
    return [Curve(name, *zip(*points, strict=True)) for name, points in curves.items()], skipped


def section(rounds: int, folder: Path) -> Section:
    """All of it, to be printed and kept; the figure goes to the folder."""
    curves, skipped = measure(rounds)
    draw(curves, folder)
    return Section(
        part="growth",
        title="Growth with the number of nodes",
        about=ABOUT,
        tables={
            "Exponents p of ms ∝ N^p": fits(curves),
            "Milliseconds per plan by N": rows(curves),
        },
        figures=("growth",),
        notes=tuple(f"skipped {name}: {why}" for name, why in skipped.items()),
        raw={
            "rounds": rounds,
            "seconds": {
                curve.name: {
                    str(N): t.seconds.tolist()
                    for N, t in zip(curve.nodes, curve.timings, strict=True)
                }
                for curve in curves
            },
        },
    )


def exponent(nodes: Sequence[int], ms: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Slope p and intercept log c of the least-squares line through (log N, log ms)."""
    slope, intercept = np.polyfit(np.log(nodes), np.log(ms), 1)
    return float(slope), float(intercept)


def rows(curves: Sequence[Curve]) -> list[dict[str, Any]]:
    """One row for each contender and N."""
    table = []
    for curve in curves:
        for N, timing in zip(curve.nodes, curve.timings, strict=True):
            judged = judge(Scenario.named("paper").replace(nodes=N), timing.answer.controls)
            table.append(
                {
                    "planner": curve.name,
                    "tolerance": timing.contender.tolerance,
                    "N": N,
                    **timing.columns(),
                    "ms per iteration": timing.ms[1] / timing.answer.iterations,
                    "effort + obstacle": judged.cost,
                    "misses goal by": judged.miss,
                    "iterations": timing.answer.iterations,
                    "status": "converged" if timing.answer.found else "not converged",
                    "built in [s]": timing.contender.build_seconds,
                }
            )
    return table


def fits(curves: Sequence[Curve]) -> list[dict[str, Any]]:
    """Exponents: of the fitted line, from end to end, and of the steepest piece.

    The steepest piece shows what a line hides: a solver that changes its ways at some N.
    """
    table = []
    for curve in curves:
        iterations = np.array([timing.answer.iterations for timing in curve.timings])
        pieces = np.diff(np.log(curve.medians)) / np.diff(np.log(curve.nodes))
        steepest = int(np.argmax(pieces))
        first, last = curve.nodes[0], curve.nodes[-1]
        ends = np.log(curve.medians[-1] / curve.medians[0]) / np.log(last / first)
        table.append(
            {
                "planner": curve.name,
                "fitted": exponent(curve.nodes, curve.medians)[0],
                f"{first} to {last}": float(ends),
                "steepest piece": float(pieces[steepest]),
                "from N": f"{curve.nodes[steepest]} to {curve.nodes[steepest + 1]}",
                "fitted, per iteration": exponent(curve.nodes, curve.medians / iterations)[0],
            }
        )
    return table


def draw(curves: Sequence[Curve], folder: Path) -> list[Path]:
    """Log-log plot with the fitted lines: growth.png and growth.pdf."""
    from matplotlib.ticker import LogLocator

    from slipcar.evaluation.figures.scene import PALETTE, new_figure, save_figure, style

    with style():
        figure = new_figure(5.6, 4.2)
        axes = figure.subplots()
        for curve, colour, marker in zip(curves, PALETTE, "osD^vP", strict=False):
            quartiles = np.array([timing.ms for timing in curve.timings])
            spread = np.abs(quartiles[:, [0, 2]].T - curve.medians)
            slope, intercept = exponent(curve.nodes, curve.medians)
            line = np.exp(intercept + slope * np.log(curve.nodes))
            axes.errorbar(
                curve.nodes, curve.medians, yerr=spread, fmt=marker, color=colour, markersize=4.5,
                capsize=2, elinewidth=0.8, label=f"{curve.name}: ms ∝ $N^{{{slope:.2f}}}$",
            )  # fmt: skip
            axes.plot(curve.nodes, line, color=colour, linewidth=0.9, linestyle=(0, (5, 2)))
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xticks(curves[0].nodes, [str(N) for N in curves[0].nodes])
        axes.minorticks_off()
        axes.set_xlabel("nodes N")
        axes.set_ylabel("time for a plan [ms]")
        figure.legend(loc="outside upper left", ncols=2)
        return save_figure(figure, folder, "growth")


def makers(scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    """The best ones, by name; tolerances alike."""
    found: dict[str, Callable[[], Contender]] = {
        "slipcar": lambda: ours.compiled(scenario, tolerance=ours.FINE_TOLERANCE),
        "slipcar, NumPy": lambda: ours.numpy(scenario, tolerance=ours.FINE_TOLERANCE),
        "slipcar, convex scheme": lambda: ours.convex(scenario, tolerance=ours.FINE_TOLERANCE),
    }

    def fatrop() -> Contender:
        import casadi_nlp

        return casadi_nlp.fatrop(scenario)

    def ipopt() -> Contender:
        import casadi_nlp

        return casadi_nlp.ipopt(scenario)

    return found | {"CasADi + fatrop": fatrop, "CasADi + IPOPT": ipopt}


def _told_once(already: dict[str, str]) -> Callable[[str], None]:
    """Print a skipped contender for the first N only."""
    return (lambda line: None) if already else print

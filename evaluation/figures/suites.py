"""Figures of the suites."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from slipcar.evaluation.figures.scene import GREY, PALETTE, new_figure, save_figure, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from slipcar.evaluation.metrics import Result
    from slipcar.evaluation.suites.records import SuiteResult

#: Marks that tell rows apart without colour.
_MARKERS = "osD^vPX*ph"


def _looks(result: SuiteResult) -> dict[str, dict[str, Any]]:
    looks = {}
    for i, row in enumerate(result.suite.rows):
        found = [r for (name, _), r in result.results.items() if name == row]
        if found:
            colour = PALETTE[i % len(PALETTE)]
            looks[row] = {
                "color": colour,
                "marker": _MARKERS[i % len(_MARKERS)],
                "markersize": 4.0,
                "markerfacecolor": colour if found[0].closed_loop else "white",
            }
    return looks


def random_figure(result: SuiteResult) -> Figure:
    """Worlds in order: cost relative to the reference row's, and collision rates."""
    with style():
        figure = new_figure(9.0, 4.4)
        left, right = figure.subplots(1, 2)
        base = _by_variant(result, result.suite.reference)
        for row, look in _looks(result).items():
            line = {"color": look["color"], "linewidth": 1.5}
            line["linestyle"] = "-" if look["markerfacecolor"] != "white" else (0, (4, 2))
            mine = _by_variant(result, row)
            ratios = np.sort([mine[k].total / base[k].total for k in mine if k in base])
            rates = np.sort([100.0 * found.collision_rate for found in mine.values()])
            left.plot(_share(ratios), ratios, label=row, **line)
            right.plot(_share(rates), rates, **line)
        left.axhline(1.0, color=GREY, linewidth=0.8, zorder=1)
        left.set_yscale("log")
        left.set_ylim(0.6, 12.0)
        _plain_log(left.yaxis, (0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0))
        left.set_ylabel(f"mean cost / that of “{result.suite.reference}”")
        right.set_yscale("symlog", linthresh=1.0)
        right.set_ylim(0.0, 100.0)
        _plain_log(right.yaxis, (0.0, 0.5, 1.0, 3.0, 10.0, 30.0, 100.0))
        right.set_ylabel("collision rate [%]")
        for axes in (left, right):
            axes.set_xlim(0.0, 100.0)
            axes.set_xlabel("worlds [%], sorted for each row")
        figure.legend(loc="outside upper center", ncols=3, handlelength=2.6)
    return figure


def slip_figure(result: SuiteResult) -> Figure:
    """Cost and collision rate against α², with intervals."""
    with style():
        figure = new_figure(9.0, 4.2)
        left, right = figure.subplots(1, 2)
        for row, look in _looks(result).items():
            mine = _by_value(result, row)
            values = np.array(sorted(mine))
            totals = np.array([mine[value].total for value in values])
            errors = 1.96 * np.nan_to_num([mine[value].total_se for value in values])
            rates = np.array([100.0 * mine[value].collision_rate for value in values])
            ends = 100.0 * np.array([mine[value].collision_interval for value in values])
            left.plot(values, totals, label=row, **look)
            left.fill_between(
                values, totals - errors, totals + errors, color=look["color"], alpha=0.15, lw=0.0
            )
            right.plot(values, rates, **look)
            right.fill_between(values, *ends.T, color=look["color"], alpha=0.15, lw=0.0)
        for axes in (left, right):
            axes.axvline(0.1, color=GREY, linewidth=0.8, linestyle=":", zorder=1)
            axes.set_xscale("symlog", linthresh=0.05, linscale=0.6)
            axes.set_xlim(left=0.0)
            ticks = sorted({variant.value for variant in result.suite.variants})
            shown = [tick for tick in ticks if tick in (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)]
            _plain_log(axes.xaxis, tuple(shown or ticks))
            axes.set_xlabel("slip α² (dotted: the paper's)")
        left.set_yscale("log")
        _plain_log(left.yaxis, (4.0, 5.0, 7.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0))
        left.set_ylabel("mean cost of a path")
        right.set_yscale("symlog", linthresh=1.0)
        right.set_ylim(0.0, 100.0)
        _plain_log(right.yaxis, (0.0, 0.5, 1.0, 3.0, 10.0, 30.0, 100.0))
        right.set_ylabel("collision rate [%]")
        figure.legend(loc="outside upper center", ncols=4)
    return figure


def horizon_figure(result: SuiteResult) -> Figure:
    """Cost, error at the goal and collisions against N: own grid dashed, fine solid."""
    panels = (
        ("total", 1.0, "mean cost of a path"),
        ("position_rms", 1.0, "position error at the goal, RMS [m]"),
        ("between_rate", 100.0, "collisions at or between nodes [%]"),
    )
    with style():
        figure = new_figure(10.0, 3.9)
        every = figure.subplots(1, len(panels))
        for row, look in _looks(result).items():
            for grid, line in (("own", (0, (3, 2))), ("fine", "-")):
                mine = _by_value(result, row, grid)
                values = np.array(sorted(mine))
                for axes, (metric, scale, _) in zip(every, panels, strict=True):
                    shown = [scale * getattr(mine[value], metric) for value in values]
                    label = row if grid == "fine" and axes is every[0] else None
                    axes.plot(values, shown, linestyle=line, label=label, **look)
        counts = sorted({variant.value for variant in result.suite.variants})
        for axes, (_, _, label) in zip(every, panels, strict=True):
            axes.set_xscale("log")
            _plain_log(axes.xaxis, tuple(counts))
            axes.set_xlabel("nodes N of the plan")
            axes.set_ylabel(label)
        every[0].set_yscale("log")
        _plain_log(every[0].yaxis, (4.0, 5.0, 6.0, 7.0, 10.0, 20.0, 50.0, 100.0))
        every[1].set_ylim(bottom=0.0)
        every[2].set_yscale("symlog", linthresh=1.0)
        every[2].set_ylim(0.0, 100.0)
        _plain_log(every[2].yaxis, (0.0, 0.5, 1.0, 3.0, 10.0, 30.0, 100.0))
        figure.legend(
            loc="outside upper center",
            ncols=3,
            title="dashed: on the plan's own grid, solid: in the fine simulation",
        )
    return figure


def _by_variant(result: SuiteResult, row: str) -> dict[str, Result]:
    return {label: found for (name, label), found in result.results.items() if name == row}


def _by_value(result: SuiteResult, row: str, grid: str | None = None) -> dict[float, Result]:
    found = {}
    for variant in result.suite.variants:
        here = "own" if variant.substeps == 1 else "fine"
        if grid in (None, here) and (row, variant.label) in result.results:
            found[variant.value] = result.results[row, variant.label]
    return found


def _share(values: np.ndarray) -> np.ndarray:
    """Where sorted values stand, in percent."""
    return 100.0 * (np.arange(len(values)) + 0.5) / max(1, len(values))


def _plain_log(axis: Any, ticks: tuple[float, ...]) -> None:
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


#: Suite -> what draws it.
FIGURES = {"random": random_figure, "slip": slip_figure, "horizon": horizon_figure}

__all__ = ["FIGURES", "horizon_figure", "random_figure", "save_figure", "slip_figure"]

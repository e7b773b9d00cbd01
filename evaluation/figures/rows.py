"""Figures of a whole comparison: cost against collisions, and how the cost is distributed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from slipcar.evaluation.comparison_record import ComparisonRecord
from slipcar.evaluation.figures.scene import PALETTE, PAPER, new_figure, style
from slipcar.evaluation.statistics import CONFIDENCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from slipcar.evaluation.metrics import Result

#: More than there are colours, so that no two rows look the same.
_MARKERS = "osD^vPX*ph"
#: Of open and closed loop, while colours last and when they come round again.
_LINES = (((0, (4, 2)), "-"), ((0, (1, 1.2)), (0, (7, 1.5, 1.5, 1.5))))
#: Rows that cost more than this many times the cheapest are named beside the axes, not drawn:
#: they would press all others into a corner.
OFF_AXES = 5.0
#: A distribution function is drawn through some so many points on a linear axis of shares, and on
#: a logarithmic one: a file does not grow with the episodes.
_MOST_DRAWN = 2000


def _looks(comparison: ComparisonRecord) -> dict[str, dict[str, Any]]:
    """Colour, marker and label of each finished row; filled and solid where the loop is closed."""
    results = comparison.results
    cheapest = min(result.total for result in results.values())
    looks = {}
    for i, (name, result) in enumerate(results.items()):
        colour = PALETTE[i % len(PALETTE)]
        loop = "closed loop" if result.closed_loop else "open loop"
        looks[name] = {
            "colour": colour,
            "marker": _MARKERS[i % len(_MARKERS)],
            "face": colour if result.closed_loop else PAPER,
            "line": _LINES[i // len(PALETTE) % 2][result.closed_loop],
            "label": name if loop in name.lower() else f"{name}, {loop}",
            "drawn": result.total <= OFF_AXES * cheapest,
        }
    return looks


def _off_axes_label(label: str, result: Result) -> str:
    cost = f"{result.total:,.0f}" if result.total >= 100.0 else f"{result.total:.3g}"
    return f"{label}, off the axes:\ncost {cost}, collisions {result.collision_rate:.1%}"


def tradeoff_figure(comparison: ComparisonRecord) -> Figure:
    """Total cost against collision rate, with 95 % intervals of both."""
    with style():
        figure = new_figure(8.8, 4.3)
        axes = figure.subplots()
        draw_tradeoff(axes, comparison)
        figure.legend(
            *axes.get_legend_handles_labels(),
            loc="outside right upper",
            title="filled: closed loop, hollow: open loop",
            alignment="left",
        )
    return figure


def draw_tradeoff(axes: Axes, comparison: ComparisonRecord) -> None:
    """Draw it into axes; the legend is the caller's."""
    for name, look in _looks(comparison).items():
        result = comparison.results[name]
        rate, at = result.collision_rate, 100.0 * result.collision_rate
        low, high = (100.0 * end for end in result.collision_interval)
        label, marker = look["label"], look["marker"]
        if rate == 0.0:
            # Nothing observed has no place on a logarithmic axis: it is shown at the
            # interval's upper end, pointing left.
            at = low = high
            marker, label = "<", f"{label}: none observed"
        if not look["drawn"]:
            label, marker, at = _off_axes_label(look["label"], result), look["marker"], np.nan
        axes.plot(
            at,
            result.total if look["drawn"] else np.nan,
            marker=marker,
            color=look["colour"],
            markerfacecolor=look["face"],
            markeredgewidth=1.5,
            markersize=7.5,
            linestyle="none",
            zorder=4,
            label=label,
        )
        if look["drawn"]:
            axes.errorbar(
                at,
                result.total,
                xerr=[[max(at - low, 0.0)], [max(high - at, 0.0)]],
                yerr=1.96 * np.nan_to_num(result.total_se),
                color=look["colour"],
                fmt="none",
                capsize=3.0,
                elinewidth=1.2,
                zorder=3,
            )
    axes.set_xscale("log")
    axes.margins(0.12)
    _plain_log_ticks(axes.xaxis)
    axes.set_xlabel(f"collision rate [%], {CONFIDENCE:.0%} interval")
    axes.set_ylabel(f"mean cost of a path, {CONFIDENCE:.0%} interval")


def _plain_log_ticks(axis: Any) -> None:
    """1, 2, 5, 10 … instead of powers, over the decade or two that is shown."""
    low, high = axis.get_view_interval()
    # On more than three decades the labels of 2 and 3 would touch.
    wide = low > 0.0 and high > 1e3 * low
    axis.set_major_locator(LogLocator(subs=(1.0, 3.0) if wide else (1.0, 2.0, 3.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def distributions_figure(comparison: ComparisonRecord) -> Figure:
    """How the cost of a path is distributed: its distribution function, and its tail."""
    with style():
        figure = new_figure(9.0, 3.9)
        left, right = figure.subplots(1, 2, sharex=True)
        for name, look in _looks(comparison).items():
            result = comparison.results[name]
            line = {"color": look["colour"], "linestyle": look["line"], "linewidth": 1.6}
            if not look["drawn"]:
                left.plot([], [], label=_off_axes_label(look["label"], result), **line)
                continue
            count = len(result.metrics)
            rank = drawn_ranks(count)
            costs, share = np.sort(result.metrics.total)[rank], (rank + 1) / count
            left.step(costs, share, where="post", label=look["label"], **line)
            # Just before each jump, so that the largest cost is still on the axis.
            right.step(costs, 1.0 - share + 1.0 / count, where="pre", **line)
        left.set_ylabel("share of episodes that cost at most $c$")
        left.set_ylim(0.0, 1.0)
        right.set_ylabel("share of episodes that cost at least $c$")
        right.set_yscale("log")
        for axes in (left, right):
            axes.set_xscale("log")
            _plain_log_ticks(axes.xaxis)
            axes.set_xlabel("cost of a path $c$")
        figure.legend(
            *left.get_legend_handles_labels(), loc="outside upper center", ncols=3, handlelength=2.6
        )
    return figure


def drawn_ranks(count: int) -> np.ndarray:
    """Which of sorted numbers a distribution function is drawn through: all, unless they are many.

    Of many, some two thousand evenly over the shares, and as many over the logarithm of what is
    left above: a step is then less than a line's width on either axis, and the largest hundred are
    there one by one.

    Args:
        count: how many numbers, >= 1.

    Returns:
        Ranks in rising order, the first 0 and the last `count` − 1.
    """
    if count <= 2 * _MOST_DRAWN:
        return np.arange(count)
    even = np.linspace(0, count - 1, _MOST_DRAWN)
    above = count - np.geomspace(1, count, _MOST_DRAWN)
    largest = np.arange(count - 100, count)
    return np.unique(np.concatenate([even, above, largest]).round().astype(int))

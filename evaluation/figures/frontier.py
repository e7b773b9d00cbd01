"""The figure of a frontier: effort and total cost against collision rate, curves named directly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from slipcar.evaluation import rows
from slipcar.evaluation.figures.labels import Label, place
from slipcar.evaluation.figures.scene import INK, PALETTE, PAPER, new_figure, save_figure, style
from slipcar.evaluation.frontier_record import (
    CURVES,
    FEEDBACK,
    OPEN_LOOP,
    RECEDING,
    FrontierRecord,
    Point,
)
from slipcar.evaluation.statistics import CONFIDENCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from slipcar.evaluation.metrics import Result

    Shown = tuple[Point, Result]

__all__ = ["frontier_figure", "save_figure", "widest_gap"]

_COLOURS = {OPEN_LOOP: PALETTE[0], FEEDBACK: PALETTE[1], RECEDING: PALETTE[2]}
_CURVE_MARKERS = {OPEN_LOOP: "o", FEEDBACK: "s", RECEDING: "D"}
_SINGLE_MARKERS = {rows.DETERMINISTIC: "^", rows.STOCHASTIC: "v", rows.FEEDBACK: "P", rows.PPO: "*"}
_SINGLE_COLOURS = {rows.PPO: PALETTE[6]}
_SIZES = {"*": 9.0, "P": 7.0, "^": 6.0, "v": 6.0}
#: An axis of costs spans at least this share of them: less is rounding errors.
_LEAST_RANGE = 0.005
#: Length of the arrow at an upper limit, as a share of it.
_ARROW = 0.4
#: Shorter names, for labels in the picture.
_SHORT = {rows.FEEDBACK: "stochastic SCP\n+ LQR feedback"}
_COSTS = {"effort": "mean effort", "total": "mean total cost: effort + obstacles + goal"}
_RATE = f"collision rate [%], {CONFIDENCE:.0%} interval"
_READING = (
    "filled: closed loop; hollow: open loop; small numbers: price of risk ν; "
    f"vertical bars: {CONFIDENCE:.0%} interval of the mean"
)


def frontier_figure(frontier: FrontierRecord) -> Figure:
    """Effort, and total cost, against collision rate, with 95 % intervals of all.

    Filled markers are closed loop, hollow ones open loop; a rate of which nothing was observed is
    an arrow at its upper limit. Small numbers are prices of risk. Where nothing lies over much of
    an axis of costs, it is broken.
    """
    results = frontier.comparison.results
    shown = [(point, results[point.name]) for point in frontier.points if point.name in results]
    with style():
        figure = new_figure(9.6, 5.2)
        grid = figure.add_gridspec(2, 2)
        panels = []
        for column, (cost, label) in enumerate(_COSTS.items()):
            panels += _panels(figure, grid[:, column], shown, cost, label)
        # Limits of all axes first: names are placed by them.
        for axes, cost, part in panels:
            for point, result in part:
                _draw_point(axes, point, result, cost)
            axes.set_xscale("log")
            axes.margins(x=0.1, y=0.12)
        for axes, _, _ in panels[1:]:
            axes.sharex(panels[0][0])
        for axes, _, _ in panels:
            axes.autoscale_view()
            low, high = axes.get_ylim()
            room = max(0.0, _LEAST_RANGE * abs(low) - (high - low)) / 2.0
            axes.set_ylim(low - room, high + room)
            axes.ticklabel_format(axis="y", useOffset=False)
            _percent_ticks(axes)
        figure.supxlabel(_READING, fontsize=8.0, color=INK)
        for axes, cost, part in panels:
            lines = _draw_curves(axes, part, cost) + _bars(part, cost)
            at = np.array([_place_of(result, cost) for _, result in part]).reshape(-1, 2)
            place(axes, _labels(part, cost), at, lines)
    return figure


def _panels(
    figure: Figure, where: Any, shown: list[Shown], cost: str, label: str
) -> list[tuple[Axes, str, list[Shown]]]:
    """Axes for one cost, and what is drawn in each: one, or two where the axis is broken."""
    groups: dict[str, list[float]] = {}
    for point, result in shown:
        name = point.method if point.method in CURVES else point.name
        groups.setdefault(name, []).append(getattr(result, cost))
    gap = widest_gap(list(groups.values()))
    if gap is None:
        axes = figure.add_subplot(where)
        axes.set_ylabel(label)
        axes.set_xlabel(_RATE)
        return [(axes, cost, shown)]
    parts = where.subgridspec(2, 1, hspace=0.08)
    upper, lower = figure.add_subplot(parts[0]), figure.add_subplot(parts[1])
    upper.spines["bottom"].set_visible(False)
    upper.tick_params(axis="x", which="both", bottom=False, labelbottom=False)
    lower.set_ylabel(label, y=1.05)
    lower.set_xlabel(_RATE)
    mark: dict[str, Any] = {
        "marker": [(-1, -0.6), (1, 0.6)],
        "markersize": 8,
        "linestyle": "none",
        "color": INK,
    }
    upper.plot([0], [0], transform=upper.transAxes, clip_on=False, **mark)
    lower.plot([0], [1], transform=lower.transAxes, clip_on=False, **mark)
    high = [row for row in shown if getattr(row[1], cost) >= gap[1]]
    low = [row for row in shown if getattr(row[1], cost) <= gap[0]]
    return [(upper, cost, high), (lower, cost, low)]


def widest_gap(groups: Sequence[Sequence[float]]) -> tuple[float, float] | None:
    """Where an axis can be broken: between groups, over more than a third of the range of all.

    Args:
        groups: numbers that must stay on one side of the gap together.

    Returns:
        The numbers next to the gap, below and above; None if there is none so wide.
    """
    spans = sorted((min(group), max(group)) for group in groups if len(group))
    if not spans:
        return None
    whole = max(high for _, high in spans) - spans[0][0]
    gaps, reached = [], spans[0][1]
    for low, high in spans[1:]:
        gaps.append((low - reached, reached, low))
        reached = max(reached, high)
    width, below, above = max(gaps, default=(0.0, 0.0, 0.0))
    return (below, above) if width > whole / 3.0 else None


def _colour(point: Point) -> str:
    return _COLOURS.get(point.method) or _SINGLE_COLOURS.get(point.name, INK)


def _place_of(result: Result, cost: str) -> tuple[float, float]:
    """Where a point is drawn: rate [%], or its upper limit where none was observed, and cost."""
    rate = result.collision_rate or result.collision_interval[1]
    return 100.0 * rate, getattr(result, cost)


def _bars(shown: list[Shown], cost: str) -> list[np.ndarray]:
    """The intervals of the rates, as lines that names should not cover."""
    lines = []
    for _, result in shown:
        at, mean = _place_of(result, cost)
        ends = 100.0 * np.array(result.collision_interval)
        if result.collision_rate == 0.0:
            ends[0] = (1.0 - _ARROW) * at
        lines.append(np.column_stack([ends, np.full(2, mean)]))
    return lines


def _draw_point(axes: Axes, point: Point, result: Result, cost: str) -> None:
    colour = _colour(point)
    marker = _CURVE_MARKERS.get(point.method) or _SINGLE_MARKERS.get(point.name, "X")
    at, mean = _place_of(result, cost)
    low, high = (100.0 * end for end in result.collision_interval)
    seen = result.collision_rate > 0.0
    error = float(1.96 * np.nan_to_num(getattr(result, f"{cost}_se")))
    axes.errorbar(
        at,
        mean,
        # Nothing observed: the rate lies somewhere below, which an arrow to the left says.
        xerr=[[max(at - low, 0.0)], [max(high - at, 0.0)]] if seen else [[_ARROW * at], [0.0]],
        yerr=error,
        xuplims=not seen,
        color=colour,
        fmt="none",
        elinewidth=0.8,
        capsize=0.0 if seen else 2.5,
        alpha=0.75,
        zorder=3,
    )
    axes.plot(
        at,
        mean,
        marker=marker,
        color=colour,
        markerfacecolor=colour if result.closed_loop else PAPER,
        markeredgewidth=1.2,
        markersize=_SIZES.get(marker, 4.5),
        linestyle="none",
        zorder=5,
    )


def _draw_curves(axes: Axes, shown: list[Shown], cost: str) -> list[np.ndarray]:
    """Join the points of a method, in the order of their prices, as far as rates were observed."""
    lines = []
    for method in CURVES:
        curve = [r for p, r in shown if p.method == method and r.collision_rate > 0.0]
        line = np.array([_place_of(result, cost) for result in curve]).reshape(-1, 2)
        axes.plot(*line.T, color=_COLOURS[method], linewidth=1.2, alpha=0.8, zorder=4)
        lines.append(line)
    return lines


def _labels(shown: list[Shown], cost: str) -> list[Label]:
    """Names of curves and single points, then prices where there is room."""
    labels = []
    for method in CURVES:
        curve = [_place_of(result, cost) for point, result in shown if point.method == method]
        if curve:
            look: dict[str, Any] = {"fontsize": 9.0, "fontweight": "bold"}
            # Highest price first: there the curves are furthest from each other.
            labels.append(Label(method, np.array(curve[::-1]), _COLOURS[method], look=look))
    costs = [getattr(result, cost) for _, result in shown]

    def alike(a: np.ndarray, b: np.ndarray) -> bool:
        return abs(np.log(a[0] / b[0])) < 0.15 and abs(a[1] - b[1]) < 0.03 * np.ptp(costs)

    named: list[tuple[np.ndarray, str, str]] = []
    for point, result in shown:
        if point.method not in CURVES:
            name, at = _SHORT.get(point.name, point.name), np.array(_place_of(result, cost))
            if named and named[-1][2] == _colour(point) and alike(at, named[-1][0]):
                name = f"{named.pop()[1]},\n{name}"  # one on top of the other: named together
            named.append((at, name, _colour(point)))
    labels += [Label(name, at[None], colour, look={"fontsize": 8.0}) for at, name, colour in named]
    for point, result in shown:
        if point.method in CURVES:
            at = np.array([_place_of(result, cost)])
            look = {"fontsize": 7.0}
            text = f"{point.price:g}"
            labels.append(Label(text, at, _colour(point), optional=True, look=look))
    return labels


def _percent_ticks(axes: Axes) -> None:
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,)))
    axes.xaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())

"""Learning curves: cost against samples and against time, a band over the trainings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from slipcar.evaluation.comparison_record import ComparisonRecord
from slipcar.evaluation.figures.scene import GREY, INK, PALETTE, new_figure, style
from slipcar.evaluation.learning import Curve, curves, targets

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Costs above this many times the cheapest plan's are beyond the axes.
_HIGHEST = 2.0


def learning_figure(comparison: ComparisonRecord) -> Figure:
    """Median and range of the trainings' validation costs; plans are level lines."""
    learned, plans = curves(comparison.controllers), targets(comparison)
    with style():
        figure = new_figure(9.0, 4.2)
        left, right = figure.subplots(1, 2, sharey=True)
        for axes, against, label in (
            (left, "steps", "environment steps [10⁶]"),
            (right, "seconds", "seconds of training"),
        ):
            for i, (name, mine) in enumerate(learned.items()):
                unit = 1e6 if against == "steps" else 1.0
                _band(axes, mine, against, unit, PALETTE[i % len(PALETTE)], f"{name}, {len(mine)}")
            for name, (cost, _) in plans.items():
                axes.axhline(cost, color=GREY, linewidth=0.8, linestyle=(0, (4, 2)), zorder=1)
                if axes is right:
                    axes.annotate(
                        name,
                        (1.01, cost),
                        xycoords=("axes fraction", "data"),
                        fontsize=7.0,
                        color=INK,
                        va="center",
                        annotation_clip=False,
                    )
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.set_xlabel(label)
        lowest = min(
            [cost for cost, _ in plans.values()]
            + [float(curve.total.min()) for mine in learned.values() for curve in mine]
        )
        left.set_yscale("log")
        left.set_ylim(0.985 * lowest, _HIGHEST * lowest)
        ticks = [tick for tick in (4.5, 4.75, 5.0, 5.25, 5.5, 6.0, 7.0, 8.0, 10.0, 15.0)]
        left.yaxis.set_major_locator(FixedLocator(ticks))
        left.yaxis.set_minor_locator(NullLocator())
        left.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        left.set_ylabel("mean cost of a path, validation")
        figure.legend(
            *left.get_legend_handles_labels(),
            loc="outside upper center",
            ncols=4,
            title="trainings: median and range; dashed: plans",
        )
    return figure


def _band(
    axes: Axes, mine: list[Curve], against: str, unit: float, colour: str, label: str
) -> None:
    """Median and range over trainings on a common grid, as far as all of them go."""
    ends = [(getattr(curve, against)[0], getattr(curve, against)[-1]) for curve in mine]
    first, last = max(low for low, _ in ends), min(high for _, high in ends)
    grid = np.geomspace(first, last, 400)
    # What is best so far is what training keeps.
    every = np.array(
        [
            np.interp(grid, getattr(curve, against), np.minimum.accumulate(curve.total))
            for curve in mine
        ]
    )
    axes.plot(grid / unit, np.median(every, axis=0), color=colour, label=f"{label} trainings")
    axes.fill_between(
        grid / unit, every.min(axis=0), every.max(axis=0), color=colour, alpha=0.2, linewidth=0.0
    )

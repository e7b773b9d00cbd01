"""Figure: residual of the maximum principle against iteration and time, method beside method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import FuncFormatter, MaxNLocator

from slipcar.evaluation.figures.scene import PALETTE, new_figure, style
from slipcar.evaluation.residuals import Curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Residuals below this are rounding errors; the axis ends there.
_FLOOR = 1e-16
#: Name of a curve -> colour, what the legend says.
_LOOK = {
    "convex": (PALETTE[0], 'the paper\'s scheme (method="convex")'),
    "shooting": (PALETTE[1], "its end by shooting (shooting=True)"),
    "newton": (PALETTE[2], "Newton's method (the default)"),
    "newton, NumPy": (PALETTE[2], "the same, not compiled"),
}


def plot_residuals(
    curves: Mapping[str, Curve], others: Sequence[Mapping[str, Curve]] = ()
) -> Figure:
    """Residual of the maximum principle against iteration and against time.

    Args:
        curves: of one problem, drawn boldly: `residuals.residual_curves` gives them.
        others: of other problems, drawn faintly.

    Raises:
        ValueError: for a curve of an unknown name.
    """
    for found in (curves, *others):
        if unknown := sorted(set(found) - set(_LOOK)):
            raise ValueError(f"unknown curves {unknown}; known: {list(_LOOK)}")
    with style():
        figure = new_figure(9.6, 4.2)
        by_iteration, by_time = figure.subplots(1, 2, sharey=True)
        for found in others:
            _draw(by_iteration, by_time, found, bold=False)
        _draw(by_iteration, by_time, curves, bold=True)
        for axes in (by_iteration, by_time):
            axes.set_yscale("log")
            axes.set_ylim(_FLOOR, 30.0)
            axes.minorticks_off()
        by_iteration.set_xlim(left=0.0)
        by_iteration.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
        by_iteration.set_xlabel("iteration")
        by_iteration.set_title("largest residual of the maximum principle", loc="left")
        by_time.set_xscale("log")
        by_time.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        by_time.set_xlabel("time [ms]")
        by_time.set_title("the same against time", loc="left")
        handles, labels = by_time.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=len(labels))
    return figure


def _draw(by_iteration: Axes, by_time: Axes, curves: Mapping[str, Curve], *, bold: bool) -> None:
    for name, curve in curves.items():
        colour, label = _LOOK[name]
        residuals = np.maximum(curve.residuals, _FLOOR)
        look: dict[str, Any] = {"color": colour, "linewidth": 0.6, "alpha": 0.22, "zorder": 2}
        if bold:
            look |= {"linewidth": 1.7, "alpha": 1.0, "zorder": 5, "label": label}
            look |= {"marker": "o", "markersize": 3.5}
        if name == "newton, NumPy":  # the same iterates: it differs in time alone
            look |= {"linestyle": (0, (3, 2)), "markersize": 2.0, "linewidth": 1.0}
        else:
            by_iteration.plot(curve.iterations, residuals, **look)
        by_time.plot(1e3 * curve.seconds, residuals, **look)

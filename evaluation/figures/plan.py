"""Figures of one plan: the paper's Figure 1, and its covariance against Monte Carlo."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Ellipse
from scipy import stats

from slipcar.envs.car import CONTROL_NAMES, CONTROL_UNITS, STATE_NAMES, STATE_UNITS
from slipcar.envs.scenario import Scenario
from slipcar.evaluation.figures.scene import (
    GREY,
    INK,
    PALETTE,
    draw_paths,
    draw_scene,
    new_figure,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Probability that the drawn ellipses hold.
ELLIPSE_MASS = 0.95
_MEASURED: dict[str, Any] = {"color": PALETTE[1], "linestyle": (0, (4, 3)), "linewidth": 1.5}


def iterations_figure(scenario: Scenario, plan: Any, states: np.ndarray) -> Figure:
    """The paper's Figure 1: every accepted iterate, and sample paths of the plan they lead to.

    The iterates of a plan of an expected cost are those of the plan of the mean that it started
    from, and then the plan itself.

    Args:
        scenario: the world.
        plan: a `slipcar.planner.Plan` with its history.
        states: sample paths of the plan, (paths, N, 5).
    """
    over = _times_of_iterates(scenario, plan)
    accepted = [i for i, iterate in enumerate(plan.history) if iterate.accepted]
    iterates, over = [plan.history[i] for i in accepted], [over[i] for i in accepted]
    if getattr(plan, "expected", None) is not None:
        iterates, over = [*iterates, plan], [*over, plan.times]
    count = len(iterates)
    # Viridis without its palest end, which white paper swallows.
    colours = mpl.colormaps["viridis_r"](np.linspace(0.08, 1.0, count))
    with style():
        figure = new_figure(10.0, 4.9)
        grid = figure.add_gridspec(2, 3, width_ratios=(2.1, 1.0, 1.0))
        scene = figure.add_subplot(grid[:, 0])
        draw_scene(scene, scenario)
        draw_paths(scene, states)
        scene.plot([], [], color=GREY, linewidth=0.8, label=f"{len(states)} sample paths")
        if getattr(plan, "guess", None) is not None:
            scene.plot(
                *plan.guess[:, :2].T,
                color=INK,
                linewidth=1.0,
                linestyle=":",
                zorder=4,
                label="initial guess",
            )
        for i, iterate in enumerate(iterates):
            last = i == count - 1
            scene.plot(
                *iterate.mean[:, :2].T,
                color=colours[i],
                linewidth=2.2 if last else 1.1,
                zorder=6 if last else 5,
                label="final plan" if last else None,
            )
        _legend_below(figure, scene)
        panels = (
            (0, 1, "mean", 3), (0, 2, "mean", 4), (1, 1, "controls", 0), (1, 2, "controls", 1)
        )  # fmt: skip
        for row, column, quantity, component in panels:
            axes = figure.add_subplot(grid[row, column])
            _draw_over_time(axes, over, iterates, colours, quantity, component)
            axes.set_xlim(0.0, max((times[-1] for times in over), default=scenario.horizon))
            if row == 1:
                axes.set_xlabel("$t$ [s]")
        _iteration_colourbar(figure, colours)
    return figure


def _times_of_iterates(scenario: Scenario, plan: Any) -> list[np.ndarray]:
    """Nodes (N,) of each iterate: under a free final time each belongs to a horizon tried."""
    tried = [step for step in getattr(plan, "time_search", ()) if step.accepted]
    horizons = [step.final_time for step in tried for _ in range(step.iterations)]
    if len(horizons) != len(plan.history):
        return [scenario.times] * len(plan.history)
    return [scenario.times * (horizon / scenario.horizon) for horizon in horizons]


def _draw_over_time(
    axes: Axes,
    over: list[np.ndarray],
    iterates: list[Any],
    colours: Any,
    quantity: str,
    index: int,
) -> None:
    state = quantity == "mean"
    name = (STATE_NAMES if state else CONTROL_NAMES)[index]
    unit = (STATE_UNITS if state else CONTROL_UNITS)[index]
    for i, iterate in enumerate(iterates):
        values = getattr(iterate, quantity)[:, index]
        line = {"color": colours[i], "linewidth": 1.6 if i == len(iterates) - 1 else 0.9}
        if state:
            axes.plot(over[i], values, **line)
        else:  # held over each interval: as steps, the last one drawn to its end
            axes.step(over[i], np.append(values, values[-1]), where="post", **line)
    axes.axhline(0.0, color=GREY, linewidth=0.6, zorder=1)
    axes.set_title(f"${_maths(name)}$ [{unit}]", loc="left")


def _maths(name: str) -> str:
    return name.replace("θ", r"\theta").replace("ω", r"\omega")


def _iteration_colourbar(figure: Figure, colours: Any) -> None:
    count = len(colours)
    edges = np.arange(0.5, count + 1.0)
    if count < 2:
        return
    mappable = mpl.cm.ScalarMappable(BoundaryNorm(edges, count), ListedColormap(colours))
    ticks = np.arange(1, count + 1, max(1, round(count / 10)))
    bar = figure.colorbar(mappable, ax=figure.axes, ticks=ticks, fraction=0.025, pad=0.015)
    bar.set_label("iteration")
    bar.outline.set_linewidth(0.6)
    bar.ax.minorticks_off()


def covariance_figure(scenario: Scenario, plan: Any, states: np.ndarray) -> Figure:
    """Predicted covariance ellipses over Monte-Carlo points, and tr Σ over time.

    Args:
        scenario: the world.
        plan: a `slipcar.planner.Plan`.
        states: paths of the plan in open loop, (paths, N, 5).
    """
    nodes = np.unique(np.linspace(0, scenario.nodes - 1, 6).round().astype(int))[1:]
    # Five nodes in colours from dark to light: order is time.
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.75, len(nodes)))
    shown = states[:1500]
    with style():
        figure = new_figure(10.0, 4.6)
        grid = figure.add_gridspec(2, 3, width_ratios=(2.0, 1.0, 1.0))
        scene = figure.add_subplot(grid[:, 0])
        draw_scene(scene, scenario)
        scene.plot(*plan.mean[:, :2].T, color=PALETTE[0], zorder=4, label="mean path")
        for node, colour in zip(nodes, colours, strict=True):
            _draw_cloud(scene, shown[:, node], plan, node, colour, size=1.5)
        scene.plot([], [], color=INK, linewidth=1.3, label=f"predicted, {ELLIPSE_MASS:.0%}")
        scene.plot([], [], label=f"Monte Carlo, {ELLIPSE_MASS:.0%}", **_MEASURED)
        _legend_below(figure, scene)
        zoomed = nodes[-3:]
        for node, place in zip(zoomed, ((0, 1), (0, 2), (1, 1)), strict=False):
            axes = figure.add_subplot(grid[place])
            colour = colours[list(nodes).index(node)]
            _draw_cloud(axes, shown[:, node], plan, node, colour, size=3.0)
            _draw_ellipse(
                axes,
                states[:, node, :2].mean(axis=0),
                np.cov(states[:, node, :2].T),
                edgecolor=_MEASURED["color"],
                linestyle=_MEASURED["linestyle"],
            )
            axes.plot(*plan.mean[node, :2], marker="+", color=INK, markersize=8, zorder=7)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_title(f"$t$ = {scenario.times[node]:.3g} s", loc="left")
            axes.set_xlabel("$r_x$ [m]")
            axes.set_ylabel("$r_y$ [m]")
        _draw_trace(figure.add_subplot(grid[1, 2]), scenario, plan, states)
    return figure


def _draw_cloud(
    axes: Axes, states: np.ndarray, plan: Any, node: int, colour: Any, size: float
) -> None:
    axes.scatter(
        states[:, 0], states[:, 1], s=size, color=colour, alpha=0.3, linewidths=0, zorder=3,
        rasterized=True,
    )  # fmt: skip
    _draw_ellipse(axes, plan.mean[node, :2], plan.covariance[node, :2, :2], edgecolor=INK)


def _draw_ellipse(axes: Axes, mean: np.ndarray, covariance: np.ndarray, **look: Any) -> None:
    """Ellipse that holds :data:`ELLIPSE_MASS` of a Gaussian."""
    values, vectors = np.linalg.eigh(covariance)
    radii = np.sqrt(np.maximum(values, 0.0) * stats.chi2.ppf(ELLIPSE_MASS, df=2))
    axes.add_patch(
        Ellipse(
            tuple(mean),
            *(2.0 * radii[::-1]),
            angle=float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))),
            fill=False,
            **{"linewidth": 1.3, "zorder": 6, **look},
        )
    )


def _legend_below(figure: Figure, scene: Axes) -> None:
    """In a row under everything: inside, there is always an obstacle in its way."""
    handles, labels = scene.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower left", ncols=len(labels), handlelength=1.8,
        columnspacing=1.4,
    )  # fmt: skip


def _draw_trace(axes: Axes, scenario: Scenario, plan: Any, states: np.ndarray) -> None:
    predicted = np.trace(plan.covariance, axis1=-2, axis2=-1)
    measured = states.var(axis=0, ddof=1).sum(axis=-1)
    axes.plot(scenario.times, predicted, color=INK, linewidth=1.5, label="predicted")
    axes.plot(scenario.times, measured, label=f"{len(states):,} paths", **_MEASURED)
    axes.set_title(r"tr $\Sigma$", loc="left")
    axes.set_xlabel("$t$ [s]")
    axes.set_xlim(0.0, scenario.horizon)
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper left")

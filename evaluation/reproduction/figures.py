"""The figures of a reproduction: the paper's own, and three that show where its text is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np

from slipcar.evaluation.figures.plan import iterations_figure
from slipcar.evaluation.figures.scene import (
    GREY,
    INK,
    PALETTE,
    draw_scene,
    new_figure,
    save_figure,
    style,
)
from slipcar.evaluation.reproduction.claims import PAPER_RATE
from slipcar.evaluation.reproduction.record import PAPER_EPISODES, ReproductionRecord
from slipcar.evaluation.reproduction.runs import played
from slipcar.evaluation.reproduction.tables import covariances
from slipcar.evaluation.rollout import sample_paths
from slipcar.evaluation.statistics import wilson_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Paths of the paper's figure; points and probability of an ellipse; late iterates that are shown.
_PATHS, _POINTS, _MASS, _LATE = 100, 73, 0.95, 20
_LOOKS: tuple[dict[str, Any], ...] = (
    {"color": INK, "linewidth": 1.4, "label": "exact step"},
    {"color": PALETTE[0], "linewidth": 1.2, "linestyle": ":", "label": "the text's step"},
    {"color": PALETTE[1], "linewidth": 1.4, "label": "the released step"},
    {"color": PALETTE[2], "linewidth": 1.6, "linestyle": (0, (4, 3)), "label": "paths"},
)


def save_all(r: ReproductionRecord, folder: Path) -> list[Path]:
    """Draw and write every figure; returns the files."""
    ours = r.runs["ours"].plan
    states, _ = sample_paths(played(ours, r.scenario), r.scenario, _PATHS, r.seed)
    figures = {
        "iterations": lambda: iterations_figure(r.scenario, ours, states),
        "variants": lambda: variants_figure(r),
        "covariance": lambda: covariance_figure(r),
        "clearance": lambda: clearance_figure(r),
    }
    written = []
    with style():
        for stem, draw in figures.items():
            written += save_figure(draw(), folder, stem)
    return written


def variants_figure(r: ReproductionRecord) -> Figure:
    """Iterates: ours, the literal linearisation's, and those with the potential as printed."""
    shown = (
        ("ours", "L kept convex-composite"),
        ("literal", "L linearised, as printed"),
        ("printed potential", "potential as printed"),
    )
    with style():
        figure = new_figure(10.0, 4.4)
        panels = figure.subplots(1, len(shown))
        for axes, (name, title) in zip(panels, shown, strict=True):
            run = r.runs[name]
            draw_scene(axes, r.scenario)
            iterates = run.plan.history[max(0, run.plan.iterations - _LATE) :]
            colours = mpl.colormaps["viridis_r"](np.linspace(0.08, 1.0, len(iterates)))
            for iterate, colour in zip(iterates, colours, strict=True):
                last = iterate is iterates[-1]
                axes.plot(
                    *iterate.mean[:, :2].T, color=colour, linewidth=2.0 if last else 0.9, zorder=5
                )
            rate = 100 * run.result.collision_rate
            axes.set_title(f"{title}: {run.plan.status},\n{rate:.1f} % collide", loc="left")
            if axes is not panels[0]:
                axes.set_ylabel("")
        figure.supxlabel(
            f"the last {_LATE} iterates at most, the last one bold", fontsize=8.0, color=INK
        )
    return figure


def covariance_figure(r: ReproductionRecord) -> Figure:
    """Ellipses of the position along the mean path, and tr Σ over time, by each step."""
    s, mean = r.scenario, r.runs["ours"].plan.mean
    nodes = np.linspace(0, s.nodes - 1, 6).round().astype(int)[1:]
    with style():
        figure = new_figure(9.6, 4.6)
        scene, traces = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
        draw_scene(scene, s)
        scene.plot(*mean[:, :2].T, color=GREY, linewidth=0.9, zorder=4)
        for look, covariance in zip(_LOOKS, covariances(r).values(), strict=True):
            for node in nodes:
                _ellipse(scene, mean[node, :2], covariance[node, :2, :2], look)
            traces.plot(s.times, np.trace(covariance, axis1=1, axis2=2), **look)
        scene.set_title(f"{_MASS:.0%} ellipses of the position", loc="left")
        traces.set_title(r"tr $\Sigma$", loc="left")
        traces.set_xlabel("$t$ [s]")
        traces.set_xlim(0.0, s.horizon)
        traces.set_ylim(bottom=0.0)
        traces.legend(loc="upper left")
    return figure


def clearance_figure(r: ReproductionRecord) -> Figure:
    """Collision rate against the clearance a plan was made with, and the paper's."""
    clearances = np.array(list(r.sweep))
    rates = 100 * np.array([result.collision_rate for result in r.sweep.values()])
    ends = 100 * np.array([result.collision_interval for result in r.sweep.values()])
    low, high = wilson_interval(round(PAPER_RATE * PAPER_EPISODES), PAPER_EPISODES)
    with style():
        figure = new_figure(6.4, 4.0)
        axes = figure.subplots()
        axes.axhspan(100 * low, 100 * high, color=PALETTE[4], alpha=0.25, linewidth=0)
        axes.axhline(
            100 * PAPER_RATE, color=PALETTE[4], label="the paper: 6.14 % of 10⁴, 95 % interval"
        )
        axes.fill_between(clearances, *ends.T, color=PALETTE[0], alpha=0.2, linewidth=0)
        axes.plot(clearances, rates, color=PALETTE[0], marker="o", markersize=3.5, label="here")
        for value, text in ((0.1, "printed"), (0.13, "released")):
            axes.axvline(value, color=GREY, linewidth=0.8, linestyle=(0, (4, 3)))
            axes.annotate(
                f" {text}", (value, 0.98), xycoords=("data", "axes fraction"), va="top",
                fontsize=8.0, color=INK,
            )  # fmt: skip
        axes.set_xlabel("clearance ε of the plan [m]")
        axes.set_ylabel("collisions [%]")
        axes.set_ylim(bottom=0.0)
        axes.legend(loc="lower left")
    return figure


def _ellipse(axes: Axes, centre: np.ndarray, covariance: np.ndarray, look: dict[str, Any]) -> None:
    """Where a Gaussian is with probability :data:`_MASS`."""
    values, vectors = np.linalg.eigh(covariance)
    radius = np.sqrt(-2.0 * np.log(1.0 - _MASS))  # of the chi distribution of two dimensions
    angle = np.linspace(0.0, 2.0 * np.pi, _POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    rim = centre[:, None] + radius * (vectors * np.sqrt(np.maximum(values, 0.0))) @ circle
    axes.plot(*rim, **{**look, "label": None, "zorder": 6})

"""The look of every figure, and the world seen from above."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from slipcar.baselines.files import write_atomically
from slipcar.envs.drawing import GREY, INK, PALETTE, PAPER
from slipcar.envs.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STYLE: Any = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "mathtext.fontset": "dejavusans",
    "axes.edgecolor": INK,
    "axes.linewidth": 0.7,
    "lines.linewidth": 1.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.6,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": True,
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "figure.facecolor": PAPER,
    "pdf.fonttype": 42,  # TrueType: text stays text in the PDF
}


@contextlib.contextmanager
def style() -> Iterator[None]:
    """The house style, for the figures made inside; the user's settings are left alone."""
    with mpl.rc_context(_STYLE):
        yield


def new_figure(width: float, height: float) -> Figure:
    """A figure without pyplot: no window, no global state, nothing to close."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


#: How each kind of file is written: without dates, so that equal figures are equal files.
_SUFFIXES: dict[str, dict[str, Any]] = {
    "png": {"dpi": 150},
    "pdf": {"metadata": {"CreationDate": None}},
    "svg": {"metadata": {"Date": None}},
}


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write PNG (150 dpi), PDF and SVG, each whole or not at all."""
    paths = []
    # The salt names clip paths: at random without it.
    with style(), mpl.rc_context({"svg.hashsalt": "slipcar"}):
        for suffix, options in _SUFFIXES.items():
            content = io.BytesIO()
            figure.savefig(content, format=suffix, **options)
            paths.append(folder / f"{name}.{suffix}")
            write_atomically(paths[-1], content.getvalue())
    return paths


def draw_scene(axes: Axes, scenario: Scenario) -> None:
    """Obstacles with their clearance rings, start and goal, axes in metres."""
    scenario.draw(axes)


def draw_paths(axes: Axes, states: np.ndarray, **line: Any) -> LineCollection:
    """Paths (paths, N, >= 2) as thin lines."""
    options = {"colors": GREY, "linewidths": 0.5, "alpha": 0.35, "zorder": 3, **line}
    collection = LineCollection(list(states[..., :2]), **options)
    axes.add_collection(collection)
    axes.autoscale_view()
    return collection


def paths_figure(scenario: Scenario, states: np.ndarray, title: str) -> Figure:
    """Sample paths of a controller, those that hit an obstacle picked out.

    Args:
        scenario: the world.
        states: (paths, N, 5).
        title: above the axes.
    """
    with style():
        figure = new_figure(5.2, 5.0)
        axes = figure.subplots()
        draw_scene(axes, scenario)
        hit = (scenario.signed_distance(states[:, 1:]) < 0.0).any(axis=1)
        kinds = ((~hit, PALETTE[0], "free"), (hit, PALETTE[1], "hits an obstacle"))
        for which, colour, label in kinds:
            if which.any():
                alpha = float(np.clip(15.0 / which.sum(), 0.15, 0.9))
                draw_paths(axes, states[which], colors=colour, alpha=alpha, linewidths=0.8)
                axes.plot([], [], color=colour, label=f"{label} ({which.sum()})")
        axes.set_title(title, loc="left")
        axes.legend(loc="best")
    return figure

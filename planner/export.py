"""A plan as a pandas frame, as an xarray dataset, and drawn by matplotlib.

Each package is imported when it is asked for. A problem may name what is shown, `state_names` (n)
and `control_names` (m), say which two states span the plane that it happens in, `plane` (i, j), and
draw what is in that plane, `draw(axes)`.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

Array = np.ndarray

#: Probability that drawn ellipses and bands hold, and what that is in standard deviations: of a
#: plane, κ² = −2 ln(1 − p), and of a line.
MASS = 0.95
_ELLIPSE, _BAND = float(np.sqrt(-2.0 * np.log1p(-MASS))), 1.959964
#: Ellipses along a path; corners of each.
_ELLIPSES, _CORNERS = 10, 64


def _package(name: str, wanted: str) -> Any:
    """A package, or an ImportError that says what to install."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ImportError(f"{wanted} needs {package} ({error}): pip install {package}") from error


def names(plan: Any) -> tuple[list[str], list[str]]:
    """What states and controls are called: by their problem, else x[0], ... and u[0], ..."""
    found = []
    widths = plan.mean.shape[1], plan.controls.shape[1]
    for member, letter, width in zip(("state_names", "control_names"), "xu", widths, strict=True):
        own = getattr(plan.problem, member, None)
        if own is not None and len(own) != width:
            raise ValueError(f"{member} of the problem must be {width} names, not {list(own)}")
        found.append(list(own) if own is not None else [f"{letter}[{i}]" for i in range(width)])
    return found[0], found[1]


def deviations(plan: Any) -> Array:
    """Standard deviation of each state at each node, (N, n)."""
    variances = np.diagonal(plan.covariance, axis1=-2, axis2=-1)
    return np.sqrt(np.maximum(variances, 0.0))


def to_frame(plan: Any) -> pd.DataFrame:
    """See :meth:`slipcar.planner.Plan.to_frame`."""
    pandas = _package("pandas", "to_frame")
    states, controls = names(plan)
    # A control is held from its node to the next; at the last node there is none.
    u = np.vstack([plan.controls, np.full((1, len(controls)), np.nan)])
    columns = {
        **dict(zip(states, plan.mean.T, strict=True)),
        **{f"sd of {name}": sd for name, sd in zip(states, deviations(plan).T, strict=True)},
        **dict(zip(controls, u.T, strict=True)),
    }
    return pandas.DataFrame(columns, index=pandas.Index(plan.times, name="time"))


def to_xarray(plan: Any) -> xr.Dataset:
    """See :meth:`slipcar.planner.Plan.to_xarray`."""
    xarray = _package("xarray", "to_xarray")
    states, controls = names(plan)
    data = {
        "mean": (("time", "state"), plan.mean),
        "covariance": (("time", "state", "other_state"), plan.covariance),
        "controls": (("interval", "control"), plan.controls),
    }
    if plan.gains is not None:
        data["gains"] = (("interval", "control", "state"), plan.gains)
    told = ("effort", "obstacle_cost", "running_cost", "variance", "iterations", "message")
    return xarray.Dataset(
        data,
        coords={
            "time": plan.times,
            "interval": plan.times[:-1],
            "state": states,
            "other_state": states,
            "control": controls,
        },
        attrs={"status": plan.status.name, **{name: getattr(plan, name) for name in told}},
    )


def plot(plan: Any, axes: Any = None, plane: tuple[int, int] | None = None) -> Any:
    """See :meth:`slipcar.planner.Plan.plot`."""
    pyplot = _package("matplotlib.pyplot", "plot")
    own = getattr(plan.problem, "plane", None)
    if plane is None and own is None:
        return _over_time(plan, axes, pyplot)
    pair = _checked_plane(plan, own if plane is None else plane)
    if axes is None:
        _, axes = pyplot.subplots(layout="constrained")
    elif not hasattr(axes, "plot"):
        raise ValueError(f"a plane is drawn into one Axes, not {type(axes).__name__}")
    _in_plane(plan, axes, pair, own is not None and tuple(own) == pair)
    return axes


def _checked_plane(plan: Any, plane: Any) -> tuple[int, int]:
    n = plan.mean.shape[1]
    pair = tuple(plane)
    if len(pair) != 2 or pair[0] == pair[1] or not all(0 <= int(i) < n for i in pair):
        raise ValueError(f"plane must be two of the states 0..{n - 1}, not {plane!r}")
    return int(pair[0]), int(pair[1])


def _in_plane(plan: Any, axes: Any, plane: tuple[int, int], whose: bool) -> None:
    """Mean path, ellipses and ends; and what the problem draws, in the plane it is drawn in."""
    draw = getattr(plan.problem, "draw", None)
    if whose and draw is not None:
        draw(axes)
    states, _ = names(plan)
    path = plan.mean[:, plane]
    (line,) = axes.plot(*path.T, color="C0", label="mean", zorder=5)
    nodes = np.unique(np.linspace(0, len(path) - 1, _ELLIPSES + 1).round().astype(int))[1:]
    angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    label: str | None = f"{MASS:.0%} of the paths at a node"
    for k in nodes:
        values, vectors = np.linalg.eigh(plan.covariance[k][np.ix_(plane, plane)])
        rim = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
        x, y = path[k][:, None] + _ELLIPSE * rim
        axes.plot(x, y, color=line.get_color(), linewidth=0.7, alpha=0.7, label=label, zorder=4)
        label = None
    if not (whose and draw is not None):
        axes.plot(*path[0], "o", color=line.get_color(), fillstyle="none", label="start", zorder=6)
        axes.plot(*path[-1], "s", color=line.get_color(), label="end", zorder=6)
    axes.set_xlabel(states[plane[0]])
    axes.set_ylabel(states[plane[1]])
    axes.legend(fontsize="small")


def _over_time(plan: Any, axes: Any, pyplot: Any) -> Array:
    """A panel for each state, with its band, and for each control, as steps."""
    states, controls = names(plan)
    count = len(states) + len(controls)
    if axes is None:
        columns = min(count, 3)
        rows = -(-count // columns)
        figure, grid = pyplot.subplots(
            rows, columns, figsize=(3.2 * columns, 2.2 * rows), sharex=True, squeeze=False,
            layout="constrained",
        )  # fmt: skip
        for extra in grid.flat[count:]:
            figure.delaxes(extra)
        panels = np.array(grid.flat[:count])
        for panel in panels[-columns:]:
            panel.xaxis.set_tick_params(labelbottom=True)
            panel.set_xlabel("time")
    else:
        panels = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
        if len(panels) != count:
            raise ValueError(
                f"over time {len(states)} states and {len(controls)} controls are drawn into "
                f"{count} Axes, not {len(panels)}; a plane=(i, j) of two states into one"
            )
    band = _BAND * deviations(plan)
    for j, name in enumerate(states):
        mean, half = plan.mean[:, j], band[:, j]
        (line,) = panels[j].plot(plan.times, mean)
        panels[j].fill_between(
            plan.times, mean - half, mean + half, color=line.get_color(), alpha=0.2, linewidth=0
        )
        panels[j].set_title(name, loc="left", fontsize="medium")
    for j, name in enumerate(controls):
        held = np.append(plan.controls[:, j], plan.controls[-1, j])
        panels[len(states) + j].step(plan.times, held, where="post", color="C1")
        panels[len(states) + j].set_title(name, loc="left", fontsize="medium")
    return panels


def html_facts(plan: Any) -> dict[str, str]:
    """What a notebook shows of a plan: name -> text."""
    states, controls = names(plan)
    meaning = plan.status.value.partition(": ")[2] or plan.status.value
    shown = {
        "status": f"{plan.status.name}: {meaning}",
        "effort": f"{plan.effort:.6g}",
        "obstacle cost": f"{plan.obstacle_cost:.4g}",
        "running cost": f"{plan.running_cost:.6g}" if plan.running_cost else "",
        "∫ tr Σ dt": f"{plan.variance:.4g}",
        "final time": f"{plan.final_time:.6g} s",
        "expected cost": "" if plan.expected is None else f"{plan.expected.total:.6g}",
        "risk": "" if plan.risk is None else str(plan.risk),
        "states": _listed(states),
        "controls": _listed(controls) + ("" if plan.gains is None else ", with feedback gains"),
        "nodes": str(len(plan.times)),
        "iterations": f"{plan.iterations} in {plan.solve_time:.3g} s",
        "message": plan.message,
    }
    return {name: text for name, text in shown.items() if text}


def _listed(texts: Sequence[str], most: int = 8) -> str:
    return ", ".join(texts[:most]) + (", ..." if len(texts) > most else "")

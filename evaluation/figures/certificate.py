"""Figure of what a plan proves: the Hamiltonian at its maximum, and the multipliers behind it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.ticker import MaxNLocator

from slipcar.envs.car import CONTROL_NAMES, CONTROL_UNITS
from slipcar.evaluation.figures.scene import GREY, INK, PALETTE, PAPER, new_figure, style
from slipcar.planner.extremal.certificate import certify
from slipcar.planner.extremal.maximum_principle import best_step, first_order, model_for

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = np.ndarray


def plot_hamiltonian(plan: Any, nodes: Sequence[int] | None = None) -> Figure:
    """H along each control component through its argmax, and the multipliers that define it.

    One panel a component: H(v) less its maximum, at several nodes, with the maximum (ring) and
    the plan's own control (dot); at an extremal every dot sits in its ring. Beside them the
    normalised multipliers of every sub-problem, which settle as the iteration does.

    Args:
        plan: a plan that knows its problem.
        nodes: which of the K intervals to show; None takes five, evenly spread.

    Raises:
        ValueError: if the plan does not know its problem, or a node is out of range.
    """
    certificate, model = certify(plan), model_for(plan)
    K, m = plan.controls.shape
    chosen = np.linspace(0, K - 1, 5).round().astype(int) if nodes is None else np.asarray(nodes)
    if chosen.ndim != 1 or len(chosen) == 0 or not ((chosen >= 0) & (chosen < K)).all():
        raise ValueError(f"nodes must be intervals 0..{K - 1}, not {nodes!r}")
    at = first_order(model, plan.mean, plan.controls, plan.options["variance_weight"])
    best = plan.controls + best_step(model, at, certificate.violations.adjoint)[0]
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.82, len(chosen)))
    with style():
        figure = new_figure(3.5 * (m + 1), 3.6)
        panels = figure.subplots(1, m + 1, squeeze=False)[0]
        for j in range(m):
            span = _span(plan.controls[:, j], best[:, j], model.lower[j], model.upper[j])
            grid = np.linspace(*span, 201)
            for k, colour in zip(chosen, colours, strict=True):
                points = np.concatenate([grid, [best[k, j], plan.controls[k, j]]])
                v = np.broadcast_to(best[k], (len(points), m)).copy()
                v[:, j] = points
                p = certificate.adjoint[k + 1]
                H = _hamiltonian(model, plan.times[k], plan.mean[k], p, v)
                H -= H[-2]
                label = f"$t$ = {plan.times[k]:.3g} s" if j == 0 else None
                panels[j].plot(grid, H[:-2], color=colour, label=label)
                ring: dict[str, Any] = {
                    "markeredgecolor": colour,
                    "markerfacecolor": PAPER,
                    "zorder": 5,
                }
                panels[j].plot(points[-2], 0.0, "o", markersize=9, markeredgewidth=1.4, **ring)
                panels[j].plot(points[-1], H[-1], "o", markersize=4, color=colour, zorder=6)
            _mark_bounds(panels[j], span, model.lower[j], model.upper[j])
            panels[j].set_xlabel(_control_label(plan, j))
            panels[j].set_title("$H(v) - \\max H$", loc="left")
        _draw_multipliers(panels[m], certificate)
        handles, labels = panels[0].get_legend_handles_labels()
        for size, face, name in ((9, PAPER, "argmax $H$"), (4, INK, "the plan's control")):
            handles.append(
                mpl.lines.Line2D(
                    [], [], marker="o", markersize=size, markerfacecolor=face,
                    markeredgecolor=INK, linestyle="none",
                )
            )  # fmt: skip
            labels.append(name)
        figure.legend(handles, labels, loc="outside lower left", ncols=len(labels))
    return figure


def _hamiltonian(model: Any, t: float, x: Array, p: Array, v: Array) -> Array:
    """pᵀb(t, x, v) − vᵀRv at one node, what depends on v (points, m) in H: (points,)."""
    b = model.drift(np.full(len(v), t), np.tile(x, (len(v), 1)), v)
    return b @ p - np.einsum("vi,ij,vj->v", v, model.R, v)


def _span(u: Array, best: Array, lower: float, upper: float) -> tuple[float, float]:
    """Controls to show: those used and a margin, within U."""
    low, high = min(u.min(), best.min()), max(u.max(), best.max())
    margin = 0.35 * (high - low) or 1.0
    return max(low - margin, lower), min(high + margin, upper)


def _mark_bounds(axes: Axes, span: tuple[float, float], lower: float, upper: float) -> None:
    for bound in (lower, upper):
        if bound in span:
            axes.axvline(bound, color=GREY, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)


def _control_label(plan: Any, j: int) -> str:
    if plan.controls.shape[1] == 2 and plan.mean.shape[1] == 5:  # the car
        name = CONTROL_NAMES[j].replace("ω", r"\omega")
        return f"${name}$ [{CONTROL_UNITS[j]}]"
    return f"$u_{j + 1}$"


def _draw_multipliers(axes: Axes, certificate: Any) -> None:
    iterations = np.arange(1, len(certificate.cost_history) + 1)
    for i, values in enumerate(certificate.terminal_history.T):
        label = r"$\mathfrak{p}_k$" if i == 0 else None
        axes.plot(iterations, values, color=PALETTE[0], linewidth=1.0, label=label)
    axes.plot(iterations, certificate.cost_history, color=PALETTE[1], label="$p^0_k$")
    if certificate.trust_region_history.any():
        values = certificate.trust_region_history
        axes.plot(iterations, values, color=PALETTE[2], label="$p^1_k$")
    if certificate.relaxed.any():
        relaxed = iterations[certificate.relaxed]
        axes.plot(
            relaxed, np.zeros(len(relaxed)), "|", color=GREY, markersize=8, label="$g$ relaxed"
        )
    axes.axhline(0.0, color=GREY, linewidth=0.6, zorder=1)
    axes.set_ylim(-1.05, 1.05)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("iteration $k$")
    axes.set_title("multipliers, normalised", loc="left")
    axes.legend(loc="best")

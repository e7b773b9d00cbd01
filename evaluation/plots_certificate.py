"""Figures of what a plan proves: the Hamiltonian at its maximum, and residuals against time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.ticker import MaxNLocator

from slipcar.envs.car import CONTROL_NAMES, CONTROL_UNITS
from slipcar.evaluation.plot_scene import GREY, INK, PALETTE, PAPER, new_figure, style
from slipcar.planner.certificate import certify, model_for, violations
from slipcar.planner.maximum_principle import best_step, first_order, hamiltonian
from slipcar.planner.shooting import START_WITHIN, retry_within, shoot_from

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = np.ndarray

#: Residuals below this are rounding errors; the axis ends there.
_FLOOR = 1e-16


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
                H = hamiltonian(model, plan.times[k], plan.mean[k], p, v)
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


def residuals_of(plan: Any) -> tuple[Array, Array]:
    """Largest relative residual of the maximum principle at every accepted iterate of SCP.

    Returns:
        Residuals and the seconds they were reached after, (accepted iterations,) each.
    """
    model = model_for(plan)
    seconds = np.cumsum([h.seconds for h in plan.history])
    found = [
        (
            violations(
                model,
                h.mean,
                h.controls,
                h.terminal_multiplier,
                variance_weight=plan.options["variance_weight"],
                terminal_tolerance=plan.options["terminal_tolerance"],
            ).largest,
            s,
        )
        for h, s in zip(plan.history, seconds, strict=True)
        if h.accepted
    ]
    values = np.array(found).reshape(-1, 2)
    return values[:, 0], values[:, 1]


def first_shot(
    plan: Any, start_within: float = START_WITHIN, attempts: int = 4
) -> tuple[int, Any, float] | None:
    """The first shot that converges: tried from an iterate whose residual is small enough, and
    again each time it has halved.

    Args:
        plan: whose history to start from.
        start_within: residual at which the first is tried.
        attempts: at most so many.

    Returns:
        Index into the history, the shot, and the seconds lost before: in shots that failed and
        in finding iterates too far away. None if none converges.
    """
    limit, lost = start_within, 0.0
    for k, h in enumerate(plan.history):
        if not h.accepted or attempts == 0:
            continue
        # The fastest of three: one hiccup of the machine is not the method's.
        shots = [shoot_from(plan, k, start_within=limit) for _ in range(3)]
        shot = min(shots, key=lambda s: s.seconds)
        if shot.converged:
            return k, shot, lost
        lost += shot.seconds
        limit = retry_within(shot, limit)
        attempts -= shot.attempted
    return None


def plot_residuals(
    plan: Any, others: Sequence[Any] = (), *, start_within: float = START_WITHIN
) -> Figure:
    """Residual of the maximum principle against iteration and time: SCP, and SCP + shooting.

    Args:
        plan: drawn boldly; planned with a small `tolerance`, so that SCP goes on.
        others: plans of other worlds, drawn faintly.
        start_within: residual at which shooting is first tried.
    """
    with style():
        figure = new_figure(9.2, 4.0)
        by_iteration, by_time = figure.subplots(1, 2, sharey=True)
        for other in others:
            _draw_residuals(by_iteration, by_time, other, start_within, bold=False)
        _draw_residuals(by_iteration, by_time, plan, start_within, bold=True)
        for axes in (by_iteration, by_time):
            axes.set_yscale("log")
            axes.set_ylim(_FLOOR, 10.0)
            axes.set_xlim(left=0.0)
        by_iteration.set_xlabel("iteration (SCP, then Newton)")
        by_time.set_xlabel("time [ms]")
        by_iteration.set_title("residual of the maximum principle", loc="left")
        by_time.set_title("the same against time", loc="left")
        by_iteration.xaxis.set_major_locator(MaxNLocator(integer=True))
        handles, labels = by_iteration.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=len(labels))
    return figure


def _draw_residuals(
    by_iteration: Axes, by_time: Axes, plan: Any, start_within: float, *, bold: bool
) -> None:
    residuals, seconds = residuals_of(plan)
    look: dict[str, Any] = (
        {"linewidth": 1.6, "zorder": 5} if bold else {"linewidth": 0.6, "alpha": 0.3, "zorder": 2}
    )
    label = "SCP alone" if bold else None
    steps = np.arange(1, len(residuals) + 1)
    for axes, x in ((by_iteration, steps), (by_time, 1e3 * seconds)):
        axes.plot(x, np.maximum(residuals, _FLOOR), color=PALETTE[0], label=label, **look)
    found = first_shot(plan, start_within)
    if found is None:
        return
    k, shot, lost = found
    taken = sum(h.accepted for h in plan.history[: k + 1])
    label = "SCP + shooting" if bold else None
    marker: dict[str, Any] = {"marker": "o", "markersize": 4} if bold else {}
    newton = np.maximum(shot.residuals, _FLOOR)
    after = np.array([h.seconds for h in shot.history])
    by_iteration.plot(
        taken + np.arange(len(newton)), newton, color=PALETTE[1], label=label, **look, **marker
    )
    began = seconds[taken - 1] + lost
    by_time.plot(1e3 * (began + after), newton, color=PALETTE[1], **look, **marker)

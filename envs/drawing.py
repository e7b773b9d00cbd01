"""A world seen from above, drawn into the axes of matplotlib, and the colours of all figures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

#: Okabe and Ito's palette: told apart by colour-blind readers too.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F3C8D", "#000000")
INK, GREY, PAPER = "#222222", "#8A8A8A", "#FFFFFF"
OBSTACLE = "#C9CDD3"


def draw_world(
    axes: Any, obstacles: np.ndarray, clearance: float, start: np.ndarray, goal: np.ndarray
) -> None:
    """Obstacles (k, 3) with their clearance rings, start and goal (5,), axes in metres."""
    from matplotlib.patches import Circle

    for i, (x, y, radius) in enumerate(obstacles):
        axes.add_patch(
            Circle(
                (x, y),
                radius,
                facecolor=OBSTACLE,
                edgecolor=GREY,
                linewidth=0.8,
                zorder=2,
                label="obstacle" if i == 0 else None,
            )
        )
        axes.add_patch(
            Circle(
                (x, y),
                radius + clearance,
                fill=False,
                edgecolor=GREY,
                linewidth=0.7,
                linestyle=(0, (4, 3)),
                zorder=2,
                label="clearance" if i == 0 else None,
            )
        )
    for state, marker, label in ((start, "o", "start"), (goal, "*", "goal")):
        axes.plot(
            *state[:2],
            marker=marker,
            markersize=7 if marker == "o" else 13,
            markerfacecolor=PAPER if marker == "o" else PALETTE[4],
            markeredgecolor=INK,
            markeredgewidth=0.9,
            linestyle="none",
            zorder=8,
            label=label,
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("$r_x$ [m]")
    axes.set_ylabel("$r_y$ [m]")

"""Collision rate that was promised against the rate on fresh paths, world by world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def draw(
    before: Sequence[Sequence[float]],
    after: Mapping[str, Sequence[Any]],
    promised: Mapping[str, float],
    folder: Path,
) -> list[Path]:
    """Log-log: the paper's SCP from left to right, ours upwards: risk.png and risk.pdf.

    Args:
        before: rates of SCP in the worlds of each entry of `after`.
        after: results by planner.
        promised: δ of those that promise one.
        folder: where the figure goes.
    """
    from slipcar.evaluation.figures.scene import GREY, PALETTE, new_figure, save_figure, style

    with style():
        figure = new_figure(5.6, 4.0)
        axes = figure.subplots()
        paths = max(r.episodes for results in after.values() for r in results)
        floor = 0.5 / paths
        for (name, results), rates, colour, marker in zip(
            after.items(), before, PALETTE, "osD", strict=False
        ):
            x = np.maximum(rates, floor)
            y = np.maximum([r.rate for r in results], floor)
            low, high = np.array([r.interval for r in results]).T
            bars = [y - np.clip(low, 0.6 * floor, y), np.maximum(high - y, 0.0)]
            ok = np.array([r.ok for r in results])
            for which, face in ((ok, colour), (~ok, "none")):
                if which.any():
                    axes.errorbar(
                        x[which], y[which], yerr=[b[which] for b in bars], fmt=marker, color=colour,
                        markerfacecolor=face, markersize=3.8, elinewidth=0.5, alpha=0.8,
                        label=name if face == colour else f"{name}: refused",
                    )  # fmt: skip
            if name in promised:
                axes.axhline(promised[name], color=colour, linewidth=0.9, linestyle=(0, (5, 2)))
        ends = np.array([floor, 1.0])
        axes.plot(ends, ends, color=GREY, linewidth=0.7)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlim(0.7 * floor, 1.0)
        axes.set_ylim(0.5 * floor, 1.0)
        axes.set_xlabel(f"collision rate of stochastic SCP (leftmost: none on {paths:,} paths)")
        axes.set_ylabel("collision rate (lowest: none)")
        axes.legend(loc="upper left")
        return save_figure(figure, folder, "risk")

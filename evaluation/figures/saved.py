"""The figures of a comparison, drawn and written. Needs matplotlib; nothing else here does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slipcar.evaluation.comparison_record import ComparisonRecord
from slipcar.evaluation.figures.learning import learning_figure
from slipcar.evaluation.figures.plan import covariance_figure, iterations_figure
from slipcar.evaluation.figures.rows import distributions_figure, tradeoff_figure
from slipcar.evaluation.figures.scene import paths_figure, save_figure, style
from slipcar.evaluation.learning import curves
from slipcar.evaluation.report.scene import illustrated
from slipcar.evaluation.rollout import sample_paths

__all__ = [
    "covariance_figure",
    "distributions_figure",
    "iterations_figure",
    "paths_figure",
    "save_all",
    "save_figure",
    "save_plan_figures",
    "style",
    "tradeoff_figure",
]

#: Sample paths in Figure 1 (as in the paper), and paths behind the covariance figure.
SHOWN_PATHS, MEASURED_PATHS = 100, 4096


def save_all(comparison: ComparisonRecord, folder: Path) -> list[Path]:
    """Draw every figure of a comparison; returns the files written (PNG, PDF, SVG)."""
    written = []
    _, plan = illustrated(comparison)
    if plan is not None:
        written += save_plan_figures(comparison.scenario, plan, folder, comparison.seed)
    if comparison.results:
        with style():
            written += save_figure(tradeoff_figure(comparison), folder, "tradeoff")
            written += save_figure(distributions_figure(comparison), folder, "distributions")
    if curves(comparison.controllers):
        written += save_figure(learning_figure(comparison), folder, "learning")
    return written


def save_plan_figures(scenario: Any, plan: Any, folder: Path, seed: int = 0) -> list[Path]:
    """Figure 1 and the covariance figure of one plan, driven as it is meant to be."""
    states, _ = sample_paths(played(plan), scenario, MEASURED_PATHS, seed)
    written = save_figure(
        iterations_figure(scenario, plan, states[:SHOWN_PATHS]), folder, "iterations"
    )
    return written + save_figure(covariance_figure(scenario, plan, states), folder, "covariance")


def played(plan: Any) -> Any:
    """The controller of a plan: its feedback where it has gains, else its controls."""
    from slipcar.planner import Feedback, OpenLoop

    return OpenLoop(plan) if plan.gains is None else Feedback(plan)

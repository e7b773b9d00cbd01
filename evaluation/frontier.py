"""What safety costs: effort and total cost against collision rate, as the price of risk rises.

For each price ν [cost per unit of probability] a plan minimises

    E[ Σ dt (uᵀRu + Σ w max(0, c)²) + gᵀWg ] + ν Σ_k Σ_o P(collision with o at node k)

in open loop (without E gᵀWg, the mean arrives exactly), with feedback planned along, and once more
at every step (receding horizon). Each ν is a point, each method a curve; the paper's plans, one of
them tracked by an LQR, and PPO are single points. All drive over the same Brownian paths.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from slipcar import baselines
from slipcar.envs.scenario import Scenario
from slipcar.envs.validate import checked_int
from slipcar.evaluation import makers, rows
from slipcar.evaluation.compare import Comparison, compare
from slipcar.evaluation.controller import Controller
from slipcar.evaluation.frontier_record import (
    CURVES,
    FEEDBACK,
    OPEN_LOOP,
    RECEDING,
    SINGLE,
    FrontierRecord,
    Point,
    undominated,
)
from slipcar.evaluation.report import frontier as report_frontier
from slipcar.evaluation.rollout import checked_counts
from slipcar.planner import Feedback, OpenLoop, RecedingHorizon, plan
from slipcar.planner.options import RiskAt

__all__ = [
    "CURVES",
    "FEEDBACK",
    "OPEN_LOOP",
    "RECEDING",
    "SINGLE",
    "Frontier",
    "Point",
    "candidates",
    "checked_prices",
    "frontier",
    "point_name",
    "undominated",
]

#: Prices of risk by default, of plans and of receding horizons; 0 leaves the risk out.
PRICES = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
RECEDING_PRICES = (0.0, 3.0, 10.0, 30.0)
#: Episodes a point by default; replanning costs a thousand times what playing a plan does.
EPISODES, RECEDING_EPISODES = 50_000, 16_384


def frontier(
    scenario: Scenario | str,
    episodes: int = EPISODES,
    seed: int = 0,
    *,
    prices: Sequence[float] = PRICES,
    receding_prices: Sequence[float] = RECEDING_PRICES,
    receding_episodes: int = RECEDING_EPISODES,
    policy: Controller | None = None,
    substeps: int = 1,
    n_jobs: int = 1,
    folder: str | Path | None = None,
    resume: bool = True,
    progress: bool = True,
) -> Frontier:
    """Trade effort and total cost for safety by three methods, beside the paper's plans and PPO.

    Example:
        >>> from slipcar.evaluation.frontier import frontier
        >>> f = frontier("paper", episodes=10_000)
        >>> f.frame[["price", "collision_rate", "effort", "total"]]

    Args:
        scenario: a scenario or the name of one.
        episodes: a point, >= 1.
        seed: of the Brownian paths, >= 0; the same for all points.
        prices: of risk, for open loop and planned feedback, each finite and >= 0; none leaves both
            curves out.
        receding_prices: the same for the receding horizon.
        receding_episodes: its episodes a point, >= 1, but at most `episodes`: the first of the
            same Brownian paths.
        policy: the PPO point; None takes the shipped one, where it was trained for the scenario.
        substeps: Euler–Maruyama steps in each control interval. With more than one, prices are of
            the risk on the path, `plan(..., risk_at="path")`.
        n_jobs: worker processes; the numbers do not depend on it.
        folder: where finished points are kept, so that an interrupted run continues; or None.
        resume: whether to reuse finished points of `folder`.
        progress: whether to show a bar for each point.

    Raises:
        ValueError: for a bad argument, or a scenario without obstacles or that cannot be driven or
            planned.
    """
    scenario = Scenario.of(scenario)
    episodes, seed, substeps, n_jobs = checked_counts(episodes, seed, substeps, n_jobs)
    if not len(scenario.obstacles):
        raise ValueError("a frontier needs a scenario with obstacles: without, nothing is risked")
    receding_episodes = min(
        checked_int("receding_episodes", receding_episodes, at_least=1), episodes
    )
    points, notes = candidates(
        scenario,
        checked_prices("prices", prices),
        checked_prices("receding_prices", receding_prices),
        policy,
        at_path=substeps > 1,
    )

    def run(chosen: list[Point], count: int) -> Comparison:
        return compare(
            {point.name: point.controller for point in chosen},
            scenario,
            count,
            seed,
            substeps=substeps,
            n_jobs=n_jobs,
            folder=folder,
            resume=resume,
            progress=progress,
        )

    done = run([point for point in points if point.method != RECEDING], episodes)
    if receding := [point for point in points if point.method == RECEDING]:
        done = _joined(done, run(receding, receding_episodes))
    return Frontier(tuple(points), done, receding_episodes, tuple(notes))


def _joined(first: Comparison, second: Comparison) -> Comparison:
    """The rows of both, which may differ in their episodes."""
    return dataclasses.replace(
        first,
        controllers=first.controllers | second.controllers,
        results=first.results | second.results,
        errors=first.errors | second.errors,
        reused=first.reused + second.reused,
        wall_time=first.wall_time + second.wall_time,
    )


def candidates(
    scenario: Scenario,
    prices: Sequence[float],
    receding_prices: Sequence[float],
    policy: Controller | None,
    *,
    at_path: bool = False,
) -> tuple[list[Point], list[str]]:
    """The points, and what a reader must be told; plans that did not converge are left out.

    Prices are of the risk at nodes, or on the path; see :func:`frontier`.
    """
    scenario.action_scale  # noqa: B018  raises now if it is unbounded
    notes: list[str] = []
    weight = makers.chargeable(scenario)
    # So that planning times are warm ones, without first-call costs.
    plan(scenario, variance_weight=weight)
    plan(scenario, feedback=True)
    deterministic = baselines.deterministic_scp(scenario)
    stochastic = plan(scenario, variance_weight=weight)
    points = [
        Point(rows.DETERMINISTIC, SINGLE, float("nan"), OpenLoop(deterministic)),
        Point(rows.STOCHASTIC, SINGLE, float("nan"), OpenLoop(stochastic)),
        Point(rows.FEEDBACK, SINGLE, float("nan"), Feedback(stochastic)),
    ]
    for name, found in ((rows.DETERMINISTIC, deterministic), (rows.STOCHASTIC, stochastic)):
        notes += rows.plan_notes(name, found)
    for name, controller in rows.learned(scenario, policy, notes, ("ppo",)).items():
        points.append(Point(name, SINGLE, float("nan"), controller))
    kinds: tuple[tuple[str, Callable[..., Controller], bool], ...] = (
        (OPEN_LOOP, OpenLoop, False),
        (FEEDBACK, Feedback, True),
    )
    promised: RiskAt = "path" if at_path else "nodes"
    for method, play, feedback in kinds:
        for price in prices:
            name = point_name(method, price)
            found = plan(scenario, risk_price=price, risk_at=promised, feedback=feedback)
            if found.status.ok:
                points.append(Point(name, method, price, play(found)))
            notes += rows.plan_notes(name, found)
    for price in receding_prices:
        controller = RecedingHorizon(scenario, risk_price=price)
        points.append(Point(point_name(RECEDING, price), RECEDING, price, controller))
    return points, notes


def point_name(method: str, price: float) -> str:
    """How the row of a method at a price of risk is called."""
    return f"{method}, ν = {price:g}"


def checked_prices(name: str, prices: Sequence[float]) -> list[float]:
    """Prices in rising order.

    Raises:
        ValueError: for one that is no finite number >= 0, or that comes twice.
    """
    found = []
    for price in prices:
        try:
            value = float(price)
        except (TypeError, ValueError):
            value = float("nan")
        if not (np.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name} must be finite and >= 0, not {price!r}")
        found.append(value)
    twice = sorted({value for value in found if found.count(value) > 1})
    if twice:
        raise ValueError(f"{name} must differ from each other; {twice[0]:g} comes twice")
    return sorted(found)


@dataclasses.dataclass(frozen=True, repr=False)
class Frontier(FrontierRecord):
    """What :func:`frontier` returns: its record, and ways to write it.

    Attributes are those of :class:`slipcar.evaluation.frontier_record.FrontierRecord`.
    """

    comparison: Comparison

    def to_markdown(self) -> str:
        """The tables in Markdown with what they mean and where they come from."""
        return report_frontier.markdown(self)

    def save(self, folder: str | Path, figures: bool = True) -> list[Path]:
        """Write `table.md`, `table.csv`, `table.tex`, `results.json` and the figure.

        Args:
            folder: made if it does not exist.
            figures: also draw `frontier.png` and `.pdf` (needs matplotlib).

        Returns:
            The files written.
        """
        return report_frontier.save(self, Path(folder), figures)

"""What `slipcar reproduce` computes: plans of text, release and ours, and what their paths do."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.compare import evaluate
from slipcar.evaluation.noise import BLOCK
from slipcar.evaluation.reproduction.variants import PrintedPotential, released_start
from slipcar.evaluation.rollout import play
from slipcar.evaluation.statistics import wilson_interval
from slipcar.planner import OpenLoop, Plan, plan

Array = np.ndarray

#: Clearances of the figure [m], and the share of the episodes that each is driven.
CLEARANCES = tuple(round(0.08 + 0.01 * i, 2) for i in range(11))
SWEEP = 5
#: 95 % quantile of χ² with two degrees of freedom.
_CHI2 = -2.0 * np.log(0.05)
#: Names of the runs, in order, and how each plan is made. `s` is the paper's scenario.
PLANS: dict[str, str] = {
    "ours": "plan(s, method='convex')",
    "w = 0": "plan(s, method='convex', variance_weight=0.0)",
    "clearance 0.1": "plan(s.replace(clearance=0.1), method='convex')",
    "clearance 0.1, w = 0": "plan(s.replace(clearance=0.1), method='convex', variance_weight=0.0)",
    "printed potential": "plan(PrintedPotential(s), method='convex')",
    "literal": "plan(s, linearization='literal', trust_region='paper')",
    "literal, adaptive": "plan(s, linearization='literal')",
    "paper's trust region": "plan(s, trust_region='paper')",
    "terminal box": "plan(s, method='convex', terminal_tolerance=1e-3)",
    "released start": "plan(s, method='convex', guess=released_start(s), cold_start='never')",
    "tight": "plan(s, method='convex', tolerance=1e-14)",
    "default": "plan(s)",
}


def planned(name: str, s: Scenario) -> Plan:
    """The plan of a run of :data:`PLANS`, which says the same as text."""
    convex: dict[str, Any] = {"method": "convex"}
    makers: dict[str, Callable[[], Plan]] = {
        "ours": lambda: plan(s, **convex),
        "w = 0": lambda: plan(s, variance_weight=0.0, **convex),
        "clearance 0.1": lambda: plan(s.replace(clearance=0.1), **convex),
        "clearance 0.1, w = 0": lambda: plan(
            s.replace(clearance=0.1), variance_weight=0.0, **convex
        ),
        "printed potential": lambda: plan(PrintedPotential(s), **convex),
        "literal": lambda: plan(s, linearization="literal", trust_region="paper"),
        "literal, adaptive": lambda: plan(s, linearization="literal"),
        "paper's trust region": lambda: plan(s, trust_region="paper"),
        "terminal box": lambda: plan(s, terminal_tolerance=1e-3, **convex),
        "released start": lambda: plan(s, guess=released_start(s), cold_start="never", **convex),
        "tight": lambda: plan(s, tolerance=1e-14, **convex),
        "default": lambda: plan(s),
    }
    return makers[name]()


@dataclasses.dataclass(frozen=True)
class Rate:
    """How often paths collide; all that is kept of them, so that many may be driven.

    Attributes:
        hits: paths that do.
        episodes: of so many.
    """

    hits: int
    episodes: int

    closed_loop = False

    @classmethod
    def of(cls, found: Plan, s: Scenario, episodes: int, seed: int, workers: int) -> Rate:
        """Of a plan's controls, played in the paper's world."""
        result = evaluate(played(found, s), s, episodes, seed, n_jobs=workers)
        return cls(int(result.metrics.collision.sum()), result.episodes)

    @property
    def collision_rate(self) -> float:
        """Share of the paths."""
        return self.hits / self.episodes

    @property
    def collision_interval(self) -> tuple[float, float]:
        """Its Wilson 95 % interval."""
        return wilson_interval(self.hits, self.episodes)


@dataclasses.dataclass(frozen=True)
class Run:
    """A plan, and what it does when its controls are played in the paper's world.

    Attributes:
        name: of :data:`PLANS`.
        plan: as planned.
        result: over the common Brownian paths.
        clear: how many of its iterates' means touch no obstacle.
    """

    name: str
    plan: Plan
    result: Rate
    clear: int

    @classmethod
    def of(cls, name: str, s: Scenario, episodes: int, seed: int, workers: int) -> Run:
        """Plan and drive."""
        found = planned(name, s)
        result = Rate.of(found, s, episodes, seed, workers)
        means = np.array([iterate.mean for iterate in found.history])
        clear = int((s.signed_distance(means[:, 1:]) > 0.0).all(axis=1).sum())
        return cls(name, found, result, clear)


def played(found: Plan, s: Scenario) -> OpenLoop:
    """A plan's controls in the paper's world, whatever it was planned for."""
    return OpenLoop(found.replace(problem=s))


@dataclasses.dataclass(frozen=True)
class PathMoments:
    """Mean and covariance of many paths, node by node.

    Attributes:
        paths: how many.
        mean: (N, 5).
        covariance: (N, 5, 5).
        spread: largest difference between two paths in v and ω, at any node, (2,).
        variance: ∫ tr Σ dt, and its standard error.
        inside: share of the paths that end in the ellipse that holds 95 % of the predicted
            Gaussian of the position.
    """

    paths: int
    mean: Array
    covariance: Array
    spread: Array
    variance: tuple[float, float]
    inside: float


def path_moments(found: Plan, s: Scenario, episodes: int, seed: int = 0) -> PathMoments:
    """Moments of a plan's open-loop paths; memory holds one block of them."""
    controller = played(found, s)
    total, square = np.zeros((s.nodes, 5)), np.zeros((s.nodes, 5, 5))
    low, high = np.full((s.nodes, 2), np.inf), np.full((s.nodes, 2), -np.inf)
    low[0] = high[0] = s.start[3:]
    integrals, inside = [], 0
    shape = np.linalg.inv(found.covariance[-1, :2, :2])
    for block in range(-(-episodes // BLOCK)):
        wanted = min(BLOCK, episodes - block * BLOCK)
        integral = np.zeros(wanted)
        for step in play(controller, s, seed, block, wanted):
            k, x = step.index + 1, step.moved.state[:wanted]
            off = x - found.mean[k]  # sums of small numbers keep their digits
            total[k] += off.sum(axis=0)
            square[k] += off.T @ off
            integral += s.dt * (off * off).sum(axis=1)
            low[k] = np.minimum(low[k], x[:, 3:].min(axis=0))
            high[k] = np.maximum(high[k], x[:, 3:].max(axis=0))
        integrals.append(integral)
        inside += int((np.einsum("bi,ij,bj->b", off[:, :2], shape, off[:, :2]) <= _CHI2).sum())
    bias = total / episodes
    covariance = square / episodes - bias[:, :, None] * bias[:, None, :]
    integral = np.concatenate(integrals)
    return PathMoments(
        paths=episodes,
        mean=found.mean + bias,
        covariance=covariance,
        spread=(high - low).max(axis=0),
        inside=inside / episodes,
        variance=(
            trace_integral(covariance, s.dt),
            float(integral.std(ddof=1) / np.sqrt(episodes)) if episodes > 1 else float("nan"),
        ),
    )


def trace_integral(covariance: Array, dt: float) -> float:
    """∫ tr Σ dt, right end points as everywhere."""
    return float(dt * np.trace(covariance[1:], axis1=1, axis2=2).sum())


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How far a plan is from arrays that were computed elsewhere.

    Attributes:
        source: how those were computed.
        controls: largest difference of a control [m/s², rad/s²].
        states: of a state.
        effort: of the effort, relative.
        rate: collision rate of the arrays' own controls that was measured there; and its
            standard error.
    """

    source: str
    controls: float
    states: float
    effort: float
    rate: tuple[float, float]


#: Parts of the reference file, and the plan that each is compared with.
REFERENCES: dict[str, tuple[float, float]] = {
    "clearance_0.13": (0.13, 0.0),
    "clearance_0.10": (0.10, 0.0),
    "released_recipe": (0.13, 1e-3),
}


def compared(s: Scenario, reference: Path) -> dict[str, Agreement]:
    """Our plans, to the last digit and without the variance penalty, beside stored arrays.

    Args:
        s: the paper's scenario.
        reference: a JSON file with `state` (41, 5) and `control` (40, 2) for each part.

    Raises:
        ValueError: if it is no such file.
        OSError: if it cannot be read.
    """
    try:
        data = json.loads(reference.read_text(encoding="utf-8"))
        found = {}
        for part, (clearance, box) in REFERENCES.items():
            there = data[part]
            ours = plan(
                s.replace(clearance=clearance),
                method="convex",
                variance_weight=0.0,
                tolerance=1e-16,
                terminal_tolerance=box,
            )
            told = there["monte_carlo"]
            found[part] = Agreement(
                source=str(there["source"]),
                controls=float(np.abs(ours.controls - np.array(there["control"])).max()),
                states=float(np.abs(ours.mean - np.array(there["state"])).max()),
                effort=ours.effort / float(there["effort"]) - 1.0,
                rate=(float(told["collision_rate"]), float(told["standard_error"])),
            )
        return found
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{reference} is no reference of the paper's case: {type(error).__name__}: {error}"
        ) from error


def reference_file() -> Path | None:
    """The reference arrays, where this is a checkout."""
    path = Path(__file__).resolve().parents[2] / "tests" / "data" / "paper_case.json"
    return path if path.is_file() else None


def backends(s: Scenario, ours: Plan, repeats: int = 3) -> dict[str, dict[str, Any]]:
    """The same sub-problems by every solver that is installed.

    Returns:
        By solver: `difference` of the controls to ours, `iterations`, and the least `seconds` of
        `repeats` plans; or `missing`, why it was not run.
    """
    found: dict[str, dict[str, Any]] = {}
    for solver in ("structured", "osqp", "cvxpy"):
        try:
            plans = [plan(s, method="convex", solver=solver) for _ in range(repeats)]
        except ImportError as error:
            found[solver] = {"missing": str(error)}
            continue
        found[solver] = {
            "difference": float(np.abs(plans[0].controls - ours.controls).max()),
            "iterations": plans[0].iterations,
            "seconds": min(each.solve_time for each in plans),
        }
    return found

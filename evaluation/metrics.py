"""What is measured of an episode, and what `evaluate` says about many (docs/comparison.md)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.statistics import (
    Interval,
    Leader,
    cvar,
    leader,
    paired_difference,
    quantile,
    rate_interval,
    standard_error,
    student_interval,
    welch,
)
from slipcar.planner.display import brief, facts

if TYPE_CHECKING:
    import pandas as pd

#: Quantiles that tables show: of the clearance, and of a path's cost.
CLEARANCE_QUANTILES = (0.01, 0.05, 0.5)
COST_QUANTILES = (0.5, 0.95, 0.99)
#: Metrics that are 0 or 1, or between.
RATES = ("collision", "touched")
#: So many standard errors apart no bootstrap is needed to tell which mean is less.
_FAR = 10.0
#: Share of the worst episodes that a conditional value at risk averages.
TAIL = 0.05


@dataclasses.dataclass(frozen=True)
class EpisodeMetrics:
    """Per-episode numbers, every array (episodes,).

    Attributes:
        effort: Σ dt ‖u_k‖².
        obstacle: Σ dt λ Σ_o max(0, c_o)².
        goal: (x_N − x^f)ᵀ W (x_N − x^f).
        collision: whether any node 1..N−1 lay inside a bare radius.
        clearance: smallest signed distance to a rim over nodes 1..N−1 [m]; inf without obstacles.
        touched: probability of a collision at a node or between nodes, given the path's nodes
            (:mod:`slipcar.evaluation.between`); 1 where `collision`.
        position_error: ‖r_N − r^f‖ [m].
        heading_error: |θ_N − θ^f| [rad], unwrapped, as the goal cost has it.
        speed_error: |v_N − v^f| [m/s].
    """

    effort: np.ndarray
    obstacle: np.ndarray
    goal: np.ndarray
    collision: np.ndarray
    clearance: np.ndarray
    touched: np.ndarray
    position_error: np.ndarray
    heading_error: np.ndarray
    speed_error: np.ndarray

    __repr__ = brief

    @functools.cached_property
    def total(self) -> np.ndarray:
        """Cost of the path, (episodes,)."""
        return self.effort + self.obstacle + self.goal

    def __len__(self) -> int:
        return len(self.effort)

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        effort: np.ndarray,
        obstacle: np.ndarray,
        clearance: np.ndarray,
        log_clear: np.ndarray,
        final: np.ndarray,
    ) -> EpisodeMetrics:
        """From the sums over a path and its last state (episodes, 5).

        `log_clear` sums :func:`slipcar.evaluation.between.log_clear` over the intervals.
        """
        error = scenario.terminal(final)
        collision = clearance < 0.0
        return cls(
            effort=effort,
            obstacle=obstacle,
            goal=scenario.goal_cost(final),
            collision=collision,
            clearance=clearance,
            touched=np.where(collision, 1.0, -np.expm1(log_clear)),
            position_error=np.hypot(error[..., 0], error[..., 1]),
            heading_error=np.abs(error[..., 2]),
            speed_error=np.abs(error[..., 3]),
        )

    @classmethod
    def concatenate(cls, parts: Sequence[EpisodeMetrics]) -> EpisodeMetrics:
        """One after the other."""
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in FIELDS})

    def first(self, episodes: int) -> EpisodeMetrics:
        """The first episodes alone."""
        return self.part(slice(episodes))

    def part(self, episodes: slice) -> EpisodeMetrics:
        """Some of the episodes; views, not copies."""
        return EpisodeMetrics(**{name: getattr(self, name)[episodes] for name in FIELDS})

    def to_dict(self) -> dict[str, np.ndarray]:
        """Name -> array."""
        return {name: getattr(self, name) for name in FIELDS}


FIELDS = tuple(field.name for field in dataclasses.fields(EpisodeMetrics))


@dataclasses.dataclass(frozen=True)
class Result:
    """What a controller did over many episodes; what :func:`slipcar.evaluation.evaluate` returns.

    Means come with standard errors (`total`, `total_se`), rates with 95 % intervals. A learned
    method may have been trained several times (`runs`): then means are over runs and paths, and
    errors and intervals are of the method, trainings and paths together.

    Attributes:
        metrics: per-episode arrays; row i depends on (seed, i) alone. With several runs, one
            run's episodes after the other's.
        seed: of the Brownian paths.
        substeps: Euler–Maruyama steps in each control interval.
        closed_loop: whether the controller looks at the state.
        failures: solves behind the controller that failed (a plan that did not converge is one).
        inference_time: seconds inside `predict` per step and episode.
        preparation_time: seconds of planning or training before; nan when unknown.
        wall_time: seconds this evaluation took.
        runs: what each of several trainings did over the same paths; empty for a single controller.
    """

    metrics: EpisodeMetrics
    seed: int
    substeps: int
    closed_loop: bool
    failures: int
    inference_time: float
    preparation_time: float
    wall_time: float
    runs: tuple[Result, ...] = ()

    def __repr__(self) -> str:
        known = self._facts()
        said = [f"{known.pop('loop')} loop", f"{known.pop('episodes')} episodes"]
        return f"Result({', '.join([*said, *(f'{name} {text}' for name, text in known.items())])})"

    def _repr_html_(self) -> str:
        return facts("Result", self._facts())

    def _facts(self) -> dict[str, str]:
        """What there is to say in a few words: name -> text."""
        (low, high), (below, above) = self.collision_interval, self.between_interval
        trainings = {"trainings": str(len(self.runs))} if self.runs else {}
        return {
            "loop": "closed" if self.closed_loop else "open",
            "episodes": f"{self.episodes:,}",
            **trainings,
            "total cost": f"{self.total:.3f} ± {self.total_se:.3f}",
            "collisions": f"{self.collision_rate:.2%} [{low:.2%}, {high:.2%}]",
            "at or between nodes": f"{self.between_rate:.2%} [{below:.2%}, {above:.2%}]",
            "position RMS": f"{self.position_rms:.4f} m",
        }

    def to_frame(self) -> pd.DataFrame:
        """A row an episode, every metric in SI units; with several trainings, a level for each."""
        import pandas as pd

        columns = self.metrics.to_dict() | {"total": self.metrics.total}
        paths = range(self.episodes)
        if not self.runs:
            return pd.DataFrame(columns, index=pd.Index(paths, name="episode"))
        levels = [range(len(self.runs)), paths]
        index = pd.MultiIndex.from_product(levels, names=["training", "episode"])
        return pd.DataFrame(columns, index=index)

    @classmethod
    def of_runs(cls, runs: Sequence[Result]) -> Result:
        """One row for several trainings of a method, all over the same paths."""
        first = runs[0]
        if len(runs) == 1:
            return first
        pooled = EpisodeMetrics.concatenate([run.metrics for run in runs])
        ends = np.cumsum([0, *(len(run.metrics) for run in runs)])
        # Each run's arrays become views of the pooled ones: nothing is held twice.
        runs = [
            dataclasses.replace(run, metrics=pooled.part(slice(ends[i], ends[i + 1])))
            for i, run in enumerate(runs)
        ]
        return cls(
            metrics=pooled,
            seed=first.seed,
            substeps=first.substeps,
            closed_loop=first.closed_loop,
            failures=sum(run.failures for run in runs),
            inference_time=float(np.mean([run.inference_time for run in runs])),
            preparation_time=float(np.mean([run.preparation_time for run in runs])),
            wall_time=sum(run.wall_time for run in runs),
            runs=tuple(runs),
        )

    @property
    def episodes(self) -> int:
        """How many episodes, of each run."""
        return len(self.metrics) // max(1, len(self.runs))

    def per_path(self, metric: str) -> np.ndarray:
        """A metric of each path, averaged over the runs, (episodes,) float64."""
        values = np.asarray(getattr(self.metrics, metric), dtype=np.float64)
        return values.reshape(-1, self.episodes).mean(axis=0) if self.runs else values

    def per_run(self, metric: str, episodes: int | None = None) -> np.ndarray:
        """Each run's mean of a metric over its first `episodes` (None: all), (runs,)."""
        values = np.asarray(getattr(self.metrics, metric), dtype=np.float64)
        return values.reshape(-1, self.episodes)[:, :episodes].mean(axis=1)

    def spread(self, metric: str) -> float:
        """Standard deviation between the runs' means; nan for a single controller."""
        return float(np.std(self.per_run(metric), ddof=1)) if len(self.runs) > 1 else float("nan")

    def difference(self, reference: Result, metric: str) -> Interval:
        """Mean paired difference to another row over the paths both met, and its interval.

        BCa bootstrap; between rows with several runs, Student's t over runs and paths (Welch).
        """
        n = min(self.episodes, reference.episodes)
        values, others = self.per_path(metric)[:n], reference.per_path(metric)[:n]
        if not self.runs and not reference.runs:
            found = paired_difference(values, others)
            if found.low == found.high and metric in RATES:
                # No path tells them apart: rarer than that is what can be said.
                bound = rate_interval(np.zeros(n))[1]
                found = Interval(found.mean, found.low - bound, found.high + bound)
            return found
        parts = [(standard_error(values - others), n)]
        parts += [
            (standard_error(row.per_run(metric, n)), len(row.runs))
            for row in (self, reference)
            if row.runs
        ]
        error, freedom = welch(*parts)
        return student_interval(float(np.mean(values - others)), error, freedom)

    @property
    def collision_rate(self) -> float:
        """Share of episodes that touch a bare obstacle at a node."""
        return float(self.metrics.collision.mean())

    @property
    def collision_interval(self) -> tuple[float, float]:
        """95 % interval of the collision rate: Wilson's."""
        return self._rate_interval("collision")

    @property
    def between_rate(self) -> float:
        """Share of episodes that touch one at a node or between nodes (Brownian bridges)."""
        return float(self.metrics.touched.mean())

    @property
    def between_interval(self) -> tuple[float, float]:
        """95 % interval of `between_rate`; Wilson's, which errs on the safe side for it."""
        return self._rate_interval("touched")

    @property
    def total(self) -> float:
        """Mean cost of a path."""
        return float(self.metrics.total.mean())

    @property
    def total_se(self) -> float:
        """Standard error of `total`."""
        return self._error("total")

    @property
    def effort(self) -> float:
        """Mean effort."""
        return float(self.metrics.effort.mean())

    @property
    def effort_se(self) -> float:
        """Standard error of `effort`."""
        return self._error("effort")

    @property
    def obstacle(self) -> float:
        """Mean obstacle cost."""
        return float(self.metrics.obstacle.mean())

    @property
    def obstacle_se(self) -> float:
        """Standard error of `obstacle`."""
        return self._error("obstacle")

    @property
    def goal(self) -> float:
        """Mean goal cost."""
        return float(self.metrics.goal.mean())

    @property
    def goal_se(self) -> float:
        """Standard error of `goal`."""
        return self._error("goal")

    @property
    def position_rms(self) -> float:
        """Root mean square of the terminal position error [m]."""
        return _rms(self.metrics.position_error)

    @property
    def heading_rms(self) -> float:
        """Root mean square of the terminal heading error [rad]."""
        return _rms(self.metrics.heading_error)

    @property
    def speed_rms(self) -> float:
        """Root mean square of the terminal speed error [m/s]."""
        return _rms(self.metrics.speed_error)

    @property
    def cost_quantiles(self) -> dict[float, float]:
        """Quantile -> cost of a path, for :data:`COST_QUANTILES`."""
        return {q: quantile(self.metrics.total, q) for q in COST_QUANTILES}

    @property
    def cost_cvar(self) -> tuple[float, float]:
        """Mean cost of the dearest 5 % of the paths, and its standard error."""
        value, error = cvar(self.metrics.total, TAIL)
        if self.runs:
            parts = [run.cost_cvar for run in self.runs]
            paths = float(np.mean([error for _, error in parts]))  # common paths: not averaged out
            error = _together(paths, standard_error(np.array([value for value, _ in parts])))
        return value, error

    @property
    def clearance_quantiles(self) -> dict[float, float]:
        """Quantile -> clearance [m], for :data:`CLEARANCE_QUANTILES`."""
        return {q: quantile(self.metrics.clearance, q) for q in CLEARANCE_QUANTILES}

    @property
    def clearance_cvar(self) -> float:
        """Mean clearance of the 5 % of the paths that come closest [m]."""
        value, _ = cvar(-self.metrics.clearance, TAIL)
        return -value

    def summary(self) -> dict[str, float | int | bool]:
        """Every aggregate as one flat row, SI units: a row of `Comparison.frame`."""
        low, high = self.collision_interval
        between_low, between_high = self.between_interval
        tail, tail_error = self.cost_cvar
        return {
            "closed_loop": self.closed_loop,
            "episodes": self.episodes,
            "runs": max(1, len(self.runs)),
            "total": self.total,
            "total_se": self.total_se,
            "total_spread": self.spread("total"),
            "effort": self.effort,
            "effort_se": self.effort_se,
            "obstacle": self.obstacle,
            "obstacle_se": self.obstacle_se,
            "goal": self.goal,
            "goal_se": self.goal_se,
            "collision_rate": self.collision_rate,
            "collision_low": low,
            "collision_high": high,
            "collision_spread": self.spread("collision"),
            "between_rate": self.between_rate,
            "between_low": between_low,
            "between_high": between_high,
            **{f"total_p{100 * q:02.0f}": v for q, v in self.cost_quantiles.items()},
            "total_cvar95": tail,
            "total_cvar95_se": tail_error,
            "position_rms": self.position_rms,
            "heading_rms": self.heading_rms,
            "speed_rms": self.speed_rms,
            **{f"clearance_p{100 * q:02.0f}": v for q, v in self.clearance_quantiles.items()},
            "clearance_cvar05": self.clearance_cvar,
            "failures": self.failures,
            "inference_time": self.inference_time,
            "preparation_time": self.preparation_time,
        }

    def _error(self, metric: str) -> float:
        paths = standard_error(self.per_path(metric))
        return _together(paths, standard_error(self.per_run(metric))) if self.runs else paths

    def _rate_interval(self, metric: str) -> tuple[float, float]:
        values = self.per_path(metric)
        low, high = rate_interval(values)
        if self.runs:
            # Never narrower than for a single controller, also where no run ever collided.
            error, freedom = welch(
                (standard_error(values), self.episodes),
                (standard_error(self.per_run(metric)), len(self.runs)),
            )
            _, lower, higher = student_interval(float(values.mean()), error, freedom)
            low, high = max(0.0, min(low, lower)), min(1.0, max(high, higher))
        return low, high


def leading(results: Mapping[str, Result], metric: str) -> Leader | None:
    """Which row has the least mean of a metric, and which ties; by paired differences."""
    means = {name: float(result.per_path(metric).mean()) for name, result in results.items()}

    def difference(name: str, best: str) -> Interval:
        row, reference = results[name], results[best]
        n = min(row.episodes, reference.episodes)
        paired = row.per_path(metric)[:n] - reference.per_path(metric)[:n]
        error = standard_error(paired)
        if not (row.runs or reference.runs) and paired.mean() > _FAR * error > 0.0:
            return student_interval(float(paired.mean()), error, float("inf"))
        return row.difference(reference, metric)

    return leader(means, difference)


def _together(paths: float, trainings: float) -> float:
    """Standard error from that over the paths and that over the trainings, which met the same."""
    return float(np.hypot(paths, trainings))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values * values)))

"""What is measured of an episode, and what `evaluate` says about many (SPEC §2, §7)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.statistics import standard_error, wilson_interval

#: Quantiles of the clearance that tables show.
CLEARANCE_QUANTILES = (0.01, 0.05, 0.5)


@dataclasses.dataclass(frozen=True)
class EpisodeMetrics:
    """Per-episode numbers, every array (episodes,).

    Attributes:
        effort: Σ dt ‖u_k‖².
        obstacle: Σ dt λ Σ_o max(0, c_o)².
        goal: (x_N − x^f)ᵀ W (x_N − x^f).
        collision: whether any node 1..N−1 lay inside a bare radius.
        clearance: smallest signed distance to a rim over nodes 1..N−1 [m]; inf without obstacles.
        position_error: ‖r_N − r^f‖ [m].
        heading_error: |θ_N − θ^f| [rad], unwrapped, as the goal cost has it.
        speed_error: |v_N − v^f| [m/s].
    """

    effort: np.ndarray
    obstacle: np.ndarray
    goal: np.ndarray
    collision: np.ndarray
    clearance: np.ndarray
    position_error: np.ndarray
    heading_error: np.ndarray
    speed_error: np.ndarray

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
        final: np.ndarray,
    ) -> EpisodeMetrics:
        """From the sums over a path and its last state (episodes, 5)."""
        error = scenario.terminal(final)
        return cls(
            effort=effort,
            obstacle=obstacle,
            goal=scenario.goal_cost(final),
            collision=clearance < 0.0,
            clearance=clearance,
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
        return EpisodeMetrics(**{name: getattr(self, name)[:episodes] for name in FIELDS})

    def to_dict(self) -> dict[str, np.ndarray]:
        """Name -> array."""
        return {name: getattr(self, name) for name in FIELDS}


FIELDS = tuple(field.name for field in dataclasses.fields(EpisodeMetrics))


@dataclasses.dataclass(frozen=True)
class Result:
    """What a controller did over many episodes; what :func:`slipcar.evaluation.evaluate` returns.

    Means come with standard errors (`total`, `total_se`), the collision rate with its Wilson
    95 % interval. The per-episode arrays are in `metrics`.

    Attributes:
        metrics: per-episode arrays; row i depends on (seed, i) alone.
        seed: of the Brownian paths.
        substeps: Euler–Maruyama steps in each control interval.
        closed_loop: whether the controller looks at the state.
        failures: solves behind the controller that failed (a plan that did not converge is one).
        inference_time: seconds inside `predict` per step and episode.
        preparation_time: seconds of planning or training before; nan when unknown.
        wall_time: seconds this evaluation took.
    """

    metrics: EpisodeMetrics
    seed: int
    substeps: int
    closed_loop: bool
    failures: int
    inference_time: float
    preparation_time: float
    wall_time: float

    @property
    def episodes(self) -> int:
        """How many episodes."""
        return len(self.metrics)

    @property
    def collision_rate(self) -> float:
        """Share of episodes that touch a bare obstacle at a node."""
        return float(self.metrics.collision.mean())

    @property
    def collision_interval(self) -> tuple[float, float]:
        """Wilson 95 % interval of the collision rate."""
        return wilson_interval(int(self.metrics.collision.sum()), self.episodes)

    @property
    def total(self) -> float:
        """Mean cost of a path."""
        return float(self.metrics.total.mean())

    @property
    def total_se(self) -> float:
        """Standard error of `total`."""
        return standard_error(self.metrics.total)

    @property
    def effort(self) -> float:
        """Mean effort."""
        return float(self.metrics.effort.mean())

    @property
    def effort_se(self) -> float:
        """Standard error of `effort`."""
        return standard_error(self.metrics.effort)

    @property
    def obstacle(self) -> float:
        """Mean obstacle cost."""
        return float(self.metrics.obstacle.mean())

    @property
    def obstacle_se(self) -> float:
        """Standard error of `obstacle`."""
        return standard_error(self.metrics.obstacle)

    @property
    def goal(self) -> float:
        """Mean goal cost."""
        return float(self.metrics.goal.mean())

    @property
    def goal_se(self) -> float:
        """Standard error of `goal`."""
        return standard_error(self.metrics.goal)

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
    def clearance_quantiles(self) -> dict[float, float]:
        """Quantile -> clearance [m], for :data:`CLEARANCE_QUANTILES`."""
        # No interpolation: between infinities (no obstacles) there is nothing to interpolate.
        values = np.quantile(self.metrics.clearance, CLEARANCE_QUANTILES, method="inverted_cdf")
        return dict(zip(CLEARANCE_QUANTILES, values.tolist(), strict=True))

    def summary(self) -> dict[str, float | int | bool]:
        """Every aggregate as one flat row, SI units: a row of `Comparison.frame`."""
        low, high = self.collision_interval
        return {
            "closed_loop": self.closed_loop,
            "episodes": self.episodes,
            "total": self.total,
            "total_se": self.total_se,
            "effort": self.effort,
            "effort_se": self.effort_se,
            "obstacle": self.obstacle,
            "obstacle_se": self.obstacle_se,
            "goal": self.goal,
            "goal_se": self.goal_se,
            "collision_rate": self.collision_rate,
            "collision_low": low,
            "collision_high": high,
            "position_rms": self.position_rms,
            "heading_rms": self.heading_rms,
            "speed_rms": self.speed_rms,
            **{f"clearance_p{100 * q:02.0f}": v for q, v in self.clearance_quantiles.items()},
            "failures": self.failures,
            "inference_time": self.inference_time,
            "preparation_time": self.preparation_time,
        }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values * values)))

"""Families of random scenarios: what varies from episode to episode, and how much.

A `Family` is data: ranges for the number and size of obstacles, the goal's distance and bearing,
both headings, slip and horizon. Environments draw a world of it for every episode; a curriculum
moves from an easy family to a hard one (:meth:`Family.towards`).

Worlds drawn for training come from an environment's own generator. :meth:`Family.sample` and
:meth:`Family.held_out` have streams of their own, so no seed of training leads to a world of the
held-out test.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from slipcar.envs.noise import uniforms
from slipcar.envs.scenario import Scenario
from slipcar.envs.validate import checked_array, checked_float, checked_int, parsed_object, replaced

#: Seeds of :meth:`Family.held_out`: 100 worlds that stay what they are.
HELD_OUT_SEEDS = tuple(range(100))
_SAMPLE, _HELD_OUT = 0x5A, 0x7E57

#: Numbers in front of those of the obstacles; then three for each.
_COMMON, _EACH = 7, 3
#: Between an obstacle's clearance ring and both ends of the way [m].
_MARGIN = 0.1
_RANGES = ("distance", "bearing", "radius", "slip", "horizon")


class Draw(NamedTuple):
    """Worlds of one family, one row each: what differs between them.

    Attributes:
        start: (rows, 5).
        goal: (rows, 5).
        horizon: (rows,) [s].
        slip: (rows, 2), α² and β².
        obstacles: (rows, k, 3); those beyond `counts` are to be ignored.
        counts: (rows,), how many obstacles there are.
    """

    start: np.ndarray
    goal: np.ndarray
    horizon: np.ndarray
    slip: np.ndarray
    obstacles: np.ndarray
    counts: np.ndarray


@dataclasses.dataclass(frozen=True)
class Family:
    """Random scenarios; a range is (smallest, largest), drawn from uniformly.

    The car starts at the origin. Obstacles fall into a corridor round the straight line to the
    goal, with their clearance rings at least 0.1 m from both ends.

    Attributes:
        obstacles: number of obstacles, 0 to 64.
        radius: of each [m], > 0.
        corridor: half width of the corridor that centres fall into [m], >= 0.
        distance: from start to goal [m]; at least twice the largest radius, clearance and 0.1 m.
        bearing: direction of the goal [rad].
        start_heading: largest |heading − bearing| at the start [rad], 0 to π.
        goal_heading: largest difference of the goal's heading from the start's [rad], 0 to π.
        slip: α², >= 0; β² is a tenth of it, as in the paper.
        horizon: T [s], > 0.
        base: gives everything else (nodes, weights, clearance, bounds, process noise, ...).

    Raises:
        ValueError: naming the field, the bad value and what is allowed.
    """

    obstacles: tuple[int, int] = (1, 8)
    radius: tuple[float, float] = (0.15, 0.4)
    corridor: float = 1.2
    distance: tuple[float, float] = (2.5, 4.5)
    bearing: tuple[float, float] = (-math.pi, math.pi)
    start_heading: float = math.pi / 3
    goal_heading: float = 0.0
    slip: tuple[float, float] = (0.1, 0.1)
    horizon: tuple[float, float] = (5.0, 5.0)
    base: Scenario = dataclasses.field(default_factory=lambda: Scenario.named("open"))

    def __post_init__(self) -> None:
        counts = tuple(self.obstacles) if np.ndim(self.obstacles) else (self.obstacles,) * 2
        if len(counts) != 2:
            raise ValueError(f"obstacles must be (fewest, most), not {self.obstacles!r}")
        fewest = checked_int("obstacles[0]", counts[0], at_least=0, at_most=64)
        most = checked_int("obstacles[1]", counts[1], at_least=fewest, at_most=64)
        object.__setattr__(self, "obstacles", (fewest, most))
        object.__setattr__(self, "base", Scenario.of(self.base))
        for name in _RANGES:
            object.__setattr__(self, name, _checked_range(name, getattr(self, name)))
        for name in ("radius", "horizon"):
            checked_float(f"{name}[0]", getattr(self, name)[0], above=0.0)
        checked_float("slip[0]", self.slip[0], at_least=0.0)
        object.__setattr__(self, "corridor", checked_float("corridor", self.corridor, at_least=0.0))
        for name in ("start_heading", "goal_heading"):
            value = checked_float(name, getattr(self, name), at_least=0.0)
            if value > math.pi:
                raise ValueError(f"{name} must be between 0 and π, not {value:g}")
            object.__setattr__(self, name, value)
        nearest = 2.0 * (self.radius[1] + self.base.clearance + _MARGIN) if most else 0.0
        checked_float("distance[0]", self.distance[0], at_least=nearest)

    # ------------------------------------------------------------------------------ drawing

    @property
    def words(self) -> int:
        """Random words that one world takes; see :mod:`slipcar.envs.noise`."""
        return _COMMON + _EACH * self.obstacles[1]

    def draw(self, words: np.ndarray) -> Draw:
        """Worlds from random words, (rows, `words`) uint64, one row each."""
        u = uniforms(words)
        most = self.obstacles[1]
        distance, bearing = _within(self.distance, u[:, 0]), _within(self.bearing, u[:, 1])
        start_heading = bearing + self.start_heading * (2.0 * u[:, 2] - 1.0)
        goal_heading = start_heading + self.goal_heading * (2.0 * u[:, 3] - 1.0)
        count = self.obstacles[0] + np.floor(u[:, 4] * (most + 1 - self.obstacles[0]))
        alpha, horizon = _within(self.slip, u[:, 5]), _within(self.horizon, u[:, 6])
        forward = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
        start, goal = np.zeros((len(u), 5)), np.zeros((len(u), 5))
        start[:, 2], goal[:, 2] = start_heading, goal_heading
        goal[:, :2] = distance[:, None] * forward
        each = u[:, _COMMON:].reshape(len(u), most, _EACH)
        radius = _within(self.radius, each[..., 0])
        along = each[..., 1] * distance[:, None]
        aside = self.corridor * (2.0 * each[..., 2] - 1.0)
        along, aside = _clear_of_ends(
            along, aside, distance[:, None], radius + self.base.clearance + _MARGIN
        )
        obstacles = np.empty((len(u), most, 3))
        obstacles[..., 0] = along * forward[:, None, 0] - aside * forward[:, None, 1]
        obstacles[..., 1] = along * forward[:, None, 1] + aside * forward[:, None, 0]
        obstacles[..., 2] = radius
        slip = np.stack([alpha, 0.1 * alpha], axis=-1)
        return Draw(start, goal, horizon, slip, obstacles, count.astype(np.int64))

    def world(self, words: np.ndarray) -> Scenario:
        """The world that `words` (`words`,) make."""
        drawn = self.draw(words[None])
        return self.base.replace(
            start=drawn.start[0],
            goal=drawn.goal[0],
            horizon=float(drawn.horizon[0]),
            slip=drawn.slip[0],
            obstacles=drawn.obstacles[0, : drawn.counts[0]],
        )

    def sample(self, seed: int) -> Scenario:
        """A world by number; the same seed gives the same world.

        Raises:
            ValueError: for a negative seed.
        """
        return self._numbered(seed, _SAMPLE)

    def held_out(self, count: int = len(HELD_OUT_SEEDS)) -> list[Scenario]:
        """The first worlds of the test set (:data:`HELD_OUT_SEEDS`), which no training draws.

        Raises:
            ValueError: for a number below 1 or above 100.
        """
        checked_int("count", count, at_least=1, at_most=len(HELD_OUT_SEEDS))
        return [self._numbered(seed, _HELD_OUT) for seed in HELD_OUT_SEEDS[:count]]

    def _numbered(self, seed: int, stream: int) -> Scenario:
        checked_int("seed", seed, at_least=0)
        return self.world(np.random.SeedSequence((seed, stream)).generate_state(self.words, "u8"))

    # ----------------------------------------------------------------------- other families

    def replace(self, **changes: Any) -> Family:
        """A copy with some fields changed, validated again.

        Raises:
            ValueError: for an unknown field or a bad value.
        """
        return replaced(self, "family", changes)

    def towards(self, other: Family, level: float) -> Family:
        """The family between this one (level 0) and `other` (level 1): a curriculum.

        Ranges are interpolated at both ends, numbers of obstacles rounded; `base` stays.

        Raises:
            ValueError: for a level outside [0, 1].
        """
        if not isinstance(other, Family):
            raise ValueError(f"a curriculum leads to a Family, not to {other!r}")
        level = checked_float("level", level, at_least=0.0)
        if level > 1.0:
            raise ValueError(f"level must be between 0 and 1, not {level:g}")
        changes: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            if field.name != "base":
                a = np.asarray(getattr(self, field.name), dtype=float)
                b = np.asarray(getattr(other, field.name), dtype=float)
                changes[field.name] = ((1.0 - level) * a + level * b).tolist()
        changes["obstacles"] = tuple(round(count) for count in changes["obstacles"])
        return dataclasses.replace(self, **changes)

    @staticmethod
    def names() -> list[str]:
        """Names that :meth:`named` knows."""
        return list(NAMED)

    @classmethod
    def named(cls, name: str) -> Family:
        """A family by name.

        Raises:
            ValueError: for an unknown name, listing the known ones.
        """
        if not isinstance(name, str) or name not in NAMED:
            raise ValueError(f"unknown family {name!r}; the named ones are {cls.names()}")
        return cls(**NAMED[name])

    # ------------------------------------------------------------------------- as plain data

    def to_dict(self) -> dict[str, Any]:
        """Plain Python data."""
        data = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        data["base"] = self.base.to_dict()
        return {k: list(v) if isinstance(v, tuple) else v for k, v in data.items()}

    def to_json(self) -> str:
        """JSON text; `from_json` gives back an equal family."""
        return json.dumps(self.to_dict())

    @classmethod
    def from_json(cls, text: str) -> Family:
        """The family that :meth:`to_json` wrote.

        Raises:
            ValueError: if the text is no JSON object, has unknown fields, or a value is out of
                range.
        """
        return cls.from_dict(parsed_object(text, "family"))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Family:
        """The family that :meth:`to_dict` gave.

        Raises:
            ValueError: for unknown fields or a value out of range.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        unknown = sorted(set(data) - set(known))
        if unknown:
            raise ValueError(f"not a family: unknown fields {unknown}; the fields are {known}")
        return cls(**data)


#: What the named families change; the rest is the default.
NAMED: dict[str, dict[str, Any]] = {
    # As Scenario.random draws them: goal 2.5 to 4.5 m away, up to eight obstacles.
    "random": {},
    # Two obstacles at most, nearer and nearly straight ahead: where a curriculum may begin.
    "easy": {
        "obstacles": (0, 2),
        "radius": (0.15, 0.25),
        "distance": (2.0, 3.0),
        "start_heading": math.pi / 6,
    },
    # Any heading at both ends: the car must turn, reverse, or both.
    "turned": {"start_heading": math.pi, "goal_heading": math.pi},
    # From a dry road to one five times as slippery as the paper's.
    "slippery": {"slip": (0.0, 0.5)},
    "crowded": {"obstacles": (8, 14), "radius": (0.1, 0.25), "distance": (3.5, 4.5)},
}


def _checked_range(name: str, value: Any) -> tuple[float, float]:
    ends = checked_array(name, value, (2,), repeat_scalar=True)
    if ends[0] > ends[1]:
        raise ValueError(f"{name} must be (smallest, largest), not ({ends[0]:g}, {ends[1]:g})")
    return float(ends[0]), float(ends[1])


def _within(ends: tuple[float, float], fraction: np.ndarray) -> np.ndarray:
    return ends[0] + (ends[1] - ends[0]) * fraction


def _clear_of_ends(
    along: np.ndarray, aside: np.ndarray, distance: np.ndarray, margin: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centres in coordinates of the way, moved away from both ends to at least `margin`.

    Straight away from the nearer end: what lies between it and half the way is squeezed into what
    lies between the margin and half the way.
    """
    end = np.where(along < 0.5 * distance, 0.0, distance)
    offset = along - end
    gap = np.maximum(np.hypot(offset, aside), 1e-9)
    moved = np.maximum(gap, margin + gap * (1.0 - 2.0 * margin / distance))
    return end + offset * moved / gap, aside * moved / gap

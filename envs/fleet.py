"""The worlds of a fleet: which scenario each car drives in, as numbers side by side.

Where all cars share one scenario its numbers are floats, and a step costs no more for knowing
them. Where they differ each number is an array with one entry per car.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.envs import car
from slipcar.envs.families import Draw
from slipcar.envs.parameters import ABSENT, Parameters, obstacle_columns
from slipcar.envs.scenario import Scenario
from slipcar.envs.sources import Source, base_of, most_obstacles


class Worlds:
    """One world for each of `count` cars.

    Attributes:
        shared: the scenario of all, or None where they differ.
        parameters: the numbers of a step; arrays (count,) where cars differ.
        steps: control steps of an episode, (count,).

    Args:
        count: how many cars.
        dtype: of the arrays in `parameters`.
        scenario: what all begin with.
    """

    def __init__(self, count: int, dtype: type, scenario: Scenario) -> None:
        self._count, self._dtype = count, dtype
        self._drawn: Draw | None = None
        self.share(scenario)

    def share(self, scenario: Scenario) -> None:
        """Put all cars into one scenario."""
        self.shared: Scenario | None = scenario
        self._parts: dict[tuple[int, int], Parameters] = {}
        self.parameters = Parameters.like(np.empty(self._count, dtype=self._dtype), scenario)
        self.steps = np.full(self._count, scenario.nodes - 1)
        self.start = np.repeat(scenario.start[:, None], self._count, axis=1)
        self.start_deviation = scenario.start_deviation[:, None]
        self.tolerance = scenario.goal_tolerance[:, None]
        self.action_scale: np.ndarray = scenario.action_scale[:, None].astype(self._dtype)

    def part(self, here: slice) -> Parameters:
        """The numbers of a step for some cars side by side."""
        if self.shared is not None:
            return self.parameters
        key = (here.start, here.stop)
        if key not in self._parts:
            p = self.parameters
            self._parts[key] = Parameters(
                dt=p.dt[here],
                horizon=p.horizon[here],
                slip=[s[here] for s in p.slip],
                process=tuple((i, deviation[here]) for i, deviation in p.process),
                obstacles=tuple(column[:, here] for column in p.obstacles),
                obstacle_weight=p.obstacle_weight[here],
                goal=[g[here] for g in p.goal],
                goal_weight=[w[here] for w in p.goal_weight],
            )
        return self._parts[key]

    def put(self, here: np.ndarray, source: Source, drawn: Draw | None) -> None:
        """Put the cars `here` (indices) into a scenario, or into worlds drawn from a family."""
        base = base_of(source)
        if drawn is not None:
            self._keep(here, drawn)
        self._part(most_obstacles(source), {i for i, _ in base.process})
        p = self.parameters
        nodes = base.nodes
        horizon = base.horizon if drawn is None else drawn.horizon
        p.horizon[here] = horizon
        p.dt[here] = horizon / (nodes - 1)
        self.steps[here] = nodes - 1
        slip = base.slip[:, None] if drawn is None else drawn.slip.T
        start = base.start[:, None] if drawn is None else drawn.start.T
        goal = base.goal[:, None] if drawn is None else drawn.goal.T
        for i in range(2):
            p.slip[i][here] = slip[i]
        for i in range(5):
            p.goal[i][here], p.goal_weight[i][here] = goal[i], base.goal_weight[i]
        for i, deviation in p.process:
            deviation[here] = base.process_noise[i]
        self.start[:, here] = start
        self.start_deviation[:, here] = base.start_deviation[:, None]
        self.tolerance[:, here] = base.goal_tolerance[:, None]
        self.action_scale[:, here] = base.action_scale[:, None]
        p.obstacle_weight[here] = base.obstacle_weight
        obstacles = base.obstacles[None] if drawn is None else drawn.obstacles
        count = np.array([len(base.obstacles)]) if drawn is None else drawn.counts
        k = obstacles.shape[1]
        columns = obstacle_columns(obstacles, base.clearance)
        there = np.arange(k) < count[:, None]
        for column, value, absent in zip(p.obstacles, columns, ABSENT, strict=True):
            column[:k, here] = np.where(there, value, absent).T
            column[k:, here] = absent

    def scenario(self, i: int, source: Source) -> Scenario:
        """The world of car i, which was put into one of `source`."""
        if isinstance(source, Scenario):
            return source
        assert self._drawn is not None
        start, goal, horizon, slip, obstacles, counts = (field[i] for field in self._drawn)
        return source.base.replace(
            start=start,
            goal=goal,
            horizon=float(horizon),
            slip=slip,
            obstacles=obstacles[:counts],
        )

    def _keep(self, here: np.ndarray, drawn: Draw) -> None:
        """Remember worlds as they were drawn: the arrays of a step are rounded."""
        most = drawn.obstacles.shape[1]
        room = old = self._drawn
        if room is None or room.obstacles.shape[1] < most:
            fields = [np.zeros((self._count, *field.shape[1:]), field.dtype) for field in drawn]
            self._drawn = room = Draw(*fields)
            if old is not None:
                for new, field in zip(room, old, strict=True):
                    new[tuple(slice(n) for n in field.shape)] = field
        for kept, field in zip(room, drawn, strict=True):
            corner: Any = (here, *(slice(n) for n in field.shape[1:]))
            kept[corner] = field

    def noise_columns(self, reached: list[int]) -> list[int]:
        """Where variates belong among the fleet's: three of the slip, then one for each state."""
        known = [i for i, _ in self.parameters.process]
        return [0, 1, 2, *(car.NOISE_DIM + known.index(i) for i in reached)]

    def _part(self, obstacles: int, process: set[int]) -> None:
        """Numbers of its own for every car, with room for obstacles and process noise."""
        shared = self.shared
        count, dtype = self._count, self._dtype

        def array(value: float) -> np.ndarray:
            return np.full(count, value, dtype=dtype)

        if shared is not None:
            p = self.parameters
            self.parameters = Parameters(
                dt=array(p.dt),
                horizon=array(p.horizon),
                slip=[array(s) for s in p.slip],
                process=tuple((i, array(value)) for i, value in p.process),
                obstacles=tuple(np.repeat(column, count, axis=1) for column in p.obstacles),
                obstacle_weight=array(p.obstacle_weight),
                goal=[array(g) for g in p.goal],
                goal_weight=[array(w) for w in p.goal_weight],
            )
            for name in ("start_deviation", "tolerance", "action_scale"):
                setattr(self, name, np.repeat(getattr(self, name), count, axis=1))
            self.shared = None
        p = self.parameters
        self._parts = {}
        missing = max(0, obstacles - len(p.obstacles[0]))
        absent: list[np.ndarray] = [
            np.full((missing, count), value, dtype=dtype) for value in ABSENT
        ]
        known = dict(p.process)
        reached = {i: known.get(i, array(0.0)) for i in sorted(process | set(known))}
        self.parameters = p._replace(
            obstacles=tuple(np.concatenate(pair) for pair in zip(p.obstacles, absent, strict=True)),
            process=tuple(reached.items()),
        )

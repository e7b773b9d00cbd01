"""Ways round the obstacles, as trajectories for a planner to start from.

What a planner makes of a route depends mostly on two choices: the side on which it passes every
obstacle (:mod:`.ways`), for a convex model of an obstacle is a half-plane, and no step crosses it;
and whether it is driven forwards or backwards, for the car may reverse.
"""

from __future__ import annotations

import math

import numpy as np

from slipcar.envs.parameters import Task
from slipcar.envs.ways import cubic, sideways, smooth, ways, windings

Array = np.ndarray

#: So many ways are looked at more closely, each in both gears; and where there are few ways, with
#: the heading turned the other way round, too.
_WAYS, _FEW, _MANY = 8, 2, 4
#: Part of the horizon in which the heading turns from the start's to the route's, and at the end.
_TURNING = 0.5


def guesses(scenario: Task, count: int) -> list[tuple[str, Array, Array]]:
    """Up to `count` routes, the most promising first: label, states (N, 5), controls (N−1, 2).

    No two are of the same class and gear. Promising is what costs little as it stands: the
    controls that its speeds and headings ask for, and the obstacles it still touches.
    """
    found = []
    known = ways(scenario, max(_WAYS, count))
    turns = _FEW if len(known) * _FEW >= count else _MANY
    for way in known:
        for half_turns in _nearest_half_turns(scenario, way.path, turns):
            x, u = trajectory(scenario, way.path, half_turns)
            power = np.sum(scenario.control_power(u)) + np.sum(scenario.obstacle_power(x[1:]))
            found.append((float(power), f"{way}{_gear(half_turns)}", x, u))
    found.sort(key=lambda route: route[0])
    return [(name, x, u) for _, name, x, u in found[:count]]


def arc(scenario: Task, bulge: float) -> tuple[Array, Array]:
    """One arc in its nearest gear: states (N, 5), controls (N−1, 2).

    Args:
        scenario: where to drive.
        bulge: in parts of the distance from start to goal; positive to the left, 0 straight.
    """
    s = smooth(scenario.times / scenario.horizon)
    path = cubic(scenario) + bulge * np.sin(np.pi * s)[:, None] * sideways(scenario)
    return trajectory(scenario, path, _nearest_half_turns(scenario, path, 1)[0])


def homotopy_class(scenario: Task, states: Array) -> tuple[int, ...]:
    """Winding number of a path about each obstacle, (k,), counter-clockwise.

    Counted from the way that turns the least about that obstacle, so 0 means "on the side where
    the straight line passes it" and ±1 "on the other".

    Args:
        scenario: gives obstacles, start and goal.
        states: (N, ≥ 2), positions first, from start to goal.
    """
    return tuple(int(w) for w in windings(scenario, np.asarray(states)[..., :2]))


def trajectory(scenario: Task, path: Array, half_turns: int) -> tuple[Array, Array]:
    """Speeds, headings and controls along node positions: states (N, 5), controls (N−1, 2).

    Args:
        scenario: gives times and the states at both ends.
        path: node positions, (N, 2) [m].
        half_turns: heading less direction of travel, in units of π: even drives forwards, odd
            backwards.
    """
    times, turning = scenario.times, _TURNING * scenario.horizon
    travel = np.diff(path, axis=0)
    direction = np.unwrap(np.arctan2(travel[:, 1], travel[:, 0]))
    direction = np.append(direction, direction[-1])
    gear = 1.0 if half_turns % 2 == 0 else -1.0
    heading = direction + math.pi * half_turns
    heading += (scenario.start[2] - heading[0]) * (1.0 - smooth(times / turning))
    heading += (scenario.goal[2] - heading[-1]) * smooth(1.0 - (times[-1] - times) / turning)
    x = np.empty((len(times), 5))
    x[:, :2], x[:, 2] = path, heading
    x[:-1, 3] = gear * np.hypot(travel[:, 0], travel[:, 1]) / scenario.dt
    x[:-1, 4] = np.diff(heading) / scenario.dt
    x[0], x[-1] = scenario.start, scenario.goal
    u = np.diff(x[:, 3:], axis=0) / scenario.dt
    if scenario.control_bounds is not None:
        u = np.clip(u, -scenario.control_bounds, scenario.control_bounds)
    return x, u


def _nearest_half_turns(scenario: Task, path: Array, count: int) -> list[int]:
    """The gears whose headings along the path are nearest those of both ends."""
    travel = np.diff(path, axis=0)
    direction = np.unwrap(np.arctan2(travel[:, 1], travel[:, 0]))
    turned = scenario.start[2] + scenario.goal[2] - direction[0] - direction[-1]
    nearest = 0.5 * turned / math.pi
    candidates = range(math.floor(nearest) - count, math.floor(nearest) + count + 2)
    return sorted(candidates, key=lambda half_turns: abs(half_turns - nearest))[:count]


def _gear(half_turns: int) -> str:
    gear = ", backwards" if half_turns % 2 else ""
    turns = half_turns // 2
    return f"{gear}, turned {turns:+d}" if turns else gear

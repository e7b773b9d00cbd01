"""Ways round the obstacles, as trajectories for a planner to start from.

    r(s) = start + s d + [h₁ sin πs + h₂ sin 2πs] d⊥,     d = goal − start,   0 ≤ s ≤ 1

A fan of such curves is sorted by which side of every obstacle they pass (their winding numbers);
the cheapest of each class is pushed clear of the obstacles and driven forwards and backwards,
for the car may reverse. What a planner makes of a route depends mostly on these two choices: a
convex model of an obstacle is a half-plane, and no step crosses it.

The same winding numbers, of any path, name its homotopy class (strictly, its homology class:
they do not tell in which order a path winds round two obstacles).
"""

from __future__ import annotations

import math

import numpy as np

from slipcar.envs.parameters import Task

Array = np.ndarray

#: h₁ and h₂ of the fan: first and second harmonic, in parts of the distance.
_BULGES, _BENDS = np.linspace(-1.2, 1.2, 13), np.linspace(-0.6, 0.6, 7)
#: So many classes are looked at more closely, each in both gears.
_CLASSES = 8
#: Part of the horizon in which the heading turns from the start's to the route's, and at the end.
_TURNING = 0.5
#: How much beyond radius and clearance a route is pushed, and in how many steps.
_MARGIN, _PUSHES = 1.05, 20


def guesses(scenario: Task, count: int) -> list[tuple[str, Array, Array]]:
    """Up to `count` routes, the most promising first: label, states (N, 5), controls (N−1, 2).

    No two are of the same class and gear. Promising is what costs little as it stands: the
    controls that its speeds and headings ask for, and the obstacles it still touches.
    """
    labels, paths = _one_of_each_class(scenario)
    found: dict[tuple[tuple[int, ...], int], tuple[float, str, Array, Array]] = {}
    classes = map(tuple, _windings(scenario, paths).tolist())
    for label, path, windings in zip(labels, paths, classes, strict=True):
        for half_turns in _nearest_half_turns(scenario, path, 2):
            x, u = trajectory(scenario, path, half_turns)
            power = np.sum(scenario.control_power(u)) + np.sum(scenario.obstacle_power(x[1:]))
            gear = half_turns % 2
            name = f"{label}, backwards" if gear else label
            if (windings, gear) not in found or power < found[windings, gear][0]:
                found[windings, gear] = (float(power), name, x, u)
    ranked = sorted(found.values(), key=lambda route: route[0])
    return [(name, x, u) for _, name, x, u in ranked[:count]]


def arc(scenario: Task, bulge: float) -> tuple[Array, Array]:
    """One arc in its nearest gear: states (N, 5), controls (N−1, 2).

    Args:
        scenario: where to drive.
        bulge: h₁, in parts of the distance from start to goal; positive to the left, 0 straight.
    """
    path = _fan(scenario, np.array([bulge]), np.zeros(1))[0]
    return trajectory(scenario, path, _nearest_half_turns(scenario, path, 1)[0])


def homotopy_class(scenario: Task, states: Array) -> tuple[int, ...]:
    """Winding number of a path about each obstacle, (k,), counter-clockwise.

    Counted from the way that turns the least about that obstacle, so 0 means "on the side where
    the straight line passes it" and ±1 "on the other".

    Args:
        scenario: gives obstacles, start and goal.
        states: (N, ≥ 2), positions first, from start to goal.
    """
    return tuple(int(w) for w in _windings(scenario, np.asarray(states)[..., :2]))


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
    heading += (scenario.start[2] - heading[0]) * (1.0 - _smooth(times / turning))
    heading += (scenario.goal[2] - heading[-1]) * _smooth(1.0 - (times[-1] - times) / turning)
    x = np.empty((len(times), 5))
    x[:, :2], x[:, 2] = path, heading
    x[:-1, 3] = gear * np.hypot(travel[:, 0], travel[:, 1]) / scenario.dt
    x[:-1, 4] = np.diff(heading) / scenario.dt
    x[0], x[-1] = scenario.start, scenario.goal
    u = np.diff(x[:, 3:], axis=0) / scenario.dt
    if scenario.control_bounds is not None:
        u = np.clip(u, -scenario.control_bounds, scenario.control_bounds)
    return x, u


def _one_of_each_class(scenario: Task) -> tuple[list[str], Array]:
    """Labels and node positions (c, N, 2) of the cheapest curve of each class, pushed clear."""
    bulges, bends = (a.ravel() for a in np.meshgrid(_BULGES, _BENDS, indexing="ij"))
    fan = _fan(scenario, bulges, bends)
    lengths = np.sum(np.hypot(*np.moveaxis(np.diff(fan, axis=1), -1, 0)), axis=-1)
    # From rest to rest along a way of length l takes ∫ a² dt = 12 l² / T³ at least.
    cost = 12.0 * lengths**2 / scenario.horizon**3
    cost += scenario.dt * np.sum(scenario.obstacle_power(fan), axis=-1)
    order = np.argsort(cost, kind="stable")
    _, first = np.unique(_windings(scenario, fan)[order], axis=0, return_index=True)
    chosen = order[np.sort(first)[:_CLASSES]]
    labels = [_label(bulges[i], bends[i]) for i in chosen]
    return labels, _pushed_clear(scenario, fan[chosen])


def _fan(scenario: Task, bulges: Array, bends: Array) -> Array:
    """The curves at the nodes, (f, N, 2), for harmonics (f,), fastest in the middle."""
    start, goal = scenario.start[:2], scenario.goal[:2]
    along = goal - start
    if not np.hypot(*along) > 0.0:  # a round trip: leave along the heading, a metre far
        along = np.array([math.cos(scenario.start[2]), math.sin(scenario.start[2])])
    sideways = np.array([-along[1], along[0]])
    s = _smooth(scenario.times / scenario.horizon)
    offset = bulges[:, None] * np.sin(np.pi * s) + bends[:, None] * np.sin(2.0 * np.pi * s)
    return start + s[:, None] * (goal - start) + offset[..., None] * sideways


def _pushed_clear(scenario: Task, paths: Array) -> Array:
    """Paths (c, N, 2) bent out of the discs of radius plus clearance, as smoothly as they were."""
    reach = _MARGIN * (scenario.obstacles[:, 2] + scenario.clearance)
    bent = np.zeros_like(paths)
    for _ in range(_PUSHES):
        offset = (paths + bent)[..., None, :] - scenario.obstacles[:, :2]
        distance = np.maximum(np.hypot(offset[..., 0], offset[..., 1]), 1e-9)
        inside = np.maximum(reach - distance, 0.0) / distance
        bent[:, 1:-1] += np.sum(inside[..., None] * offset, axis=-2)[:, 1:-1]
        bent[:, 1:-1] = 0.5 * bent[:, 1:-1] + 0.25 * (bent[:, :-2] + bent[:, 2:])
    return paths + bent


def _windings(scenario: Task, paths: Array) -> Array:
    """Winding numbers (..., k) of positions (..., N, 2)."""
    spokes = paths[..., :, None, :] - scenario.obstacles[:, :2]
    angles = np.arctan2(spokes[..., 1], spokes[..., 0])
    steps = np.diff(angles, axis=-2)
    swept = np.sum(steps - 2.0 * np.pi * np.round(steps / (2.0 * np.pi)), axis=-2)
    ends = np.stack([scenario.start[:2], scenario.goal[:2]])[:, None] - scenario.obstacles[:, :2]
    cross = ends[0, :, 0] * ends[1, :, 1] - ends[0, :, 1] * ends[1, :, 0]
    least = np.arctan2(cross, np.sum(ends[0] * ends[1], axis=-1))
    return np.round((swept - least) / (2.0 * np.pi)).astype(int)


def _nearest_half_turns(scenario: Task, path: Array, count: int) -> list[int]:
    """The gears whose headings along the path are nearest those of both ends."""
    travel = np.diff(path, axis=0)
    direction = np.unwrap(np.arctan2(travel[:, 1], travel[:, 0]))
    turned = scenario.start[2] + scenario.goal[2] - direction[0] - direction[-1]
    nearest = 0.5 * turned / math.pi
    candidates = range(math.floor(nearest) - count, math.floor(nearest) + count + 2)
    return sorted(candidates, key=lambda half_turns: abs(half_turns - nearest))[:count]


def _smooth(s: Array) -> Array:
    """The cubic from 0 to 1 that starts and ends level."""
    s = np.clip(s, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def _label(bulge: float, bend: float) -> str:
    if abs(bend) > 1e-9:
        return f"bend {bulge:+.1f} {bend:+.1f}"
    if abs(bulge) > 1e-9:
        return f"arc {'left' if bulge > 0 else 'right'} {abs(bulge):.1f}"
    return "straight"

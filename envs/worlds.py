"""The named scenarios and the seeded random family, as plain data."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

MAX_RANDOM_OBSTACLES = 8

#: Fields of the named scenarios; what is not given is Scenario's default, or that of the one
#: which it is `like`.
NAMED: dict[str, dict[str, Any]] = {
    # Paper §6.3, with the clearance of the released experiment (docs/method.md).
    "paper": {
        "start": (0.0, 0.0, 0.0, 0.0, 0.0),
        "goal": (2.2, 3.0, 0.0, 0.0, 0.0),
        "obstacles": ((1.5, 1.9, 0.2), (0.6, 2.0, 0.3), (1.15, 0.4, 0.3), (0.35, 0.75, 0.25)),
    },
    "open": {
        "start": (0.0, 0.0, 0.0, 0.0, 0.0),
        "goal": (2.2, 3.0, 0.0, 0.0, 0.0),
    },
    # Three posts astride the line of travel, to be passed on either side.
    "slalom": {
        "start": (0.0, 0.0, 0.0, 0.0, 0.0),
        "goal": (6.0, 0.0, 0.0, 0.0, 0.0),
        "obstacles": ((1.5, 0.1, 0.25), (3.0, -0.1, 0.25), (4.5, 0.1, 0.25)),
        "horizon": 12.0,
        "nodes": 97,
    },
    # Two large obstacles leave a gap of 0.6 m beside the straight line.
    "gap": {
        "start": (0.0, 0.0, 0.0, 0.0, 0.0),
        "goal": (3.0, 0.0, 0.0, 0.0, 0.0),
        "obstacles": ((1.5, -0.5, 0.6), (1.5, 1.3, 0.6)),
    },
    # 0.36 m between them, of which the clearance rings leave ten centimetres, on a way that bends.
    "narrow-gap": {
        "start": (0.0, -0.6, 0.0, 0.0, 0.0),
        "goal": (3.0, 0.6, 0.0, 0.0, 0.0),
        "obstacles": ((1.5, -0.78, 0.6), (1.5, 0.78, 0.6)),
    },
    # From a lane into a bay between two parked cars, at a right angle.
    "parking": {
        "start": (-1.5, 1.2, 0.0, 0.0, 0.0),
        "goal": (0.0, -0.3, -1.5707963267948966, 0.0, 0.0),
        "obstacles": (
            (-0.55, -0.35, 0.2),
            (-0.55, 0.05, 0.2),
            (0.55, -0.35, 0.2),
            (0.55, 0.05, 0.2),
        ),
        "horizon": 6.0,
        "nodes": 49,
    },
    # Round a wall of three posts and back.
    "u-turn": {
        "start": (0.0, 0.0, 0.0, 0.0, 0.0),
        "goal": (0.0, 1.6, 3.141592653589793, 0.0, 0.0),
        "obstacles": ((0.4, 0.8, 0.25), (0.9, 0.8, 0.25), (1.4, 0.8, 0.25)),
        "horizon": 8.0,
        "nodes": 65,
    },
    # The paper's world on a road twice as slippery.
    "icy": {"like": "paper", "slip": (0.2, 0.02)},
    # The paper's world, the start known to 5 cm and 3°, the pose disturbed on the way.
    "uncertain": {
        "like": "paper",
        "start_deviation": (0.05, 0.05, 0.05, 0.0, 0.0),
        "process_noise": (0.02, 0.02, 0.02, 0.0, 0.0),
    },
}


def named_world(name: str) -> dict[str, Any]:
    """Fields of a named scenario, with those that it shares with another."""
    fields = dict(NAMED[name])
    like = fields.pop("like", None)
    return fields if like is None else {**NAMED[like], **fields}


def random_world(seed: int, obstacles: int | None, turned: bool) -> dict[str, Any]:
    """Fields of a random scenario; the same arguments give the same world.

    The goal lies 2.5 to 4.5 m away in any direction. Obstacles of radius 0.15 to 0.4 m fall
    in a corridor round the straight line, with at least the clearance and 0.1 m between
    their rims and both ends.
    """
    rng = np.random.default_rng([seed, 0x51])
    count = int(rng.integers(1, MAX_RANDOM_OBSTACLES + 1)) if obstacles is None else obstacles
    distance, bearing = rng.uniform(2.5, 4.5), rng.uniform(-math.pi, math.pi)
    forward = np.array([math.cos(bearing), math.sin(bearing)])
    sideways = np.array([-forward[1], forward[0]])
    goal_position = distance * forward
    # Without turned headings the car starts and ends along the bearing ± 60°, as in the paper
    # (where the goal lies 54° to the left of the heading); with them, anything goes.
    spread = math.pi if turned else math.pi / 3
    start_heading = bearing + rng.uniform(-spread, spread)
    goal_heading = start_heading + (rng.uniform(-math.pi, math.pi) if turned else 0.0)
    rows: list[tuple[float, float, float]] = []
    while len(rows) < count:
        radius = rng.uniform(0.15, 0.4)
        centre = rng.uniform(0.0, 1.0) * goal_position + rng.normal(0.0, 0.7) * sideways
        margin = radius + 0.13 + 0.1
        if min(np.hypot(*centre), np.hypot(*(centre - goal_position))) > margin:
            rows.append((float(centre[0]), float(centre[1]), float(radius)))
    return {
        "start": (0.0, 0.0, start_heading, 0.0, 0.0),
        "goal": (float(goal_position[0]), float(goal_position[1]), goal_heading, 0.0, 0.0),
        "obstacles": tuple(rows),
    }

"""Ways round the obstacles of a plane, the cheapest first: branch and bound over sides.

A way minimises what bending costs and what obstacles do,

    ½ ∫₀¹ ‖r″(s)‖² ds + ½ Σ_i κ_i max(0, b_i − n_iᵀ r(s_i))²,     r and r′ given at both ends,

with one row i for each push that it has had: at the node s_i where it was deepest inside a disc,
along the normal n_i to the left or to the right of its travel, as far as the rim b_i. The minimum
is a cubic plus one Green's function of r⁗ for each row, with weights from a system as large as
there are rows. A way that is still inside some disc is pushed out of the worst one, to both sides
or to the side on which it passes already; rows only add cost, so taking the cheapest unfinished way
first finishes ways in the order of their cost. κ is that of the penalty for the time inside.

Winding numbers, of any path, name its homotopy class (strictly, its homology class: they do not
tell in which order a path winds round two obstacles).
"""

from __future__ import annotations

import functools
import heapq
import itertools
import math
from typing import NamedTuple

import numpy as np

from slipcar.envs.parameters import Task

Array = np.ndarray

#: A way is clear when it is inside no disc by more than this part of its radius, and nearly so by
#: this part: where no clear way is of its class, a planner may still make one of it.
_CLEAR, _NEARLY = 0.02, 0.4
#: A way has so many rows at most, and so many ways are looked at.
_ROWS, _LOOKS = 14, 60


class Way(NamedTuple):
    """Positions at the nodes, and how they came about."""

    path: Array  #: (N, 2) [m]
    cost: float  #: of bending and of obstacles, ∝ 1/T³
    sides: dict[int, int]  #: obstacle -> 1 passed with it on the right, −1 on the left

    def __str__(self) -> str:
        left, right = (sorted(o for o, side in self.sides.items() if side == s) for s in (1, -1))
        parts = (("left of", left), ("right of", right))
        named = [f"{words} {', '.join(map(str, which))}" for words, which in parts if which]
        return ", ".join(named) or "straight"


class _Row(NamedTuple):
    """κ/2 max(0, b − nᵀr_k)²."""

    node: int
    normal: Array
    rim: float
    stiffness: float


def ways(scenario: Task, count: int) -> list[Way]:
    """Up to `count` ways of different classes, the clear ones first, the cheapest of them first."""
    centres = scenario.obstacles[:, :2]
    reach = scenario.obstacles[:, 2] + scenario.clearance
    base, stiffness = cubic(scenario), _stiffness(scenario, reach)
    number = itertools.count()
    finished: dict[tuple[int, ...], Way] = {}
    nearly: dict[tuple[int, ...], Way] = {}
    heap: list[tuple[float, int, tuple[_Row, ...], Way]] = [
        (0.0, next(number), (), Way(base, 0.0, {}))
    ]
    for _ in range(_LOOKS):
        if not heap or len(finished) == count:
            break
        _, _, rows, way = heapq.heappop(heap)
        worst, node, depth = _deepest(way.path, centres, reach)
        if depth <= _NEARLY or len(rows) == _ROWS:
            clear = finished if depth <= _CLEAR else nearly
            clear.setdefault(tuple(windings(scenario, way.path).tolist()), way)
        if depth <= _CLEAR or len(rows) == _ROWS:
            continue
        travel = way.path[node + 1] - way.path[node - 1]
        left = np.array([-travel[1], travel[0]]) / max(float(np.hypot(*travel)), 1e-12)
        for side in (way.sides[worst],) if worst in way.sides else (1, -1):
            rim = float(side * left @ centres[worst] + reach[worst])
            pushed = (*rows, _Row(node, side * left, rim, stiffness[worst]))
            path, cost = _bent(base, pushed)
            new = Way(path, cost, {**way.sides, worst: side})
            heapq.heappush(heap, (cost, next(number), pushed, new))
    rest = [way for kind, way in nearly.items() if kind not in finished]
    return [*finished.values(), *rest][:count]


def cubic(scenario: Task) -> Array:
    """From start to goal on the straight line, level at both ends: (N, 2)."""
    start, goal = scenario.start[:2], scenario.goal[:2]
    return start + smooth(scenario.times / scenario.horizon)[:, None] * (goal - start)


def sideways(scenario: Task) -> Array:
    """The left normal of the straight line, as long as it; of a round trip, that of the heading."""
    along = scenario.goal[:2] - scenario.start[:2]
    if not np.hypot(*along) > 0.0:  # leave along the heading, a metre far
        along = np.array([math.cos(scenario.start[2]), math.sin(scenario.start[2])])
    return np.array([-along[1], along[0]])


def windings(scenario: Task, paths: Array) -> Array:
    """Winding numbers (..., k) of positions (..., N, 2)."""
    spokes = paths[..., :, None, :] - scenario.obstacles[:, :2]
    angles = np.arctan2(spokes[..., 1], spokes[..., 0])
    steps = np.diff(angles, axis=-2)
    swept = np.sum(steps - 2.0 * np.pi * np.round(steps / (2.0 * np.pi)), axis=-2)
    ends = np.stack([scenario.start[:2], scenario.goal[:2]])[:, None] - scenario.obstacles[:, :2]
    cross = ends[0, :, 0] * ends[1, :, 1] - ends[0, :, 1] * ends[1, :, 0]
    least = np.arctan2(cross, np.sum(ends[0] * ends[1], axis=-1))
    return np.round((swept - least) / (2.0 * np.pi)).astype(int)


def smooth(s: Array) -> Array:
    """The cubic from 0 to 1 that starts and ends level."""
    s = np.clip(s, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def _stiffness(scenario: Task, reach: Array) -> Array:
    """κ of each obstacle, (k,), where bending costs ∫ ‖r″‖² ds.

    The penalty λ max(0, ρ² − d²)² is λ (2ρ)² times the depth squared near the rim, for as long as
    crossing the disc takes.
    """
    distance = float(np.hypot(*sideways(scenario)))
    lasting = 2.0 * reach * scenario.horizon / distance
    return scenario.obstacle_weight * (2.0 * reach) ** 2 * lasting * scenario.horizon**3


def _deepest(path: Array, centres: Array, reach: Array) -> tuple[int, int, float]:
    """The obstacle that a path is deepest inside, the inner node, and the part of its radius."""
    if not len(reach) or len(path) < 3:
        return 0, 0, 0.0
    offset = path[:, None] - centres
    distance = np.hypot(offset[..., 0], offset[..., 1])
    nearest = np.argmin(distance[1:-1], axis=0) + 1
    depth = 1.0 - distance[nearest, np.arange(len(reach))] / reach
    worst = int(np.argmax(depth))
    return worst, int(nearest[worst]), float(depth[worst])


def _bent(base: Array, rows: tuple[_Row, ...]) -> tuple[Array, float]:
    """The way of least cost with these rows, (N, 2), and the cost.

    Rows that would pull are left out, one round after the other.
    """
    G = _greens_function(len(base))
    nodes, rims, kappas = (np.array([row[i] for row in rows]) for i in (0, 2, 3))
    normals = np.array([row.normal for row in rows])
    K = G[np.ix_(nodes, nodes)] * (normals @ normals.T) + np.diag(1.0 / np.maximum(kappas, 1e-12))
    missing = rims - np.einsum("ij,ij->i", normals, base[nodes])
    kept = np.arange(len(rows))
    while True:
        weights = np.linalg.solve(K[np.ix_(kept, kept)], missing[kept])
        if (weights > -1e-12).all():
            break
        kept = kept[weights > 0.0]
    path = base + (G[:, nodes[kept]] * weights) @ normals[kept]
    return path, 0.5 * float(weights @ missing[kept])


@functools.cache
def _greens_function(nodes: int) -> Array:
    """Of r⁗ with r = r′ = 0 at both ends, at evenly spaced nodes: (N, N)."""
    s = np.linspace(0.0, 1.0, nodes)
    a, b = np.minimum.outer(s, s), np.maximum.outer(s, s)
    return a * a * (1.0 - b) ** 2 * (3.0 * b - a - 2.0 * a * b) / 6.0

"""Collisions between nodes: how likely a path touches an obstacle where no node looks.

Between two Euler–Maruyama nodes a and b, h apart, the continuous path is a Brownian bridge round
the chord, with the diffusion of the step: D = σσᵀ of the position at a. It enters a half plane
whose border both ends keep away from, by d_a and d_b, with probability exp(−2 d_a d_b / (h nᵀDn)),
n the normal (:mod:`slipcar.planner.moments.bridge`: the planner's promises have it too). Of the
half planes that touch an obstacle's rim the one with the largest d_a d_b / nᵀDn counts; that the
rim curves away from it, with radius δ, is worth a factor:

    q = exp(−2 d_a d_b / (h nᵀDn)) / √(1 + 2 d_a d_b / (δ (d_a + d_b)))

and q = 1 where the chord itself enters. That factor is for the same noise in all directions;
another stretches the plane to such a one, in which the rim is an ellipse, whose radius at n is the
one that counts: δ becomes δ (nᵀDn)² / det D. (Laplace's method at the shortest way from a to the
rim to b; Baldi 1995 has such asymptotics for domains in general, Gobet 2000 the half plane.) Where
that way meets n at an angle ϑ the first order has δ cos²ϑ in place of δ. It is left out: it is
right for what hardly ever happens, but over whole paths it makes the rate too low, and without it
the rate errs by little on the safe side (benchmarks/between.py). Given its nodes, a path collides
with probability 1 − Π (1 − q) over intervals and obstacles; the mean over paths is the rate. No
random number is drawn for it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.envs import car
from slipcar.envs.scenario import Scenario
from slipcar.planner.moments.bridge import crossing

#: Bridges that would have to stray so many standard deviations are left out: q < 1e-13.
_FAR = 4.0
#: Newton steps towards the half plane; two or three are enough.
_STEPS = 4
#: No step turns it farther than this, as a tangent.
_TURN = 0.5
#: Where noise depends on direction: angles that are looked at, and how often between neighbours.
_ANGLES, _CLOSER = 33, 4


def log_clear(
    scenario: Scenario,
    before: Any,
    after: Any,
    h: float,
    distances: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Logarithm of the probability that no obstacle is touched from one node to the next.

    Args:
        scenario: gives obstacles, slip and process noise.
        before: components of the states at a, each (rows,).
        after: at b, likewise; only the position is used.
        h: time between them [s].
        distances: of a and b to the nearest rim [m], each (rows,), where they are known already.

    Returns:
        Σ_o log(1 − q_o), (rows,); −inf where the chord enters an obstacle.
    """
    total = np.zeros(len(before[0]))
    if not len(scenario.obstacles):
        return total
    ax, ay, bx, by = before[0], before[1], after[0], after[1]
    slip, _ = car.slip_rates(before[3], before[4], *scenario.slip)
    variance_x = h * (slip * slip + scenario.process_noise[0] ** 2)
    variance_y = h * (slip * slip + scenario.process_noise[1] ** 2)
    dx, dy = bx - ax, by - ay
    length = np.sqrt(dx * dx + dy * dy)
    stray = 2.0 * _FAR * np.sqrt(np.maximum(variance_x, variance_y)) + length
    # No point of the chord is nearer to a rim than half of what both ends keep, less its length.
    rows = np.arange(len(length))
    if distances is not None:
        rows = np.flatnonzero(distances[0] + distances[1] <= stray)
    x, y, radius = scenario.obstacles.T[:, :, None]
    gap_a = np.sqrt((ax[rows] - x) ** 2 + (ay[rows] - y) ** 2) - radius
    gap_b = np.sqrt((bx[rows] - x) ** 2 + (by[rows] - y) ** 2) - radius
    which, place = np.nonzero(gap_a + gap_b <= stray[rows])
    if not len(which):
        return total
    row = rows[place]
    x, y, radius = scenario.obstacles[which].T
    q = _touched(
        ax[row] - x, ay[row] - y, bx[row] - x, by[row] - y, radius, variance_x[row], variance_y[row]
    )
    with np.errstate(divide="ignore"):
        np.add.at(total, row, np.log1p(-q))
    return total


def _touched(
    ax: np.ndarray,
    ay: np.ndarray,
    bx: np.ndarray,
    by: np.ndarray,
    radius: np.ndarray,
    variance_x: np.ndarray,
    variance_y: np.ndarray,
) -> np.ndarray:
    """Probabilities q of bridges from a to b past a disc round the origin; all (rows,).

    Args:
        ax: of a, relative to the disc's centre [m].
        ay: likewise.
        bx: of b.
        by: likewise.
        radius: of the disc [m].
        variance_x: h D, its entry for x [m²].
        variance_y: for y.
    """
    dx, dy = bx - ax, by - ay
    squared = np.maximum(dx * dx + dy * dy, 1e-300)
    along = np.clip(-(ax * dx + ay * dy) / squared, 0.0, 1.0)
    nx, ny = ax + along * dx, ay + along * dy  # the chord's point nearest to the centre
    distance = np.sqrt(nx * nx + ny * ny)
    inside = distance <= radius
    nx, ny = nx / np.maximum(distance, 1e-300), ny / np.maximum(distance, 1e-300)
    uneven = np.flatnonzero(~inside & (variance_x != variance_y))
    if len(uneven):
        sides = [part[uneven] for part in (ax, ay, bx, by, radius, variance_x, variance_y)]
        turned = _turned(nx[uneven], ny[uneven], *sides)
    # From that point's direction, Newton's method in the angle of n on the product of n·a − δ and
    # n·b − δ, which is concave between the directions of a and b, where its maximum lies.
    for _ in range(_STEPS):
        gap_a, gap_b = nx * ax + ny * ay - radius, nx * bx + ny * by - radius
        turn_a, turn_b = nx * ay - ny * ax, nx * by - ny * bx  # derivatives of the gaps
        slope = turn_a * gap_b + turn_b * gap_a
        curve = 2.0 * turn_a * turn_b - (gap_a + radius) * gap_b - (gap_b + radius) * gap_a
        step = np.where(curve < 0.0, -slope / np.minimum(curve, -1e-300), 0.0)
        step = np.clip(step, -_TURN, _TURN)
        nx, ny = nx - step * ny, ny + step * nx
        norm = np.sqrt(nx * nx + ny * ny)
        nx, ny = nx / norm, ny / norm
    if len(uneven):
        nx[uneven], ny[uneven] = turned
    gap_a, gap_b = nx * ax + ny * ay - radius, nx * bx + ny * by - radius
    clear = ~inside & (gap_a > 0.0) & (gap_b > 0.0)
    gap_a, gap_b = np.where(clear, gap_a, 0.0), np.where(clear, gap_b, 0.0)
    variance = nx * nx * variance_x + ny * ny * variance_y
    product = gap_a * gap_b
    if len(uneven):
        determinant = np.maximum(variance_x * variance_y, 1e-300)[uneven]
        radius = radius.copy()
        radius[uneven] *= variance[uneven] ** 2 / determinant
    straight = crossing(gap_a, gap_b, variance)  # without noise the path is the chord: 0
    with np.errstate(divide="ignore", invalid="ignore"):
        bend = np.sqrt(1.0 + 2.0 * product / (radius * (gap_a + gap_b)))
        return np.where(clear, straight / bend, 1.0)


def _turned(
    nx: np.ndarray,
    ny: np.ndarray,
    ax: np.ndarray,
    ay: np.ndarray,
    bx: np.ndarray,
    by: np.ndarray,
    radius: np.ndarray,
    variance_x: np.ndarray,
    variance_y: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The normal with the largest d_a d_b / nᵀDn, which may have several maxima; all (rows,).

    Looked for on a grid of angles, then on finer ones round the best, among the half planes that
    keep a and b out; (nx, ny) is one of them. Other arguments are as in :func:`_touched`.
    """
    low, high = np.full(len(nx), -np.pi), np.full(len(nx), np.pi)
    for x, y in ((ax, ay), (bx, by)):
        towards = np.arctan2(nx * y - ny * x, nx * x + ny * y)  # from n to the node
        width = np.arccos(np.clip(radius / np.sqrt(x * x + y * y), 0.0, 1.0))
        low, high = np.maximum(low, towards - width), np.minimum(high, towards + width)
    rows, shares = np.arange(len(nx)), np.linspace(0.0, 1.0, _ANGLES)[:, None]
    for _ in range(_CLOSER):
        angles = low + shares * (high - low)  # (_ANGLES, rows)
        c, s = np.cos(angles), np.sin(angles)
        tx, ty = nx * c - ny * s, ny * c + nx * s
        gap_a, gap_b = tx * ax + ty * ay - radius, tx * bx + ty * by - radius
        variance = np.maximum(tx * tx * variance_x + ty * ty * variance_y, 1e-300)
        quotient = np.maximum(gap_a, 0.0) * np.maximum(gap_b, 0.0) / variance
        best = quotient.argmax(axis=0)
        low = angles[np.maximum(best - 1, 0), rows]
        high = angles[np.minimum(best + 1, _ANGLES - 1), rows]
    return tx[best, rows], ty[best, rows]

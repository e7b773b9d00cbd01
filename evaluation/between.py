"""Collisions between nodes: how likely a path touches an obstacle where no node looks.

Between two Euler–Maruyama nodes a and b, h apart, the continuous path is a Brownian bridge round
the chord, with the diffusion of the step: D = σσᵀ of the position at a. By the reflection
principle it enters a half plane whose border both ends keep away from, by d_a and d_b, with
probability exp(−2 d_a d_b / (h nᵀDn)), n the normal. Of the half planes that touch an obstacle's
rim the one with the largest d_a d_b counts; that the rim curves away from it, with radius δ, is
worth a factor:

    q = exp(−2 d_a d_b / (h nᵀDn)) / √(1 + 2 d_a d_b / (δ (d_a + d_b)))

and q = 1 where the chord itself enters. (Laplace's method at the shortest way from a to the rim to
b; Baldi 1995 has such asymptotics for domains in general, Gobet 2000 the half plane.) Given its
nodes, a path collides with probability 1 − Π (1 − q) over intervals and obstacles; the mean over
paths is the rate. No random number is drawn for it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from slipcar.envs import car
from slipcar.envs.scenario import Scenario

#: Bridges that would have to stray so many standard deviations are left out: q < 1e-13.
_FAR = 4.0
#: Newton steps towards the half plane; two or three are enough.
_STEPS = 4


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
    length = np.hypot(bx - ax, by - ay)
    stray = 2.0 * _FAR * np.sqrt(np.maximum(variance_x, variance_y)) + length
    # No point of the chord is nearer to a rim than half of what both ends keep, less its length.
    rows = np.arange(len(length))
    if distances is not None:
        rows = np.flatnonzero(distances[0] + distances[1] <= stray)
    x, y, radius = scenario.obstacles.T[:, :, None]
    gap_a = np.hypot(ax[rows] - x, ay[rows] - y) - radius
    gap_b = np.hypot(bx[rows] - x, by[rows] - y) - radius
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
    x, y = ax + along * dx, ay + along * dy  # the chord's point nearest to the centre
    inside = np.hypot(x, y) <= radius
    # The normal n = (cos φ, sin φ) lies between the directions of a and b; from the nearest
    # point's, Newton's method on the concave product of n·a − δ and n·b − δ.
    phi = np.arctan2(y, x)
    turn_a, turn_b = _turn(np.arctan2(ay, ax) - phi), _turn(np.arctan2(by, bx) - phi)
    low, high = np.minimum(turn_a, turn_b), np.maximum(turn_a, turn_b)
    rho_a, rho_b = np.hypot(ax, ay), np.hypot(bx, by)
    turn = np.zeros(len(ax))
    for _ in range(_STEPS):
        cos_a, sin_a = rho_a * np.cos(turn - turn_a), rho_a * np.sin(turn - turn_a)
        cos_b, sin_b = rho_b * np.cos(turn - turn_b), rho_b * np.sin(turn - turn_b)
        slope = -sin_a * (cos_b - radius) - sin_b * (cos_a - radius)
        curve = -cos_a * (cos_b - radius) - cos_b * (cos_a - radius) + 2.0 * sin_a * sin_b
        step = np.where(curve < 0.0, -slope / np.minimum(curve, -1e-300), 0.0)
        turn = np.clip(turn + step, low, high)
    gap_a = rho_a * np.cos(turn - turn_a) - radius
    gap_b = rho_b * np.cos(turn - turn_b) - radius
    clear = ~inside & (gap_a > 0.0) & (gap_b > 0.0)
    gap_a, gap_b = np.where(clear, gap_a, 0.0), np.where(clear, gap_b, 0.0)
    normal = np.cos(phi + turn) ** 2, np.sin(phi + turn) ** 2
    variance = normal[0] * variance_x + normal[1] * variance_y
    product = gap_a * gap_b
    # Without noise the path is the chord: exp(−∞).
    with np.errstate(divide="ignore", invalid="ignore"):
        straight = np.exp(-2.0 * product / variance)
        bend = np.sqrt(1.0 + 2.0 * product / (radius * (gap_a + gap_b)))
        return np.where(clear, straight / bend, 1.0)


def _turn(angle: np.ndarray) -> np.ndarray:
    """The same angle in [−π, π)."""
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi

"""What a policy sees, and the way back to (t, x).

`features` (default, 12 numbers scaled by hand to order one; SPEC §5):

    0:2   (goal − position) / 1 m
    2:4   cos θ, sin θ
    4:6   v / 1 m/s, ω / 1 rad/s
    6     2 t/T − 1
    7:12  (goal − position, θ^f − θ, v, ω) / time-to-go, clipped to ±5

`state` (6 numbers): (r_x, r_y, θ, v, ω, t) in SI units.

Both are float32 with finite bounds so wide that no physical path meets them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from slipcar.envs.scenario import Scenario

KINDS = ("features", "state")
#: Names in order, written beside a trained policy's weights and compared when it is loaded.
LAYOUTS: dict[str, tuple[str, ...]] = {
    "features": (
        "goal_x - r_x", "goal_y - r_y", "cos(theta)", "sin(theta)", "v", "omega",
        "2t/T-1", "(goal_x - r_x)/ttg", "(goal_y - r_y)/ttg", "(goal_theta - theta)/ttg",
        "v/ttg", "omega/ttg",
    ),
    "state": ("r_x", "r_y", "theta", "v", "omega", "t"),
}  # fmt: skip

# In metres. Halved, PPO ends 0.05 to 0.09 higher in total cost (seeds 0, 1 and 3, 3 M steps).
_POSITION_SCALE = 1.0
_RATE_LIMIT = 5.0
_WIDE = 1000.0


def check_kind(kind: str) -> str:
    """The kind itself.

    Raises:
        ValueError: for an unknown kind, listing the known ones.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown observation {kind!r}; the kinds are {list(KINDS)}")
    return kind


def observation_space(scenario: Scenario, kind: str) -> Box:
    """Bounds of one observation."""
    if check_kind(kind) == "state":
        high = np.full(6, _WIDE)
        low = -high
        low[5], high[5] = 0.0, scenario.horizon
    else:
        high = np.full(12, _WIDE)
        high[[2, 3, 6]] = 1.0
        high[7:] = _RATE_LIMIT
        low = -high
    return Box(low.astype(np.float32), high.astype(np.float32))


def observe(scenario: Scenario, kind: str, t: ArrayLike, x: np.ndarray) -> np.ndarray:
    """Observation of the state x at time t.

    Args:
        scenario: gives goal and horizon.
        kind: `features` or `state`.
        t: times, (...,) [s].
        x: states, (..., 5).

    Returns:
        float32, (..., 12) or (..., 6).
    """
    t = np.asarray(t, dtype=np.float64)
    if check_kind(kind) == "state":
        out = np.empty((*x.shape[:-1], 6), dtype=np.float32)
        np.clip(x, -_WIDE, _WIDE, out=out[..., :5], casting="same_kind")
        out[..., 5] = t
        return out
    goal = scenario.goal
    # Never below one step: on the last observation there is nothing left to divide by.
    rate = 1.0 / np.maximum(scenario.horizon - t, scenario.dt)
    out = np.empty((*x.shape[:-1], 12), dtype=np.float32)
    to_goal = goal[:3] - x[..., :3]
    np.clip(to_goal[..., :2] / _POSITION_SCALE, -_WIDE, _WIDE, out=out[..., 0:2])
    out[..., 2] = np.cos(x[..., 2])
    out[..., 3] = np.sin(x[..., 2])
    np.clip(x[..., 3:], -_WIDE, _WIDE, out=out[..., 4:6])
    out[..., 6] = 2.0 * t / scenario.horizon - 1.0
    rate = rate[..., None]
    np.clip(to_goal * rate, -_RATE_LIMIT, _RATE_LIMIT, out=out[..., 7:10])
    np.clip(x[..., 3:] * rate, -_RATE_LIMIT, _RATE_LIMIT, out=out[..., 10:12])
    return out


def decode(scenario: Scenario, observation: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Time and state from an observation of either kind, told apart by its length.

    Args:
        scenario: the one the observation was made with.
        observation: (..., 12) or (..., 6).

    Returns:
        t (...,) [s] and x (..., 5), float64. From `features` θ lies in (−π, π].

    Raises:
        ValueError: if the last axis has another length.
    """
    observed = np.asarray(observation, dtype=np.float64)
    size = observed.shape[-1] if observed.ndim else 0
    if size == 6:
        return observed[..., 5], observed[..., :5]
    if size != 12:
        raise ValueError(
            f"an observation has 12 entries (features) or 6 (state) on its last axis, "
            f"not shape {observed.shape}"
        )
    t = 0.5 * (observed[..., 6] + 1.0) * scenario.horizon
    x = np.empty((*observed.shape[:-1], 5))
    x[..., :2] = scenario.goal[:2] - _POSITION_SCALE * observed[..., 0:2]
    x[..., 2] = np.arctan2(observed[..., 3], observed[..., 2])
    x[..., 3:] = observed[..., 4:6]
    return t, x


def describe(kind: str) -> dict[str, Any]:
    """The layout as plain data, for a policy's JSON."""
    return {"kind": check_kind(kind), "entries": list(LAYOUTS[kind])}

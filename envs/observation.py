"""What a policy sees, and the way back to (t, x).

`features` (default, 12 numbers scaled by hand to order one; docs/slipcar-v0.md):

    0:2   (goal − position) / 1 m
    2:4   cos θ, sin θ
    4:6   v / 1 m/s, ω / 1 rad/s
    6     2 t/T − 1
    7:12  (goal − position, θ^f − θ, v, ω) / time-to-go, clipped to ±5

`egocentric` (15 numbers, for worlds that vary: the same in the car's frame, ahead and to the left,
and what else differs from world to world):

    0:2   (goal − position) ahead, left / 1 m
    2:4   cos(θ^f − θ), sin(θ^f − θ)
    4:7   as above
    7:12  (goal − position ahead, left, θ^f − θ, v, ω) / time-to-go, clipped to ±5
    12    time-to-go / 5 s
    13:15 α² / 0.1, β² / 0.01

`state` (6 numbers): (r_x, r_y, θ, v, ω, t) in SI units.

With `slots=k` the k nearest obstacles follow, nearest rim first, four numbers each: centre −
position (in the car's frame for `egocentric`) [m], radius [m], and 1 as a mask; four zeros where
there are fewer.

All is float32. Only the rates, entries 7:12, are clipped, and neither time nor state is decoded
from them: positions, speeds and headings are unbounded (`Box(-inf, inf)`, as Gymnasium's own
environments declare what has no limit), so that a controller sees where it is however large the
world. A `state` resolves a position to 6e-8 of its distance from the origin, 1 mm at 10 km; the
other kinds, which are relative to the goal, to 6e-8 of its distance from there.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike

from slipcar.envs.arrays import ARRAYS, FLOATS, Functions, array_namespace, functions_of
from slipcar.envs.nearest import nearest
from slipcar.envs.parameters import Parameters, Task
from slipcar.envs.transition import proximity
from slipcar.envs.validate import checked_int

KINDS = ("features", "state", "egocentric")
#: Names in order, written beside a trained policy's weights and compared when it is loaded.
LAYOUTS: dict[str, tuple[str, ...]] = {
    "features": (
        "goal_x - r_x", "goal_y - r_y", "cos(theta)", "sin(theta)", "v", "omega",
        "2t/T-1", "(goal_x - r_x)/ttg", "(goal_y - r_y)/ttg", "(goal_theta - theta)/ttg",
        "v/ttg", "omega/ttg",
    ),
    "state": ("r_x", "r_y", "theta", "v", "omega", "t"),
    "egocentric": (
        "goal ahead", "goal left", "cos(goal_theta - theta)", "sin(goal_theta - theta)", "v",
        "omega", "2t/T-1", "(goal ahead)/ttg", "(goal left)/ttg", "(goal_theta - theta)/ttg",
        "v/ttg", "omega/ttg", "ttg/5s", "alpha2/0.1", "beta2/0.01",
    ),
}  # fmt: skip
SLOT = ("x", "y", "radius", "present")

# In metres. Halved, PPO ends 0.05 to 0.09 higher in total cost (seeds 0, 1 and 3, 3 M steps).
_POSITION_SCALE = 1.0
_TIME_SCALE, _SLIP_SCALE = 5.0, (0.1, 0.01)
_RATE_LIMIT = 5.0


def check_kind(kind: str) -> str:
    """The kind itself.

    Raises:
        ValueError: for an unknown kind, listing the known ones.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown observation {kind!r}; the kinds are {list(KINDS)}")
    return kind


@dataclasses.dataclass(frozen=True)
class Layout:
    """How an observation is laid out.

    Attributes:
        kind: `features`, `state` or `egocentric`.
        slots: how many obstacles it shows, >= 0.

    Raises:
        ValueError: for an unknown kind or a bad number.
    """

    kind: str = "features"
    slots: int = 0

    def __post_init__(self) -> None:
        check_kind(self.kind)
        object.__setattr__(self, "slots", checked_int("obstacle_slots", self.slots, at_least=0))

    @property
    def entries(self) -> tuple[str, ...]:
        """Names of the entries, in order."""
        slots = tuple(f"obstacle {i}: {name}" for i in range(self.slots) for name in SLOT)
        return LAYOUTS[self.kind] + slots

    @property
    def size(self) -> int:
        """Number of entries."""
        return len(LAYOUTS[self.kind]) + len(SLOT) * self.slots

    @staticmethod
    def of_size(size: int) -> Layout:
        """The layout with so many entries: kinds and slots can be told from the number alone.

        Raises:
            ValueError: if there is none.
        """
        for kind, entries in LAYOUTS.items():
            slots, rest = divmod(size - len(entries), len(SLOT))
            if rest == 0 and slots >= 0:
                return Layout(kind, slots)
        sizes = " or ".join(f"{len(entries)} ({kind})" for kind, entries in LAYOUTS.items())
        raise ValueError(
            f"an observation has {sizes} entries on its last axis, and {len(SLOT)} more for each "
            f"obstacle shown, not {size}"
        )

    def space(self, horizon: float) -> Box:
        """Bounds of one observation in worlds of at most this horizon [s]."""
        high = np.full(self.size, np.inf)
        low = -high
        if self.kind == "state":
            low[5], high[5] = 0.0, horizon
        else:
            high[[2, 3, 6]] = 1.0
            high[7:12] = _RATE_LIMIT
            low = -high
            low[12 : len(LAYOUTS[self.kind])] = 0.0
        first = len(LAYOUTS[self.kind])
        low[first + 2 :: 4] = low[first + 3 :: 4] = 0.0
        high[first + 3 :: 4] = 1.0
        return Box(low.astype(np.float32), high.astype(np.float32))


def entries(
    layout: Layout, p: Parameters, t: Any, x: Any, rims: Any, functions: Functions
) -> tuple[list[Any], Any | None]:
    """The entries of an observation, on components (:mod:`slipcar.envs.arrays`).

    Args:
        layout: which ones.
        p: the numbers of the scenario, or of as many scenarios as there are cars.
        t: time [s]: one for all, or an array.
        x: the five components of the states.
        rims: distance to every obstacle's rim [m], as `transition.proximity` gives it; it is not
            looked at without slots.
        functions: for this kind of component.

    Returns:
        The entries, and, for NumPy arrays, a block (cars, m) of those that follow; what is missing
        at the end is zero.
    """
    if layout.kind == "state":
        shown, block = _obstacles(layout, p, x, rims, functions, None)
        return [*x, t, *shown], block
    theta, v, omega = x[2], x[3], x[4]
    dx, dy, turn = p.goal[0] - x[0], p.goal[1] - x[1], p.goal[2] - theta
    cos, sin = functions.cos(theta), functions.sin(theta)
    frame = None
    if layout.kind == "egocentric":
        frame = (cos, sin)
        dx, dy = _turned(frame, dx, dy)
        cos, sin = functions.cos(turn), functions.sin(turn)
    to_go = p.horizon - t
    # Never below one step: on the last observation there is nothing left to divide by.
    rate = 1.0 / _at_least(to_go, p.dt)
    # The last node's time may be rounded to a little after the horizon.
    fraction = _limited(2.0 * t / p.horizon - 1.0, -1.0, 1.0)
    seen = [
        dx / _POSITION_SCALE,
        dy / _POSITION_SCALE,
        cos,
        sin,
        v,
        omega,
        fraction,
        *(functions.clip(e * rate, -_RATE_LIMIT, _RATE_LIMIT) for e in (dx, dy, turn, v, omega)),
    ]
    if layout.kind == "egocentric":
        # The last node's time may be rounded to a little after the horizon.
        seen.append(_at_least(to_go, 0.0) / _TIME_SCALE)
        seen += [s / scale for s, scale in zip(p.slip, _SLIP_SCALE, strict=True)]
    shown, block = _obstacles(layout, p, x, rims, functions, frame)
    return seen + shown, block


def observe(scenario: Task, kind: str, t: ArrayLike, x: np.ndarray, slots: int = 0) -> np.ndarray:
    """Observation of the state x at time t.

    Args:
        scenario: gives goal, horizon and obstacles.
        kind: `features`, `state` or `egocentric`.
        t: times, (...,) [s].
        x: states, (..., 5).
        slots: how many obstacles are shown.

    Returns:
        float32, (..., d).
    """
    layout = Layout(kind, slots)
    states = x.reshape(-1, x.shape[-1])
    times = np.broadcast_to(np.asarray(t, dtype=np.float64), x.shape[:-1]).reshape(-1)
    p = Parameters.like(states[..., 0], scenario)
    components = [states[..., i] for i in range(5)]
    rims = proximity(p, components, ARRAYS)[2] if slots else []
    out = np.empty((len(states), layout.size), dtype=np.float32)
    fill(out, *entries(layout, p, times, components, rims, ARRAYS))
    return out.reshape(*x.shape[:-1], layout.size)


def fill(out: np.ndarray, seen: list[Any], block: np.ndarray | None) -> None:
    """Write what :func:`entries` gave into observations `out` (..., size)."""
    for i, entry in enumerate(seen):
        out[..., i] = entry
    told = len(seen)
    if block is not None:
        out[..., told : told + block.shape[-1]] = block
        told += block.shape[-1]
    if told < out.shape[-1]:
        out[..., told:] = 0.0


def observation_space(scenario: Task, kind: str, slots: int = 0) -> Box:
    """Bounds of one observation."""
    return Layout(kind, slots).space(scenario.horizon)


def decode(scenario: Task, observation: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Time and state from an observation of any kind, told apart by its length.

    Args:
        scenario: the one the observation was made with.
        observation: (..., d).

    Returns:
        t (...,) [s] and x (..., 5), float64. θ lies in (−π, π] unless the kind is `state`.

    Raises:
        ValueError: if the last axis has a length of no kind.
    """
    observed = np.asarray(observation, dtype=np.float64)
    layout = Layout.of_size(observed.shape[-1] if observed.ndim else 0)
    if layout.kind == "state":
        return observed[..., 5], observed[..., :5]
    t = 0.5 * (observed[..., 6] + 1.0) * scenario.horizon
    x = np.empty((*observed.shape[:-1], 5))
    heading = np.arctan2(observed[..., 3], observed[..., 2])
    dx, dy = _POSITION_SCALE * observed[..., 0], _POSITION_SCALE * observed[..., 1]
    if layout.kind == "egocentric":
        turned = scenario.goal[2] - heading
        heading = turned - math.tau * np.ceil(turned / math.tau - 0.5)
        dx, dy = _turned((np.cos(heading), -np.sin(heading)), dx, dy)
    x[..., 0], x[..., 1] = scenario.goal[0] - dx, scenario.goal[1] - dy
    x[..., 2] = heading
    x[..., 3:] = observed[..., 4:6]
    return t, x


def describe(kind: str, slots: int = 0) -> dict[str, Any]:
    """The layout as plain data, for a policy's JSON."""
    return {"kind": check_kind(kind), "entries": list(Layout(kind, slots).entries)}


def _obstacles(
    layout: Layout, p: Parameters, x: Any, rims: Any, functions: Functions, frame: Any
) -> tuple[list[Any], Any | None]:
    """Entries of the obstacles shown; see :func:`slipcar.envs.nearest.nearest`."""
    if not layout.slots or len(p.obstacles[0]) == 0:
        return [], None
    if functions is FLOATS:
        seen = [_seen(row, x, frame, functions) for row in zip(*p.obstacles, strict=True)]
        fields = [list(field) for field in zip(*seen, strict=True)]
    else:
        fields = _seen(p.obstacles, x, frame, functions)
    return nearest(layout.slots, fields, rims, functions)


def _seen(row: Any, x: Any, frame: Any, functions: Functions) -> list[Any]:
    """Centre − position, radius and 1, for one obstacle or for columns of them.

    A fleet's worlds are filled up with obstacles that are not there: four zeros.
    """
    radius, present = row[4], row[5]
    dx, dy = present * (row[0] - x[0]), present * (row[1] - x[1])
    if frame is not None:
        dx, dy = _turned(frame, dx, dy)
    return [dx, dy, radius, present]


def _turned(frame: tuple[Any, Any], dx: Any, dy: Any) -> tuple[Any, Any]:
    """A vector's components ahead and to the left of a heading (cos, sin)."""
    cos, sin = frame
    return cos * dx + sin * dy, cos * dy - sin * dx


def _limited(value: Any, low: float, high: float) -> Any:
    """The value limited to a range, whether one for all cars or one for each."""
    return functions_of(value).clip(value, low, high)


def _at_least(values: Any, low: Any) -> Any:
    if isinstance(values, float):
        return max(values, low)
    if isinstance(values, np.ndarray):
        return np.maximum(values, low)
    xp = array_namespace(values)
    return xp.maximum(values, xp.zeros_like(values) + low)

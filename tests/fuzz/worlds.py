"""Random scenarios of the car, sensible and extreme, and changes that must be refused or kept."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from hypothesis import strategies as st

from slipcar.envs import Scenario


@dataclasses.dataclass(frozen=True)
class World:
    """A random world, its lengths multiplied by `size`, with some fields changed if they may be."""

    seed: int
    size: float
    changes: dict[str, Any]

    def scenario(self) -> Scenario:
        """As it is posed."""
        plain, k = Scenario.random(self.seed, turned=bool(self.seed % 2)), self.size
        lengths = np.array([k, k, 1.0, k, 1.0])
        sized = plain.replace(
            start=plain.start * lengths, goal=plain.goal * lengths,
            obstacles=plain.obstacles * k, clearance=plain.clearance * k,
            obstacle_weight=plain.obstacle_weight / k**4,
            control_bounds=plain.control_bounds * np.array([k, 1.0]),
        )  # fmt: skip
        try:
            return sized.replace(**self.changes)
        except ValueError:  # a goal under an obstacle
            return sized


_CHANGES = {
    "horizon": (1e-3, 0.5, 2.0, 20.0, 500.0, 1e6),
    "nodes": (2, 3, 4, 11, 81, 201),
    "slip": ((0.0, 0.0), (1.0, 0.3), (1e6, 1e6)),
    "control_bounds": (None, (1e-9, 1e-9), (0.5, 1.0), (1e6, 1e6)),
    "obstacle_weight": (0.0, 1.0, 1e9),
    "clearance": (0.0, 3.0),
    "goal": ((3.0, 0.0, 0.0, 0.0, 0.0), (1e3, 1e3, 0.0, 0.0, 0.0), (0.0, 0.0, 60.0, 0.0, 0.0)),
    "process_noise": (0.01, 1.0, 1e6),
    "start_deviation": (0.01, 1.0),
    "obstacles": ((),),
}


def _some(values: dict[str, tuple[Any, ...]]) -> st.SearchStrategy[dict[str, Any]]:
    """A few fields and a value for each."""
    one = st.sampled_from(sorted(values)).flatmap(
        lambda name: st.tuples(st.just(name), st.sampled_from(values[name]))
    )
    return st.lists(one, max_size=3).map(dict)


worlds = st.builds(
    World,
    st.integers(0, 2**20),
    st.sampled_from((1.0, 1.0, 1.0, 1e-3, 1e-6, 1e3, 1e6)),
    _some(_CHANGES),
)

_NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 1e300, 1e-300, float("nan"), float("inf"), -float("inf"), None, "1", "many", True,
    1j, [], {}, (1, 2), (0.0,) * 5, [[1, 2, 3]], np.ones((2, 3)), np.float32(0.3), 10**400, 2**70,
    b"1", [None] * 5, ["a"] * 5, np.zeros(5), np.full(5, np.nan), [[0, 0, -1]], [[9, 9, 1e308]],
)  # fmt: skip
_FIELDS = (
    "start", "goal", "horizon", "nodes", "obstacles", "clearance", "obstacle_weight",
    "goal_weight", "slip", "control_bounds", "process_noise", "start_deviation",
    "goal_tolerance", "no_such_field",
)  # fmt: skip
changes = _some(dict.fromkeys(_FIELDS, _NUMBERS))

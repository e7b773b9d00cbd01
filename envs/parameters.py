"""The numbers that a step and an observation need, for one scenario or for a fleet of them.

They are read from a :class:`Task`, which is what a scenario is to the files that it imports.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from array_api_compat import device

from slipcar.envs.arrays import array_namespace
from slipcar.envs.integrate import Components


class Task(Protocol):
    """What steps, observations and routes ask of a scenario.

    :class:`slipcar.envs.scenario.Scenario` is one and says more of each.
    """

    @property
    def start(self) -> np.ndarray:
        """x⁰, (5,)."""
        ...

    @property
    def goal(self) -> np.ndarray:
        """x^f, (5,)."""
        ...

    @property
    def goal_weight(self) -> np.ndarray:
        """Diagonal of W, (5,)."""
        ...

    @property
    def horizon(self) -> float:
        """T [s]."""
        ...

    @property
    def dt(self) -> float:
        """Length of a control interval [s]."""
        ...

    @property
    def times(self) -> np.ndarray:
        """Node times, (N,) [s]."""
        ...

    @property
    def obstacles(self) -> np.ndarray:
        """Rows x, y, radius [m], (k, 3)."""
        ...

    @property
    def clearance(self) -> float:
        """ε [m]."""
        ...

    @property
    def obstacle_weight(self) -> float:
        """λ."""
        ...

    @property
    def slip(self) -> np.ndarray:
        """(α², β²)."""
        ...

    @property
    def process(self) -> tuple[tuple[int, float], ...]:
        """Pairs (component of the state, standard deviation per √s)."""
        ...

    @property
    def control_bounds(self) -> np.ndarray | None:
        """Largest |u|, (2,), or None for unbounded."""
        ...

    @property
    def action_scale(self) -> np.ndarray:
        """Control per unit of action, (2,)."""
        ...

    @property
    def row_parameters(self) -> Parameters:
        """The numbers of a step, for components that are rows of float64."""
        ...

    def control_power(self, u: Any) -> Any:
        """‖u‖², (...,)."""
        ...

    def obstacle_power(self, x: Any) -> Any:
        """λ Σ_o max(0, c_o)², (...,)."""
        ...


class Parameters(NamedTuple):
    """The numbers of a step: floats where all cars share them, arrays with one entry per car.

    Attributes:
        dt: length of the control interval [s].
        horizon: T [s].
        slip: (α², β²).
        process: pairs (component of the state, standard deviation per √s).
        obstacles: columns over the k obstacles, see :func:`obstacle_columns`; lists of floats, or
            arrays (k, 1) or (k, cars).
        obstacle_weight: λ.
        goal: x^f, five components.
        goal_weight: W, five components.
    """

    dt: Any
    horizon: Any
    slip: Components
    process: tuple[tuple[int, Any], ...]
    obstacles: Components
    obstacle_weight: Any
    goal: Components
    goal_weight: Components

    @staticmethod
    def of(scenario: Task) -> Parameters:
        """Those of one scenario, as floats."""
        return Parameters(
            dt=float(scenario.dt),
            horizon=float(scenario.horizon),
            slip=scenario.slip.tolist(),
            process=scenario.process,
            obstacles=obstacle_columns(scenario.obstacles, scenario.clearance).tolist(),
            obstacle_weight=float(scenario.obstacle_weight),
            goal=scenario.goal.tolist(),
            goal_weight=scenario.goal_weight.tolist(),
        )

    @staticmethod
    def like(component: Any, scenario: Task) -> Parameters:
        """Those of one scenario, for components of this kind and shape."""
        row = isinstance(component, np.ndarray) and component.ndim == 1
        if row and component.dtype == np.float64:
            return scenario.row_parameters  # an evaluation asks for them at every step
        p = Parameters.of(scenario)
        if isinstance(component, float):
            return p
        return p.shaped(component, scenario)

    def shaped(self, component: Any, scenario: Task) -> Parameters:
        """The same with obstacles as columns beside arrays of this kind and shape."""
        xp = array_namespace(component)
        place = {} if xp is np else {"device": device(component)}  # NumPy 1.26 has none
        columns = xp.asarray(
            obstacle_columns(scenario.obstacles, scenario.clearance), dtype=component.dtype, **place
        )
        shape = (len(columns), -1, *(1 for _ in component.shape))
        return self._replace(obstacles=tuple(xp.reshape(columns, shape)))


def obstacle_columns(obstacles: np.ndarray, clearance: float) -> np.ndarray:
    """What a step and an observation need of obstacles (..., k, 3), (6, ..., k).

    x, y [m]; the radius δ [m]; (δ + ε)² [m²]; and, for observations, the radius again and 1.
    """
    x, y, radius = np.moveaxis(obstacles, -1, 0)
    reach = radius + clearance
    return np.stack([x, y, radius, reach * reach, radius, np.ones_like(radius)])


#: The column of an obstacle that is not there: infinitely far away, and four zeros to be seen.
ABSENT = (1e9, 1e9, -np.inf, 0.0, 0.0, 0.0)

"""The numbers that a step and an observation need, for one scenario or for a fleet of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from array_api_compat import device

from slipcar.envs.arrays import array_namespace
from slipcar.envs.integrate import Components

if TYPE_CHECKING:
    from slipcar.envs.scenario import Scenario


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
    def of(scenario: Scenario) -> Parameters:
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
    def like(component: Any, scenario: Scenario) -> Parameters:
        """Those of one scenario, for components of this kind and shape."""
        row = isinstance(component, np.ndarray) and component.ndim == 1
        if row and component.dtype == np.float64:
            return scenario.row_parameters  # an evaluation asks for them at every step
        p = Parameters.of(scenario)
        if isinstance(component, float):
            return p
        return p.shaped(component, scenario)

    def shaped(self, component: Any, scenario: Scenario) -> Parameters:
        """The same with obstacles as columns beside arrays of this kind and shape."""
        xp = array_namespace(component)
        columns = xp.asarray(
            obstacle_columns(scenario.obstacles, scenario.clearance),
            dtype=component.dtype,
            device=device(component),
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

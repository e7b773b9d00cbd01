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
        obstacles: four columns over the k obstacles: x, y, radius, radius + clearance [m]; lists of
            floats, or arrays (k, 1) or (k, cars).
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
            obstacles=obstacle_columns(scenario).tolist(),
            obstacle_weight=float(scenario.obstacle_weight),
            goal=scenario.goal.tolist(),
            goal_weight=scenario.goal_weight.tolist(),
        )

    @staticmethod
    def like(component: Any, scenario: Scenario) -> Parameters:
        """Those of one scenario, for components of this kind and shape."""
        p = Parameters.of(scenario)
        if isinstance(component, float):
            return p
        xp = array_namespace(component)
        columns = xp.asarray(
            obstacle_columns(scenario), dtype=component.dtype, device=device(component)
        )
        shape = (4, -1, *(1 for _ in component.shape))
        return p._replace(obstacles=tuple(xp.reshape(columns, shape)))


def obstacle_columns(scenario: Scenario) -> np.ndarray:
    """x, y, radius and radius + clearance of the obstacles, (4, k) [m]."""
    x, y, radius = scenario.obstacles.T
    return np.stack([x, y, radius, radius + scenario.clearance])

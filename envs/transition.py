"""One control step of the stochastic car: the core behind all faces.

The environment steps one car of floats, the vector environment a fleet of rows, the Torch fleet
rows on a device, the evaluation blocks of arrays; all of them call :func:`step`, so they agree
path for path.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from slipcar.envs import car, cost
from slipcar.envs.arrays import FLOATS, Functions, array_namespace, functions_of
from slipcar.envs.integrate import Components, added_up, increments, together
from slipcar.envs.parameters import Parameters, Task


class Moved(NamedTuple):
    """What one control step led to, on components.

    Attributes:
        state: x_{k+1}, five components.
        effort: dt ‖u_k‖².
        obstacle: dt λ Σ_o max(0, c_o(x_{k+1}))².
        distance: signed distance of x_{k+1} to the nearest rim [m].
        rims: signed distance to every rim [m]; see :func:`proximity`.
    """

    state: Components
    effort: Any
    obstacle: Any
    distance: Any
    rims: Any


def step(
    p: Parameters,
    x: Components,
    u: Components,
    noise: Any,
    functions: Functions,
    add: Callable[[Components, Components], Components] = added_up,
) -> Moved:
    """Advance one control interval, on components (:mod:`slipcar.envs.arrays`).

    Args:
        p: the numbers of the scenario, or of as many scenarios as there are cars.
        x: the five components of the states.
        u: the two of the controls.
        noise: standard normal variates, indexed [substep][component].
        functions: for this kind of component.
        add: x and its increments to their sum; a fleet keeps the sum more precisely than the
            increments are computed.
    """
    h = p.dt / len(noise)
    root = h**0.5
    for variates in noise:
        x = add(x, increments(x, u, h, root, variates, p.slip, p.process, functions))
    power, distance, rims = proximity(p, x, functions)
    return Moved(x, p.dt * cost.squared_norm(u), p.dt * power, distance, rims)


def proximity(p: Parameters, x: Components, functions: Functions) -> tuple[Any, Any, Any]:
    """Obstacle cost per second, distance to the nearest rim, and to every rim [m], at states x.

    The last is a list for floats and an array (k, ...) otherwise.
    """
    if functions is FLOATS:
        near = [_near(x, row, functions) for row in zip(*p.obstacles, strict=True)]
        power = sum(cost for cost, _ in near)
        rims = [rim for _, rim in near]
        return p.obstacle_weight * power, min(rims, default=math.inf), rims
    if len(p.obstacles[0]) == 0:
        nothing = 0.0 * x[0]
        return nothing, nothing + math.inf, nothing[None][:0]
    powers, rims = _near(x, p.obstacles, functions)
    return p.obstacle_weight * functions.total(powers), functions.smallest(rims), rims


def _near(x: Components, row: Components, functions: Functions) -> tuple[Any, Any]:
    """max(0, c_o)² and the distance to the rim, for one obstacle or for columns of them."""
    centre_x, centre_y, radius, squared_reach = row[:4]
    dx, dy = x[0] - centre_x, x[1] - centre_y
    squared = dx * dx + dy * dy
    depth = cost.ring_depth(squared, squared_reach)
    return (
        cost.hinge_cost(depth, functions.positive),
        cost.rim_distance(squared, radius, functions.sqrt),
    )


def goal_cost(p: Parameters, x: Components) -> Any:
    """(x − x^f)ᵀ W (x − x^f), on components."""
    errors = [state - goal for state, goal in zip(x, p.goal, strict=True)]
    return cost.weighted_square(errors, p.goal_weight)


@dataclasses.dataclass(frozen=True)
class Transition:
    """What one control step led to.

    Attributes:
        state: x_{k+1}, (..., 5).
        effort: dt ‖u_k‖², (...,).
        obstacle: dt λ Σ_o max(0, c_o(x_{k+1}))², (...,).
        distance: signed distance of x_{k+1} to the nearest rim [m], (...,).
    """

    state: Any
    effort: Any
    obstacle: Any
    distance: Any


def transition(
    scenario: Task,
    x: Any,
    u: Any,
    noise: Any,
    add: Callable[[Components, Components], Components] = added_up,
) -> Transition:
    """Advance states x (..., 5) under controls u (..., 2) with noise (..., substeps, 3 + p).

    NumPy and Torch; p is the number of states that the scenario's process noise reaches. `add` is
    that of :func:`step`: it is called with the state before every substep.
    """
    xp = array_namespace(x, u, noise)
    components = [x[..., i] for i in range(car.STATE_DIM)]
    controls = [u[..., i] for i in range(car.CONTROL_DIM)]
    substeps, motions = noise.shape[-2:]
    variates = [[noise[..., j, i] for i in range(motions)] for j in range(substeps)]
    functions = functions_of(components[0])
    p = Parameters.like(x[..., 0], scenario)
    moved = step(p, components, controls, variates, functions, add)
    return Transition(
        state=together(xp, moved.state),
        effort=moved.effort,
        obstacle=moved.obstacle,
        distance=moved.distance,
    )


def control_from_action(
    scenario: Task, action: ArrayLike, batch: tuple[int, ...] = ()
) -> np.ndarray:
    """Control in physical units: the action clipped to [−1, 1] times the control bounds.

    Args:
        scenario: gives the bounds.
        action: (*batch, 2), finite.
        batch: expected leading shape.

    Returns:
        (*batch, 2) float64 [m/s², rad/s²].

    Raises:
        ValueError: for a wrong shape or a non-finite entry, naming its index.
    """
    return limited_action(action, batch, np.float64) * scenario.action_scale


def limited_action(action: ArrayLike, batch: tuple[int, ...], dtype: Any) -> np.ndarray:
    """The action clipped to [−1, 1], an array (*batch, 2); not a copy if it is one already.

    Raises:
        ValueError: for a wrong shape or a non-finite entry, naming its index.
    """
    try:
        if np.iscomplexobj(action):  # NumPy would only warn and drop the imaginary part
            raise TypeError("complex numbers")
        with np.errstate(over="ignore"):
            array: np.ndarray = np.asarray(action, dtype=dtype)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"action must be an array of numbers, not {action!r}") from error
    if array.shape != (*batch, car.CONTROL_DIM):
        raise ValueError(f"action must have shape {(*batch, car.CONTROL_DIM)}, not {array.shape}")
    # Two looks at all entries, of which neither lets NaN pass, are cheaper than clipping them.
    if array.max() <= 1.0 and array.min() >= -1.0:
        return array
    if not np.isfinite(array).all():
        array = np.asarray(
            action, dtype=np.float64
        )  # what float32 cannot hold is finite all the same
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(
            f"action{list(index)} is {array[index]}; actions must be finite "
            "(they are clipped to [-1, 1])"
        )
    return np.clip(array, -1.0, 1.0).astype(dtype, copy=False)

"""A scenario: everything that says which problem is posed, as data.

A `Scenario` is a frozen, validated dataclass with a JSON round trip. It is the one object
that the environment, the planner and the evaluation share: its methods bind the physics of
:mod:`slipcar.envs.car` and the costs of :mod:`slipcar.envs.cost` to its numbers, and with
them it satisfies `slipcar.planner.Problem`.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from array_api_compat import device
from numpy.typing import ArrayLike

from slipcar.envs import car, cost, drawing, routes, worlds
from slipcar.envs import observation as layouts
from slipcar.envs.arrays import array_namespace
from slipcar.envs.parameters import Parameters
from slipcar.envs.validate import (
    MARK,
    checked_array,
    checked_float,
    checked_int,
    parsed_object,
    replaced,
)

if TYPE_CHECKING:  # pyright lets no cached property be what a protocol reads
    cached_property = property
else:
    cached_property = functools.cached_property

_FORMAT = 1


@dataclasses.dataclass(frozen=True, eq=False)
class Scenario:
    """The car's task: from `start` to `goal` in `horizon` seconds, past `obstacles`.

        minimise  E[ Σ dt ‖u_k‖² + Σ dt λ Σ_o max(0, (δ_o+ε)² − ‖r_k − r_o‖²)² ]
        s.t.      dx = b(x, u) dt + σ(x) dB,   x(0) = start,   E[x(T)] = goal,   |u| ≤ bounds

    Attributes:
        start: x⁰ = (r_x, r_y, θ, v, ω), (5,) [m, m, rad, m/s, rad/s].
        goal: x^f, (5,), same units.
        horizon: T > 0 [s].
        nodes: N ≥ 2; the control is constant on each of the N − 1 intervals of dt = T/(N−1).
        obstacles: (k, 3) rows x, y, radius [m], radius > 0, none over start or goal.
        clearance: ε ≥ 0 [m], added to each radius in the obstacle cost, not in collisions.
        obstacle_weight: λ ≥ 0 [1/(m⁴ s)] .
        goal_weight: diagonal of W ≥ 0, (5,); a scalar is repeated (default 100).
        slip: (α², β²), both ≥ 0.
        control_bounds: (2,) largest |a_v| [m/s²] and |a_ω| [rad/s²], or None for unbounded.
        process_noise: (5,) ≥ 0, standard deviation per √s of constant noise on each state, beside
            the slip; a scalar is repeated (default 0).
        start_deviation: (5,) ≥ 0, standard deviation of a normal x(0) round `start`; a scalar is
            repeated (default 0).
        goal_tolerance: (5,) > 0, the largest |x − x^f| that counts as arrived; a scalar is
            repeated (default 0.2). Success is to arrive without a collision; no cost knows it.

    Raises:
        ValueError: naming the field, the bad value and what is allowed.
    """

    start: np.ndarray
    goal: np.ndarray
    horizon: float = 5.0
    nodes: int = 41
    obstacles: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    clearance: float = 0.13
    obstacle_weight: float = 500.0
    goal_weight: np.ndarray = dataclasses.field(default_factory=lambda: np.full(5, 100.0))
    slip: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.1, 0.01]))
    control_bounds: np.ndarray | None = dataclasses.field(
        default_factory=lambda: np.array([2.0, 4.0])
    )

    process_noise: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(5))
    start_deviation: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(5))
    goal_tolerance: np.ndarray = dataclasses.field(default_factory=lambda: np.full(5, 0.2))

    def __post_init__(self) -> None:
        set_field = functools.partial(object.__setattr__, self)
        set_field("start", checked_array("start", self.start, (car.STATE_DIM,)))
        set_field("goal", checked_array("goal", self.goal, (car.STATE_DIM,)))
        set_field("horizon", checked_float("horizon", self.horizon, above=0.0))
        set_field("nodes", checked_int("nodes", self.nodes, at_least=2))
        set_field("clearance", checked_float("clearance", self.clearance, at_least=0.0))
        set_field(
            "obstacle_weight", checked_float("obstacle_weight", self.obstacle_weight, at_least=0.0)
        )
        for name in ("goal_weight", "process_noise", "start_deviation"):
            value = getattr(self, name)
            shape = (car.STATE_DIM,)
            set_field(name, checked_array(name, value, shape, at_least=0.0, repeat_scalar=True))
        tolerance = checked_array(
            "goal_tolerance", self.goal_tolerance, (car.STATE_DIM,), above=0.0, repeat_scalar=True
        )
        set_field("goal_tolerance", tolerance)
        set_field("slip", checked_array("slip", self.slip, (2,), at_least=0.0))
        if self.control_bounds is not None:
            set_field(
                "control_bounds",
                checked_array("control_bounds", self.control_bounds, (car.CONTROL_DIM,), above=0.0),
            )
        set_field("obstacles", self._checked_obstacles())

    def _checked_obstacles(self) -> np.ndarray:
        given = self.obstacles
        if given is None or (isinstance(given, (list, tuple)) and len(given) == 0):
            given = np.zeros((0, 3))
        obstacles = checked_array("obstacles", given, (None, 3))
        for i, (x, y, radius) in enumerate(obstacles):
            if radius <= 0.0:
                raise ValueError(f"obstacles[{i}]: radius must be > 0 m, not {radius:g}")
            for name, state in (("start", self.start), ("goal", self.goal)):
                distance = float(np.hypot(state[0] - x, state[1] - y))
                if distance < radius:
                    raise ValueError(
                        f"obstacles[{i}] (centre ({x:g}, {y:g}) m, radius {radius:g} m) lies over "
                        f"the {name} at ({state[0]:g}, {state[1]:g}) m: the distance to its "
                        f"centre is {distance:g} m and must be at least the radius"
                    )
        return obstacles

    def __deepcopy__(self, memo: dict[int, Any]) -> Scenario:
        return self  # frozen: there is nothing to copy

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        for value in state.values():
            if isinstance(value, np.ndarray):  # pickles come back writable
                value.setflags(write=False)

    # ---------------------------------------------------------------- identity and variants

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Scenario):
            return NotImplemented
        return self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        # Of numbers, not of text: 0.0 and -0.0 are equal and must hash alike.
        values = (getattr(self, field.name) for field in dataclasses.fields(self))
        return hash(tuple(tuple(v.flat) if isinstance(v, np.ndarray) else v for v in values))

    def replace(self, **changes: Any) -> Scenario:
        """A copy with some fields changed, validated again.

        Raises:
            ValueError: for an unknown field or a bad value.
        """
        return replaced(self, "scenario", changes)

    def to_dict(self) -> dict[str, Any]:
        """Plain Python data, exact to the last bit."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {
            "format": _FORMAT,
            **{k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()},
        }

    def to_json(self) -> str:
        """JSON text; `from_json` gives back an equal scenario."""
        return json.dumps(self.to_dict())

    @classmethod
    def from_json(cls, text: str) -> Scenario:
        """The scenario that :meth:`to_json` wrote.

        Raises:
            ValueError: if the text is no JSON object, has unknown or missing fields, or a
                value is out of range.
        """
        return cls.from_dict(parsed_object(text, "scenario"))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Scenario:
        """The scenario that :meth:`to_dict` gave.

        Raises:
            ValueError: for unknown or missing fields, or a value out of range.
        """
        data = dict(data)
        version = data.pop("format", _FORMAT)
        if version != _FORMAT:
            raise ValueError(
                f"scenario format {version!r} is unknown; this version reads {_FORMAT}"
            )
        known = [field.name for field in dataclasses.fields(cls)]
        unknown = sorted(set(data) - set(known))
        missing = sorted({"start", "goal"} - set(data))
        if unknown or missing:
            raise ValueError(
                f"not a scenario: unknown fields {unknown}, missing fields {missing}; "
                f"the fields are {known}"
            )
        return cls(**data)

    @staticmethod
    def names() -> list[str]:
        """Names that :meth:`named` knows, `paper` first."""
        return list(worlds.NAMED)

    @classmethod
    def named(cls, name: str) -> Scenario:
        """A scenario by name; see :mod:`slipcar.envs.worlds`.

        Raises:
            ValueError: for an unknown name, listing the known ones.
        """
        if not isinstance(name, str) or name not in worlds.NAMED:
            raise ValueError(f"unknown scenario {name!r}; the named ones are {cls.names()}")
        return cls(**worlds.named_world(name))

    @classmethod
    def random(
        cls, seed: int, obstacles: int | None = None, *, turned: bool = False, **changes: Any
    ) -> Scenario:
        """A random world: goal 2.5–4.5 m away, obstacles between, none over start or goal.

        Args:
            seed: the same seed gives the same world.
            obstacles: how many, 0 to 8; None draws 1 to 8.
            turned: also draw start and goal headings.
            **changes: fields that replace the drawn or default ones.

        Raises:
            ValueError: for a seed or number out of range.
        """
        checked_int("seed", seed, at_least=0)
        if obstacles is not None:
            checked_int("obstacles", obstacles, at_least=0, at_most=worlds.MAX_RANDOM_OBSTACLES)
        return cls(**{**worlds.random_world(seed, obstacles, turned), **changes})

    @classmethod
    def of(cls, scenario: Scenario | str | Mapping[str, Any]) -> Scenario:
        """The scenario itself; the one of that name; or the one that JSON text or data describe.

        Raises:
            ValueError: for anything else.
        """
        if isinstance(scenario, Scenario):
            return scenario
        if isinstance(scenario, str):
            text = scenario.removeprefix(MARK).lstrip()
            return cls.from_json(text) if text.startswith("{") else cls.named(scenario)
        if isinstance(scenario, Mapping):
            return cls.from_dict(scenario)
        raise ValueError(
            f"expected a Scenario, one of the names {cls.names()}, or what to_json or to_dict "
            f"gave, not {type(scenario).__name__}"
        )

    # ---------------------------------------------------------------- the problem it poses

    @property
    def dt(self) -> float:
        """Length of a control interval [s]."""
        return self.horizon / (self.nodes - 1)

    @cached_property
    def times(self) -> np.ndarray:
        """Node times, (N,) [s]."""
        return _frozen(np.linspace(0.0, self.horizon, self.nodes))

    @cached_property
    def control_weight(self) -> np.ndarray:
        """R of G(u) = uᵀ R u, (2, 2): the identity."""
        return _frozen(np.eye(car.CONTROL_DIM))

    @property
    def angles(self) -> tuple[int, ...]:
        """Components of the state that are angles of period 2π."""
        return (2,)

    @property
    def state_names(self) -> tuple[str, ...]:
        """What figures and frames call the states, with their units."""
        return _labels(car.STATE_NAMES, car.STATE_UNITS)

    @property
    def control_names(self) -> tuple[str, ...]:
        """What figures and frames call the controls, with their units."""
        return _labels(car.CONTROL_NAMES, car.CONTROL_UNITS)

    @property
    def plane(self) -> tuple[int, int]:
        """The two states that :meth:`draw` draws in: the position."""
        return 0, 1

    def draw(self, axes: Any) -> None:
        """Draw the world into the axes of matplotlib: obstacles, clearance, start and goal."""
        drawing.draw_world(axes, self.obstacles, self.clearance, self.start, self.goal)

    def drift(self, t: Any, x: Any, u: Any) -> Any:
        """b(x, u), (..., 5); see :func:`slipcar.envs.car.drift`."""
        return car.drift(x, u)

    def drift_jacobian(self, t: Any, x: Any, u: Any) -> tuple[Any, Any]:
        """∂b/∂x (..., 5, 5) and ∂b/∂u (..., 5, 2)."""
        return car.drift_jacobian(x, u)

    @cached_property
    def process(self) -> tuple[tuple[int, float], ...]:
        """Which states process noise reaches, and its standard deviation per √s, p pairs."""
        deviations = self.process_noise.tolist()
        return tuple((i, deviation) for i, deviation in enumerate(deviations) if deviation)

    @property
    def noise_dim(self) -> int:
        """Brownian motions that drive the car, 3 + p: three of the slip, then the process noise."""
        return car.NOISE_DIM + len(self.process)

    @cached_property
    def row_parameters(self) -> Parameters:
        """The numbers of a step, for components that are rows of float64."""
        return Parameters.of(self).shaped(np.empty(0), self)

    @cached_property
    def start_covariance(self) -> np.ndarray:
        """Covariance of x(0), (5, 5)."""
        return _frozen(np.diag(self.start_deviation**2))

    def diffusion(self, t: Any, x: Any) -> Any:
        """σ(x), (..., 5, 3 + p)."""
        return car.diffusion(x, self.slip.tolist(), self.process)

    def diffusion_jacobian(self, t: Any, x: Any) -> Any:
        """∂σ/∂x, (..., 5, 3 + p, 5)."""
        return car.diffusion_jacobian(x, self.slip.tolist(), self.process)

    @cached_property
    def penalty_weight(self) -> np.ndarray:
        """λ for every obstacle, (k,)."""
        return _frozen(np.full(len(self.obstacles), self.obstacle_weight))

    def penalty(self, t: Any, x: Any) -> Any:
        """c_o(r), (..., k) [m²]: the cost is λ Σ max(0, c_o)²."""
        return cost.obstacle_constraints(x, _like(x, self.obstacles), self.clearance)

    def penalty_jacobian(self, t: Any, x: Any) -> Any:
        """∂c_o/∂x, (..., k, 5)."""
        return cost.obstacle_constraints_jacobian(x, _like(x, self.obstacles))

    def constraint(self, t: Any, x: Any) -> Any:
        """δ_o − ‖r − r_o‖ for every obstacle, (..., k) [m]: a collision where positive."""
        return -cost.obstacle_distances(x, _like(x, self.obstacles))

    def terminal(self, x: Any) -> Any:
        """g(x) = x − x^f, (..., 5)."""
        return x - _like(x, self.goal)

    def terminal_jacobian(self, x: Any) -> Any:
        """∂g/∂x, (..., 5, 5): the identity."""
        G = array_namespace(x).zeros((*x.shape, car.STATE_DIM), dtype=x.dtype)
        for i in range(car.STATE_DIM):
            G[..., i, i] = 1.0
        return G

    @property
    def terminal_weight(self) -> np.ndarray:
        """W of the goal cost gᵀ diag(W) g, (5,)."""
        return self.goal_weight

    def parameters(self) -> dict[str, np.ndarray]:
        """The numbers in the functions above: one trace of a planner's serves all scenarios."""
        return {
            "obstacles": self.obstacles,
            "clearance": np.asarray(self.clearance),
            "slip": self.slip,
            "goal": self.goal,
        }

    def with_parameters(self, parameters: dict[str, np.ndarray]) -> Scenario:
        """A scenario with these numbers, which may be symbols: not validated."""
        return self._unchecked(parameters)

    def reposed(
        self, *, start: np.ndarray | None = None, final_time: float | None = None
    ) -> Scenario:
        """The same task from another state or with another horizon, for a planner on its way.

        Not validated: a car on its way may be inside an obstacle, which no scenario starts in.
        """
        changes: dict[str, Any] = {}
        if start is not None:
            changes["start"] = start
        if final_time is not None:
            changes["horizon"] = float(final_time)
        return self._unchecked(changes)

    def _unchecked(self, changes: dict[str, Any]) -> Scenario:
        copy = object.__new__(type(self))
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        vars(copy).update({**fields, **changes})
        if not changes.keys() & {"horizon", "nodes"}:
            vars(copy)["times"] = self.times
        return copy

    def initial_guess(self) -> tuple[np.ndarray, np.ndarray]:
        """The straight line with its heading and speed: states (N, 5) and zero controls.

        A guess with θ = v = 0 along the line leaves r_y uncontrollable (docs/reproduction.md).
        """
        return self._straight_line.copy(), np.zeros((self.nodes - 1, car.CONTROL_DIM))

    @cached_property
    def _straight_line(self) -> np.ndarray:
        fraction = (self.times / self.horizon)[:, None]
        x = self.start + fraction * (self.goal - self.start)
        offset = self.goal[:2] - self.start[:2]
        # Of all headings along the line, 2π apart, the one nearest those of both ends.
        middle = 0.5 * (self.start[2] + self.goal[2])
        heading = np.arctan2(offset[1], offset[0])
        x[:, 2] = heading + 2.0 * np.pi * np.round((middle - heading) / (2.0 * np.pi))
        x[:, 3] = np.hypot(*offset) / self.horizon
        x[:, 4] = 0.0
        x[0] = self.start
        return x

    def guesses(self, count: int) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """Up to `count` routes past the obstacles: label, states (N, 5), controls (N−1, 2).

        One for each homotopy class and gear, the most promising first; see
        :mod:`slipcar.envs.routes`.
        """
        return routes.guesses(self, count)

    def homotopy_class(self, states: np.ndarray) -> tuple[int, ...]:
        """Winding number of a path (N, 5) about each obstacle, (k,); see `envs.routes`."""
        return routes.homotopy_class(self, states)

    # ---------------------------------------------------------------- what a path costs

    def control_power(self, u: Any) -> Any:
        """‖u‖², (...,)."""
        return cost.control_power(u)

    def obstacle_power(self, x: Any) -> Any:
        """λ Σ_o max(0, c_o)², (...,)."""
        obstacles = _like(x, self.obstacles)
        return cost.obstacle_power(x, obstacles, self.clearance, self.obstacle_weight)

    def goal_cost(self, x: Any) -> Any:
        """(x − x^f)ᵀ W (x − x^f), (...,)."""
        return cost.goal_cost(x, _like(x, self.goal), _like(x, self.goal_weight))

    def signed_distance(self, x: Any) -> Any:
        """Distance to the nearest obstacle's rim [m], negative inside, (...,)."""
        return cost.signed_distance(x, _like(x, self.obstacles))

    # ---------------------------------------------------------------- what a controller sees

    def decode_observation(self, observation: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Time (...,) and state (..., 5) from an observation of either kind.

        Heading comes back modulo 2π from `features`; see `angles`.

        Raises:
            ValueError: if the last axis fits neither kind.
        """
        return layouts.decode(self, observation)

    def encode_control(self, u: Any) -> Any:
        """Action in [−1, 1] for a control in physical units, clipped to the bounds.

        Raises:
            ValueError: if the scenario has no control bounds to scale by.
        """
        return np.clip(u / self.action_scale, -1.0, 1.0)

    @property
    def action_scale(self) -> np.ndarray:
        """Control per unit of action, (2,).

        Raises:
            ValueError: if the scenario is unbounded: actions in [−1, 1] need a scale.
        """
        if self.control_bounds is None:
            raise ValueError(
                "control_bounds is None: actions in [-1, 1] need bounds to be scaled by; "
                "use scenario.replace(control_bounds=(2.0, 4.0)), for example"
            )
        return self.control_bounds


def _like(x: Any, values: np.ndarray) -> Any:
    """The values as the kind of array x is: NumPy's as they are, Torch's with x's dtype."""
    if isinstance(x, np.ndarray):
        return values
    # A copy, because Torch warns when it is handed read-only memory.
    return array_namespace(x).asarray(values.copy(), dtype=x.dtype, device=device(x))


def _labels(names: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{name} [{unit}]" for name, unit in zip(names, units, strict=True))


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array

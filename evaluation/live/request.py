"""What a page may ask for, checked: numbers and names, never code or a file.

Everything that a tab shows follows from its request alone, so two tabs cannot disturb each other,
and a link that holds the request shows the same again.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from slipcar.envs import Scenario
from slipcar.envs.validate import checked_int
from slipcar.evaluation.live.policies import policy_names
from slipcar.planner.problem.model import model_of
from slipcar.planner.problem.reposed import reposed

#: Mode -> what the page calls it.
MODES = {
    "feedback": "plan with feedback",
    "open": "open loop",
    "risk": "risk ≤ δ, with feedback",
    "drive": "receding horizon: drive",
}
#: The car, which is always there; other systems are those that `slipcar live` was started with.
CAR = "car"
#: What one may be asked to plan for on behalf of a page.
MOST_NODES, MOST_OBSTACLES, LARGEST = 201, 24, 1e3
#: Members of a problem of one's own that may be dragged.
DRAGGED = ("start", "goal", "obstacles")


@dataclasses.dataclass(frozen=True, eq=False)
class Request:
    """One picture.

    Attributes:
        system: `car`, or the name of a system the server was started with.
        world: of the car, a scenario as :meth:`Scenario.to_dict` gives it; of another system,
            those of `start`, `goal` and `obstacles` that were dragged.
        mode: one of :data:`MODES`.
        price: ν ≥ 0, cost per unit of collision probability.
        risk: δ in (0, 1), for the mode `risk`.
        policy: the learned policy to show beside it; empty for none.
        verify: look for the price that keeps the risk δ, and verify it, which takes a second.
        quick: one guess and few iterations, for hard worlds while one drags.
        begin: with the mode `drive`, begin at the start again.
        seed: ≥ 0, of the noise of a drive that begins.

    Raises:
        ValueError: beginning with the name of the part that is wrong.
    """

    world: Mapping[str, Any]
    system: str = CAR
    mode: str = "feedback"
    price: float = 0.0
    risk: float = 0.01
    policy: str = ""
    verify: bool = False
    quick: bool = False
    begin: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.world, Mapping):
            raise ValueError(f"world must be an object, not {type(self.world).__name__}")
        if self.mode not in MODES:
            raise ValueError(f"mode must be one of {list(MODES)}, not {self.mode!r}")
        if self.policy and self.policy not in policy_names():
            raise ValueError(f"policy must be one of {list(policy_names())}, not {self.policy!r}")
        for name in ("verify", "quick", "begin"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be true or false, not {getattr(self, name)!r}")
        checked_int("seed", self.seed, at_least=0)
        for name, low, high in (("price", 0.0, 1e9), ("risk", 1e-6, 0.999)):
            value = getattr(self, name)
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not number or not low <= value <= high:
                raise ValueError(f"{name} must be between {low:g} and {high:g}, not {value!r}")

    @classmethod
    def from_json(cls, text: str) -> tuple[int, Request | ValueError]:
        """The number a request was sent under, and the request or what is wrong with it.

        Raises:
            ValueError: for what is no request at all.
        """
        data = json.loads(text)
        if not isinstance(data, dict) or not isinstance(data.get("id"), int):
            raise ValueError("a request is an object with a whole number, id")
        number = data.pop("id")
        unknown = sorted(set(data) - {field.name for field in dataclasses.fields(cls)})
        if unknown or "world" not in data:
            return number, ValueError(f"a request has a world, and nothing like {unknown}")
        try:
            return number, cls(**data)
        except ValueError as error:
            return number, error

    def problem(self, systems: Mapping[str, Any]) -> Any:
        """What is to be planned for.

        Args:
            systems: by name, those that the server was started with.

        Raises:
            ValueError: beginning with the name of the field that is wrong.
        """
        if self.system == CAR:
            return checked_scenario(self.world)
        if self.system not in systems:
            raise ValueError(f"system must be one of {[CAR, *systems]}, not {self.system!r}")
        return moved(systems[self.system], self.world)


def checked_scenario(world: Mapping[str, Any]) -> Scenario:
    """A scenario of a size that a page may ask for.

    Raises:
        ValueError: beginning with the name of the field that is wrong.
    """
    nodes, obstacles = world.get("nodes"), world.get("obstacles")
    if isinstance(nodes, int) and nodes > MOST_NODES:
        raise ValueError(f"nodes must be at most {MOST_NODES} on this page, not {nodes}")
    if isinstance(obstacles, list) and len(obstacles) > MOST_OBSTACLES:
        raise ValueError(f"obstacles: at most {MOST_OBSTACLES} on this page, not {len(obstacles)}")
    scenario = Scenario.from_dict(world)
    for name in ("start", "goal", "obstacles"):
        values = getattr(scenario, name)
        if (np.abs(values) > LARGEST).any():
            raise ValueError(f"{name}: numbers must be within ±{LARGEST:g} on this page")
    if not 0.1 <= scenario.horizon <= 100.0:
        raise ValueError(
            f"horizon must be from 0.1 to 100 s on this page, not {scenario.horizon:g}"
        )
    return scenario


def plane_of(problem: Any) -> tuple[int, int]:
    """Which two components of the state are drawn.

    Raises:
        ValueError: if the problem has no attribute `plane` that says so, or is no problem.
    """
    if isinstance(problem, Scenario):
        return 0, 1
    try:
        n = model_of(problem).state_dim
    except TypeError as error:  # it lacks what a problem has
        raise ValueError(str(error)) from error
    plane: Any = getattr(problem, "plane", None)
    good = isinstance(plane, tuple) and len(plane) == 2 and plane[0] != plane[1]
    if not good or not all(isinstance(i, int) and 0 <= i < n for i in plane):
        raise ValueError(
            f"{type(problem).__name__}.plane must be two different components of its {n} states "
            f"such as (0, 1), which the page draws, not {plane!r}"
        )
    return plane[0], plane[1]


def moved(problem: Any, world: Mapping[str, Any]) -> Any:
    """The user's problem with what was dragged.

    Raises:
        ValueError: for what cannot be dragged in it, or numbers of another shape.
    """
    changes = {}
    for name, values in world.items():
        if name not in draggable(problem):
            raise ValueError(f"{name} cannot be moved in {type(problem).__name__}")
        try:
            array = np.array(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be numbers, not {values!r}") from error
        shape = np.shape(getattr(problem, name))
        if array.shape != shape or not (np.abs(array) <= LARGEST).all():
            raise ValueError(f"{name} must be numbers within ±{LARGEST:g}, of shape {shape}")
        changes[name] = array
    if not changes:
        return problem
    replace = getattr(problem, "replace", None)
    return reposed(problem, **changes) if replace is None else replace(**changes)


def draggable(problem: Any) -> tuple[str, ...]:
    """Members that can be dragged: with a method `replace`, goal and obstacles as well."""
    if not callable(getattr(problem, "replace", None)):
        return ("start",)
    return tuple(name for name in DRAGGED if getattr(problem, name, None) is not None)

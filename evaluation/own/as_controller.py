"""One rule for what may drive: objects with `predict`, classes, factories, functions, networks."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np

from slipcar.envs import observation as layouts
from slipcar.envs.scenario import Scenario
from slipcar.evaluation.controller import Controller, check_controller
from slipcar.evaluation.own.adapters import (
    ActionFunction,
    StateFunction,
    article,
    is_agent,
    is_module,
)
from slipcar.evaluation.rollout import play

__all__ = ["as_controller", "check_spaces"]

#: Rows that a function is tried on: neither the number of controls nor that of states.
_PROBE = 3


def as_controller(thing: Any, scenario: Scenario | str, name: str = "controller") -> Controller:
    """Make a controller of whatever can be one, and try it on the scenario's first step.

    The rule, in this order:

    1. an object with `predict` is one (see :class:`slipcar.evaluation.rollout.Controller`);
    2. a class is called first: without arguments if it can be, else with the scenario;
       so is a callable whose first parameter is named `scenario`, with the scenario;
    3. a torch module, or an object with `get_action_and_value`, is a network of observations
       (:class:`ActionFunction`);
    4. a callable with two parameters is a function of (t, x) (:class:`StateFunction`), one with a
       single parameter a function of observations (:class:`ActionFunction`).

    Attributes `per_row`, `observation` and `obstacle_slots` of a function say how it is called.

    Args:
        thing: the object.
        scenario: where it is to drive.
        name: what errors call it.

    Raises:
        ValueError: if it is none of these, or fails on the first step.
    """
    scenario = Scenario.of(scenario)
    controller = _tried(_adapted(_made(thing, scenario, name), scenario, name), scenario, name)
    return controller


def _made(thing: Any, scenario: Scenario, name: str) -> Any:
    """The object that a class or a factory makes, the object itself otherwise."""
    arguments: tuple[Any, ...]
    if isinstance(thing, type):
        needed = _required(thing, name)
        named = "scenario" in _parameters(thing, name)
        arguments = (scenario,) if needed or named else ()
        if len(needed) > 1:
            raise ValueError(
                f"{name} is a class that needs {needed} to be made: give an object, or a function "
                f"of one parameter, scenario, that makes it"
            )
    elif _is_factory(thing):
        arguments = (scenario,)
    else:
        return thing
    try:
        return thing(*arguments)
    except Exception as error:
        called = f"{name}({'scenario' if arguments else ''})"
        raise ValueError(f"{called} raised {type(error).__name__}: {error}") from error


def _is_factory(thing: Any) -> bool:
    """Whether its first parameter is named `scenario`, and it is no controller itself."""
    if not callable(thing) or callable(getattr(thing, "predict", None)) or is_agent(thing):
        return False
    try:
        return next(iter(inspect.signature(thing).parameters), "") == "scenario"
    except (TypeError, ValueError):  # what is wrong with it is said later
        return False


def _adapted(thing: Any, scenario: Scenario, name: str) -> Controller:
    if callable(getattr(thing, "predict", None)):
        return thing
    if thing is None:
        raise ValueError(f"{name} is None: a factory must return the controller it makes")
    if is_agent(thing):
        kind = _layout_of(thing, name)
        return ActionFunction(thing, kind.kind, kind.slots, name)
    if not callable(thing):
        raise ValueError(
            f"{name} is {article(type(thing).__name__)} and no controller: it has no predict and "
            f"cannot be called"
        )
    needed = _required(thing, name)
    if len(needed) == 2:
        return StateFunction(thing, scenario, bool(getattr(thing, "per_row", False)), name)
    if len(needed) == 1:
        kind = _layout_of(thing, name)
        return ActionFunction(thing, kind.kind, kind.slots, name)
    raise ValueError(
        f"{name} takes {needed or 'no parameters'}: a controller is a function of (t, x), a "
        f"function of the observation, or an object with predict; one that makes a controller "
        f"has a single parameter, scenario"
    )


def _tried(controller: Controller, scenario: Scenario, name: str) -> Controller:
    """The controller, after one step of few rows (its own number, if it has one)."""
    try:
        check_controller(controller)
        check_spaces(controller, name)
        if isinstance(controller, (StateFunction, ActionFunction)):
            _probe(controller, scenario)
        next(play(controller, scenario, seed=0, block=0, wanted=1))
    except Exception as error:
        if isinstance(error, ValueError) and str(error).startswith(name):
            raise
        raise ValueError(
            f"{name} failed on the first step: {type(error).__name__}: {error}"
        ) from error
    return controller


def check_spaces(model: Any, name: str) -> None:
    """Check what a trained model says it was trained on, if it says so (Stable-Baselines3).

    Raises:
        ValueError: for spaces that are not the car's, naming both.
    """
    from gymnasium.spaces import Box

    space = getattr(model, "action_space", None)
    if space is not None and not (
        isinstance(space, Box)
        and space.shape == (2,)
        and np.allclose(space.low, -1.0)
        and np.allclose(space.high, 1.0)
    ):
        raise ValueError(
            f"{name} was trained for actions {space}, and the car's are Box(-1.0, 1.0, (2,))"
        )
    space = getattr(model, "observation_space", None)
    if space is None or isinstance(getattr(model, "observation", None), str):
        return
    sizes = {kind: len(entries) for kind, entries in layouts.LAYOUTS.items()}
    shapes = ", ".join(f"({size},) {kind}" for kind, size in sizes.items())
    try:
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise ValueError("another kind of space")
        layouts.Layout.of_size(space.shape[0])
    except ValueError:
        told = space.shape if isinstance(space, Box) else space
        raise ValueError(
            f"{name} was trained on observations of shape {told}, and the car's have {shapes}, "
            f"and {len(layouts.SLOT)} more entries for each obstacle shown"
        ) from None


def _probe(controller: StateFunction | ActionFunction, scenario: Scenario) -> None:
    """Ask for three different states, so that a transposed answer is seen."""
    x = scenario.start + 0.01 * np.arange(_PROBE)[:, None]
    slots = controller.obstacle_slots
    t = scenario.times[0]
    controller.predict(layouts.observe(scenario, controller.observation, t, x, slots))


def _layout_of(thing: Any, name: str) -> layouts.Layout:
    """What it says it is shown; else what its first layer takes; else features."""
    kind, slots = getattr(thing, "observation", None), getattr(thing, "obstacle_slots", 0)
    if isinstance(kind, str):
        return layouts.Layout(kind, slots)
    size = _first_width(thing)
    if size is None:
        return layouts.Layout("features", slots)
    try:
        return layouts.Layout.of_size(size)
    except ValueError as error:
        raise ValueError(
            f"{name} takes {size} numbers in its first layer, and no observation has so many: "
            f"{error}"
        ) from None


def _first_width(thing: Any) -> int | None:
    if not is_module(thing):
        return None
    actor = getattr(thing, "actor_mean", thing)
    widths = (getattr(part, "in_features", None) for part in actor.modules())
    return next((int(width) for width in widths if width is not None), None)


def _parameters(thing: Any, name: str) -> list[str]:
    return [parameter.name for parameter in _signature(thing, name)]


def _required(thing: Any, name: str) -> list[str]:
    """Names of the parameters that must be given by position."""
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    found = _signature(thing, name)
    if only := [p.name for p in found if p.kind is p.KEYWORD_ONLY and p.default is p.empty]:
        raise ValueError(f"{name} needs {only} by keyword, which nobody gives it")
    return [p.name for p in found if p.kind in kinds and p.default is p.empty]


def _signature(thing: Any, name: str) -> list[inspect.Parameter]:
    try:
        return list(inspect.signature(thing).parameters.values())
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} does not say what parameters it takes: wrap it in a function of (t, x), or "
            f"of the observation"
        ) from None

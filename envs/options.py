"""What an environment is told when it is made and reset, checked once for all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from slipcar.envs.families import Family
from slipcar.envs.observation import Layout
from slipcar.envs.sources import Source, base_of, longest_horizon, most_obstacles
from slipcar.envs.validate import checked_array

RENDER_MODES = ("rgb_array", "human")
DTYPES = ("float32", "float64")
_FARTHEST = 1e6  # beyond it a float32 cannot tell decimetres, nor an angle its direction


def check_render_mode(mode: str | None) -> str | None:
    """The mode itself.

    Raises:
        ValueError: for an unknown one.
    """
    if mode is not None and mode not in RENDER_MODES:
        raise ValueError(f"unknown render_mode {mode!r}; allowed are None and {list(RENDER_MODES)}")
    return mode


def autoreset_mode_of(mode: AutoresetMode | str) -> AutoresetMode:
    """The mode, or the one of this value.

    Raises:
        ValueError: for an unknown one.
    """
    try:
        return AutoresetMode(mode)
    except ValueError:
        allowed = [mode.value for mode in AutoresetMode]
        raise ValueError(f"unknown autoreset_mode {mode!r}; allowed are {allowed}") from None


def dtype_of(dtype: Any) -> Any:
    """NumPy's type of this name.

    Raises:
        ValueError: for another than float32 and float64.
    """
    for name in DTYPES:
        if dtype == name or dtype == np.dtype(name):
            return np.dtype(name).type
    raise ValueError(f"unknown dtype {dtype!r}; allowed are {list(DTYPES)}")


def checked_flag(name: str, value: Any) -> bool:
    """The value as a bool.

    Raises:
        ValueError: for anything but True and False.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, not {value!r}")
    return bool(value)


def checked_start(start: Any, shape: tuple[int, ...]) -> np.ndarray:
    """States that an episode may begin in.

    Raises:
        ValueError: for another shape, or an entry that is not finite or beyond 10⁶.
    """
    states = checked_array("start", start, shape)
    if np.abs(states).max() > _FARTHEST:
        raise ValueError(f"start must lie within ±{_FARTHEST:g}, not at {states.tolist()}")
    return states


def layout_for(source: Source, kind: str, slots: int | None) -> Layout:
    """The observation of an environment with these arguments.

    Raises:
        ValueError: for an unknown kind, a bad number of slots, or fewer than obstacles.
    """
    if slots is None:
        slots = most_obstacles(source) if isinstance(source, Family) else 0
    layout = Layout(kind, slots)
    check_seen(layout, source)
    return layout


def check_seen(layout: Layout, source: Source) -> None:
    """Check that observations say what they are for.

    Raises:
        ValueError: if a world may have more obstacles than an observation with slots shows, or is
            so far from the origin that a float32 `state` does not tell where the car is.
    """
    most = most_obstacles(source)
    if 0 < layout.slots < most:
        raise ValueError(
            f"the {_name(source)} has up to {most} obstacles and the observation shows "
            f"{layout.slots}: pass obstacle_slots={most} or more when the environment is made, "
            "or 0 to show none"
        )
    ends = np.stack([base_of(source).start, base_of(source).goal])
    if layout.kind == "state" and np.abs(ends).max() > _FARTHEST:
        raise ValueError(
            f"the {_name(source)} leads from {ends[0].tolist()} to {ends[1].tolist()}, and the "
            f"float32 of a state observation tells too little beyond ±{_FARTHEST:g}: move the "
            "world to the origin, or take the observation 'features', relative to the goal"
        )


def check_source(layout: Layout, space: Any, source: Source) -> None:
    """Check that worlds of a source can be seen by an environment that is there already.

    Raises:
        ValueError: if they have more obstacles than slots, a longer horizon than the observation
            space allows for, or no control bounds.
    """
    check_seen(layout, source)
    horizon = longest_horizon(source)
    if layout.kind == "state" and horizon > space.high[5]:
        raise ValueError(
            f"the {_name(source)} lasts {horizon:g} s, longer than the {space.high[5]:g} s that "
            "the observation space allows for: pass it when the environment is made"
        )
    base_of(source).action_scale  # noqa: B018  raises if unbounded


def masked(mask: Any, count: int) -> np.ndarray:
    """Which of `count` environments a `reset_mask` names, as indices; all for None.

    Raises:
        ValueError: unless it is a (count,) bool array with at least one True.
    """
    if mask is None:
        return np.arange(count)
    mask = np.asarray(mask)
    if mask.shape != (count,) or mask.dtype != np.bool_ or not mask.any():
        raise ValueError(
            f"reset_mask must be a bool array of shape ({count},) with at least one "
            f"True, not {mask.dtype} of shape {mask.shape}"
        )
    return np.flatnonzero(mask)


def read_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> list[Any]:
    """The values of the known options, None where one is not given.

    Raises:
        ValueError: for an unknown one.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"options must be a dictionary, not {options!r}")
    given = dict(options or {})
    values = [given.pop(name, None) for name in known]
    if given:
        raise ValueError(f"unknown reset options {sorted(given)}; known are {list(known)}")
    return values


def _name(source: Source) -> str:
    return "family" if isinstance(source, Family) else "scenario"

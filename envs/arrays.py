"""What the physics is written in: NumPy, Torch or plain floats behind the same few names.

The equations of :mod:`slipcar.envs.car`, `cost`, `integrate`, `transition` and `observation` are
written once, on *components*: x = (r_x, r_y, θ, v, ω) is a tuple of five of anything that can be
added and multiplied. Five floats are one car, five rows of an array are a fleet, five tensors are
a fleet on a GPU. All they need beyond arithmetic is a :class:`Functions`.
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import array_api_compat
import numpy as np


class Functions(NamedTuple):
    """The elementary functions of one kind of component.

    Attributes:
        cos: of an angle [rad].
        sin: of an angle [rad].
        sqrt: square root.
        positive: max(0, ·).
        clip: (value, low, high), the value limited to a range of floats.
        total: sum of an array along its first axis.
        smallest: minimum of an array along its first axis.
    """

    cos: Any
    sin: Any
    sqrt: Any
    positive: Any
    clip: Any
    total: Any
    smallest: Any


def _clip_float(value: float, low: float, high: float) -> float:
    return low if value < low else min(value, high)


def _positive_float(value: float) -> float:
    return max(value, 0.0)


@functools.lru_cache(maxsize=64)
def _constant(shape: tuple[int, ...], dtype: np.dtype, value: float) -> np.ndarray:
    # NumPy compares with an array four times as fast as with a number.
    array = np.full(shape, value, dtype=dtype)
    array.setflags(write=False)
    return array


def _positive_array(value: Any) -> Any:
    return np.maximum(value, _constant(value.shape, value.dtype, 0.0))


def _clip_array(value: Any, low: float, high: float) -> Any:
    # np.clip spends longer on finding out what it was given than on clipping it.
    limited = np.maximum(value, _constant(value.shape, value.dtype, low))
    return np.minimum(limited, _constant(value.shape, value.dtype, high), out=limited)


_total = functools.partial(np.add.reduce, axis=0)
_smallest = functools.partial(np.minimum.reduce, axis=0)
#: For one car. Python's floats are ten times faster than NumPy's scalars.
FLOATS = Functions(math.cos, math.sin, math.sqrt, _positive_float, _clip_float, sum, min)
#: For arrays, one element per car.
ARRAYS = Functions(np.cos, np.sin, np.sqrt, _positive_array, _clip_array, _total, _smallest)


def functions_of(component: Any) -> Functions:
    """The functions for components of this kind.

    Raises:
        TypeError: for anything but floats, NumPy arrays and Torch tensors.
    """
    if isinstance(component, float):
        return FLOATS
    if isinstance(component, np.ndarray):
        return ARRAYS
    if _all_tensors((component,)):
        return tensor_functions()
    xp = array_namespace(component)
    return Functions(
        cos=xp.cos,
        sin=xp.sin,
        sqrt=xp.sqrt,
        positive=lambda value: xp.clip(value, min=0.0),
        clip=xp.clip,
        total=lambda values: xp.sum(values, axis=0),
        smallest=lambda values: xp.min(values, axis=0),
    )


@functools.cache
def tensor_functions() -> Functions:
    """For Torch tensors, one element per car: Torch's own, which have the fewest wrappers."""
    import torch

    return Functions(
        torch.cos,
        torch.sin,
        torch.sqrt,
        torch.relu,
        torch.clamp,
        functools.partial(torch.sum, dim=0),
        functools.partial(torch.amin, dim=0),
    )


def array_namespace(*arrays: Any) -> Any:
    """NumPy's or Torch's functions under the array API's names.

    `array_api_compat.array_namespace` inspects every argument anew, which takes longer than
    the arithmetic of a single path; NumPy's arrays and scalars and Torch's tensors need none. (What
    is called of it here, NumPy 1.26 has under these names.)

    Raises:
        TypeError: if the arguments are no arrays, or of different kinds.
    """
    for array in arrays:
        if not isinstance(array, (np.ndarray, np.generic)):
            break
    else:
        return np
    if _all_tensors(arrays):
        from array_api_compat import torch as namespace

        return namespace
    return array_api_compat.array_namespace(*arrays)


def stacked(xp: Any, components: Sequence[Any]) -> Any:
    """Components of one shape (...,) as the last axis of an array, (..., n)."""
    first = components[0]
    if type(first) is not np.ndarray:
        return xp.stack(list(components), axis=-1)
    # np.stack takes three times as long for the few numbers of a path.
    array = np.empty((*first.shape, len(components)), np.result_type(*components))
    for i, component in enumerate(components):
        array[..., i] = component
    return array


def _all_tensors(arrays: Sequence[Any]) -> bool:
    torch = sys.modules.get("torch")  # whoever has a tensor has imported it
    return torch is not None and all(isinstance(array, torch.Tensor) for array in arrays)

"""The array API namespace of what a function is given, with a short cut for NumPy."""

from __future__ import annotations

from typing import Any

import array_api_compat
import array_api_compat.numpy
import numpy as np


def array_namespace(*arrays: Any) -> Any:
    """NumPy's or Torch's functions under the array API's names.

    `array_api_compat.array_namespace` inspects every argument anew, which takes longer than
    the arithmetic of a single path; NumPy arrays, and scalars of NumPy, need no inspection.

    Raises:
        TypeError: if the arguments are no arrays, or of different kinds.
    """
    if all(isinstance(array, (np.ndarray, np.generic)) for array in arrays):
        return array_api_compat.numpy
    return array_api_compat.array_namespace(*arrays)

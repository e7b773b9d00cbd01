"""Which functions the iteration runs on: compiled where that is possible, else in NumPy."""

from __future__ import annotations

from types import ModuleType

import numpy as np

from slipcar.planner.expected.guarded import Posed
from slipcar.planner.newton.functions import Functions
from slipcar.planner.search.method import driver

Array = np.ndarray


def engine(
    ready: Posed, x: Array, u: Array, *, compiled: bool | None
) -> tuple[Functions, ModuleType | None]:
    """Functions, compared with the problem's own near x (N, n), u (K, m), and :mod:`.run` or None.

    Raises:
        ImportError: if compiled ones are asked for and numba is missing.
        ValueError: if they are and the problem's functions cannot be traced.
    """
    if compiled is not False and driver() is not None:
        functions = ready.functions(x, u, native=True)
        if functions.kernels is not None:
            from slipcar.planner.expected import run

            return functions, run
        if compiled:
            raise ValueError(
                f"compiled=True, but the functions of {type(ready.guarded.problem).__name__} "
                f"cannot be compiled: {functions.reason}"
            )
    elif compiled:
        raise ImportError('compiled=True needs numba: pip install "slipcar[fast]"')
    return ready.functions(x, u, native=False), None

"""The same problem from another state, or with another horizon."""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray


class Reposed:
    """A problem with other members: those given, and the rest of the original."""

    def __init__(self, problem: Any, **members: Any) -> None:
        self._problem = problem
        vars(self).update(members)

    def __getattr__(self, name: str) -> Any:
        if name in ("_problem", "to_json"):  # it is not what the original's file would say
            raise AttributeError(name)
        return getattr(self._problem, name)


def reposed(problem: Any, *, start: Array | None = None, times: Array | None = None) -> Any:
    """A problem from another start (n,), on another uniform dilation of its time grid, or both.

    A problem may know how itself, `reposed(start=..., final_time=...) -> problem`: then its plans
    can be saved, and its other members (an environment's horizon, say) follow.
    """
    own = getattr(problem, "reposed", None)
    if own is not None:
        return own(start=start, final_time=None if times is None else float(times[-1]))
    members: dict[str, Any] = {}
    if start is not None:
        members["start"] = start
    if times is not None:
        members["times"] = times
    return Reposed(problem, **members)

"""A problem with its penalties and its constraints as rows of one kind.

The iteration of :mod:`slipcar.planner.newton` knows one kind of row, c(t, x). Here they are the
problem's penalties followed by its constraints; what each costs is the business of
:mod:`.losses`. All else is the problem's own.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.planner.newton.functions import Functions, functions_of
from slipcar.planner.problem.model import Model, model_of
from slipcar.planner.problem.recent import Recent

Array = np.ndarray


class Guarded:
    """The rows of `penalty` followed by those of `constraint`.

    Args:
        problem: whose they are.
    """

    #: Derivatives of both together: by complex steps, or traced.
    penalty_jacobian = None

    def __init__(self, problem: Any) -> None:
        self._problem = self
        self.problem = problem
        inner = getattr(problem, "_problem", problem)
        self._kind = (Guarded, type(inner))
        own = getattr(problem, "penalty", None)
        self._penalty = own
        self._constraint = getattr(problem, "constraint", None)
        start, time = np.asarray(problem.start)[None], np.asarray(problem.times)[:1]
        weight = np.asarray(problem.penalty_weight, float) if own is not None else np.zeros(0)
        count = 0 if self._constraint is None else np.shape(self._constraint(time, start))[-1]
        self.penalty_weight = np.concatenate([weight, np.zeros(count)])
        #: Which rows are constraints, (p,).
        self.is_constraint = np.arange(len(weight) + count) >= len(weight)
        if self._constraint is not None and hasattr(problem, "with_parameters"):
            self.with_parameters = self._with_parameters

    def penalty(self, t: Any, x: Any) -> Any:
        """Penalties, then constraints, (..., p)."""
        rows = [f(t, x) for f in (self._penalty, self._constraint) if f is not None]
        return np.concatenate(rows, axis=-1) if rows else np.zeros((*np.shape(x)[:-1], 0))

    def _with_parameters(self, parameters: dict[str, Array]) -> Any:
        return _Symbolic(self, self.problem.with_parameters(parameters))

    def __getattr__(self, name: str) -> Any:
        if name in ("problem", "_problem"):
            raise AttributeError(name)
        return getattr(self.problem, name)


class _Symbolic:
    """A guarded problem on its way through a trace: its numbers are symbols."""

    def __init__(self, guarded: Guarded, problem: Any) -> None:
        self._problem = problem
        self._rows = [
            getattr(problem, name)
            for name in ("penalty", "constraint")
            if getattr(guarded.problem, name, None) is not None
        ]

    def penalty(self, t: Any, x: Any) -> Any:
        return np.concatenate([f(t, x) for f in self._rows], axis=-1)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._problem, name)


@dataclasses.dataclass(frozen=True)
class Posed:
    """A guarded problem ready to be iterated on.

    Attributes:
        guarded: it.
        model: checked and completed.
        found: functions met so far, by whether they are native.
    """

    guarded: Guarded
    model: Model
    found: dict[bool, Functions]

    def functions(self, x: Array, u: Array, *, native: bool) -> Functions:
        """Its six functions, compared with its own near x, u once."""
        if native not in self.found:
            self.found[native] = functions_of(self.model, x, u, native=native)
        return self.found[native]


_POSED: dict[str, Recent] = {}


def posed(problem: Any, integrator: str = "euler") -> Posed:
    """The guarded problem of a problem; the same as before for an immutable one."""
    kept = _POSED.setdefault(integrator, Recent())
    found = kept.get(problem)
    if found is None:
        guarded = Guarded(problem)
        model = dataclasses.replace(model_of(guarded), integrator=integrator)
        found = Posed(guarded, model, {})
        kept.keep(problem, found)
    return found

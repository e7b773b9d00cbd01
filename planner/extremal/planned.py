"""What is read of a plan, so that plans may know their certificates and not the other way round."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from slipcar.planner.problem.model import Model, model_of
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.records import Iteration, Multipliers
from slipcar.planner.status import Status


class Planned(Protocol):
    """The part of a :class:`slipcar.planner.Plan` that its certificate and shots need."""

    @property
    def status(self) -> Status: ...  # noqa: D102
    @property
    def times(self) -> np.ndarray: ...  # noqa: D102
    @property
    def mean(self) -> np.ndarray: ...  # noqa: D102
    @property
    def controls(self) -> np.ndarray: ...  # noqa: D102
    @property
    def multipliers(self) -> Multipliers: ...  # noqa: D102
    @property
    def history(self) -> Sequence[Iteration]: ...  # noqa: D102
    @property
    def options(self) -> Mapping[str, Any]: ...  # noqa: D102
    @property
    def problem(self) -> Problem | None: ...  # noqa: D102
    @property
    def solve_time(self) -> float: ...  # noqa: D102
    def replace(self, **changes: Any) -> Any:
        """A copy with some fields changed."""
        ...


def model_for(plan: Planned) -> Model:
    """The completed problem of a plan, with the integrator it was made with.

    Raises:
        ValueError: if the plan does not know its problem.
    """
    if plan.problem is None:
        raise ValueError(
            "this plan does not know its problem (it was loaded from a file that could not keep "
            "it), and this needs its dynamics: plan.replace(problem=...) first"
        )
    model = model_of(plan.problem)
    integrator = plan.options.get("integrator", model.integrator)
    return dataclasses.replace(model, integrator=integrator)

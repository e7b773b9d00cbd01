"""What a trajectory is worth, from the problem's functions alone: whoever found it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.planner.problem.model import model_of

Array = np.ndarray

#: Relative misses that count as none: of an Euler step, the terminal condition and the bounds.
FEASIBLE = 1e-4
#: What is dearer by this part of the cost passes for as good.
AS_GOOD = 0.01


@dataclasses.dataclass(frozen=True)
class Judged:
    """A trajectory, measured.

    Attributes:
        cost: effort, penalties and running costs.
        defect: largest miss of an Euler step, each component in parts of its largest value.
        terminal: largest |g(x_K)|, each component in parts of its largest value on the way.
        outside: largest distance of a control from its bounds, in parts of its largest value.
    """

    cost: float
    defect: float
    terminal: float
    outside: float

    @property
    def miss(self) -> float:
        """The largest of the three."""
        return max(self.defect, self.terminal, self.outside)

    @property
    def feasible(self) -> bool:
        """Whether it is a trajectory of the problem at all."""
        return bool(np.isfinite(self.cost) and self.miss <= FEASIBLE)


def judge(problem: Any, x: Array, u: Array) -> Judged:
    """States (N, n) and controls (K, m); steps are judged one by one, so that an unstable system's
    rounding errors do not grow on the way."""
    with np.errstate(all="ignore"):
        return _judge(problem, x, u)


def _judge(problem: Any, x: Array, u: Array) -> Judged:
    model = model_of(problem)
    t, dt = model.times, model.dt
    begun, ended = x[:-1], x[1:]
    cost = np.einsum("k,ki,ij,kj->", dt, u, model.R, u)
    if model.has("control_cost"):
        cost += np.sum(dt[:, None] * problem.control_cost(t[:-1], begun) * u)
    if model.has("state_cost"):
        cost += np.sum(dt * problem.state_cost(t[1:], ended))
    if model.has("penalty"):
        hinge = np.maximum(problem.penalty(t[1:], ended), 0.0)
        cost += np.sum(dt[:, None] * model.weight * hinge**2)
    miss = begun + dt[:, None] * problem.drift(t[:-1], begun, u) - ended
    on_the_way = np.abs(problem.terminal(x)).max(axis=0)
    return Judged(
        cost=float(cost),
        defect=_part(np.vstack([miss, x[:1] - model.start]), np.abs(x).max(axis=0)),
        terminal=_part(problem.terminal(x[-1]), on_the_way),
        outside=_part(u - np.clip(u, model.lower, model.upper), np.abs(u).max(axis=0)),
    )


def excess(cost: float, reference: float) -> float:
    """How much dearer, in parts of the reference."""
    return (cost - reference) / abs(reference)


def _part(miss: Array, size: Array) -> float:
    """The largest |miss| per size, components last; inf if any is not finite."""
    size = np.where(size > 0.0, size, 1.0)
    return float(np.nan_to_num(np.max(np.abs(miss) / size), nan=np.inf))

"""`Plan`: what planning returns."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.planner import export, plan_file
from slipcar.planner.actuation import Actuation
from slipcar.planner.display import facts
from slipcar.planner.extremal.certificate import Certificate, certify
from slipcar.planner.extremal.shooting import Shot
from slipcar.planner.moments.covariance import trace_integral
from slipcar.planner.newton.running import Steered
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.model import Model, penalty_cost
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.records import Alternative, ExpectedCost, Iteration, Multipliers, TimeStep
from slipcar.planner.search.risk import Risk
from slipcar.planner.status import Status

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

Array = np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """Open-loop controls, the mean they steer and the covariance predicted around it.

    Attributes:
        status: how planning ended; only CONVERGED is an answer.
        times: nodes, (N,) [s].
        mean: μ, (N, n), in the units of the problem's state.
        controls: u, (N−1, m), constant on each interval.
        covariance: Σ, (N, n, n); the first is the problem's `start_covariance`, zero by default.
        effort: Σ dt uᵀRu.
        obstacle_cost: Σ dt Σ w max(0, c(μ))².
        running_cost: Σ dt (H(μ) + ℓ(μ)ᵀu), the problem's smooth running costs.
        variance: ∫ tr Σ dt.
        iterations: sub-problems solved.
        history: one :class:`Iteration` for each.
        guess: states the iteration started from, (N, n).
        multipliers: of the last sub-problem.
        A: Jacobians ∂x⁺/∂x of the integrator's steps along the plan, I + dt ∂b/∂x for Euler's,
            (N−1, n, n).
        B: ∂x⁺/∂u, dt ∂b/∂u for Euler's, (N−1, n, m).
        gains: feedback gains, (N−1, m, n), or None.
        solve_time: wall-clock seconds of `plan`, callback included.
        options: what `plan` was called with.
        problem: the problem planned for; None after loading if it could not be saved.
        actuation: what controllers need of a problem that could not be saved, from the file; None
            where `problem` is known.
        message: what is lacking, the solver's own words if it failed, which guess was taken.
        alternatives: what became of each guess, the best first, when there were several starts.
        time_search: every horizon tried, when the final time was free.
        shot: the last attempt at shooting, when it was asked for and one was made; not saved.
        expected: what the plan costs in expectation, when it was made for that: with `risk`,
            `risk_price`, `feedback` or `expected`. The history is then that of the plan of the
            mean it started from, and `covariance` is that of the closed loop.
        risk: requested, predicted and verified probability of a violation, when one was asked for.
    """

    status: Status
    times: Array
    mean: Array
    controls: Array
    covariance: Array
    effort: float
    obstacle_cost: float
    running_cost: float
    variance: float
    iterations: int
    history: Sequence[Iteration]
    guess: Array
    multipliers: Multipliers
    A: Array
    B: Array
    gains: Array | None
    solve_time: float
    options: dict[str, Any]
    problem: Problem | None
    message: str = ""
    alternatives: tuple[Alternative, ...] = ()
    time_search: tuple[TimeStep, ...] = ()
    shot: Shot | None = None
    expected: ExpectedCost | None = None
    risk: Risk | None = None
    actuation: Actuation | None = None

    @property
    def cost(self) -> float:
        """Effort plus obstacle cost plus running cost."""
        return self.effort + self.obstacle_cost + self.running_cost

    @property
    def final_time(self) -> float:
        """The last node [s]; chosen by the planner when the final time was free."""
        return float(self.times[-1])

    @functools.cached_property
    def certificate(self) -> Certificate:
        """What the plan proves: multipliers and residuals of the maximum principle.

        Raises:
            ValueError: if the plan does not know its problem (loaded from a file without it), or
                minimises an expected cost: that is not the problem the conditions are of.
        """
        if self.expected is not None:
            raise ValueError(
                "the certificate is of plans of the mean: leave risk, risk_price, feedback and "
                "expected out"
            )
        # At its bound the horizon's slope need not vanish.
        bounds = self.options.get("final_time_bounds") or ()
        free = not np.isclose(self.times[-1] - self.times[0], bounds, rtol=1e-9).any()
        return certify(self, time_weight=self.options.get("time_weight") if free else None)

    def __repr__(self) -> str:
        return (
            f"Plan({self.status}, effort={self.effort:.6g}, "
            f"obstacle_cost={self.obstacle_cost:.3g}, variance={self.variance:.4g}, "
            f"iterations={self.iterations}, solve_time={1e3 * self.solve_time:.1f} ms)"
        )

    def _repr_html_(self) -> str:
        return facts("Plan", export.html_facts(self))

    def plot(self, axes: Any = None, *, plane: tuple[int, int] | None = None) -> Any:
        """Draw the mean and how far paths stray from it, for any problem, with matplotlib.

        In a plane of two states: the path, ellipses that hold 95 % of the paths, and whatever the
        problem draws there (`draw(axes)`, if it has that). Without a plane: each state over time
        with its 95 % band, each control as steps.

        Args:
            axes: where to draw; None makes a figure.
            plane: which two states; None takes the problem's `plane`, and time if it has none.

        Returns:
            The Axes; without a plane an array (n + m,) of them, states first.

        Raises:
            ValueError: for a plane of other than two states, or too few axes.
            ImportError: without matplotlib.
        """
        return export.plot(self, axes, plane)

    def to_frame(self) -> pd.DataFrame:
        """A row a node: each state's mean and standard deviation, and the controls from there on.

        Columns are called as the problem's `state_names` and `control_names` say, x[0] and u[0]
        without. The last row has no controls (nan). Needs pandas.
        """
        return export.to_frame(self)

    def to_xarray(self) -> xr.Dataset:
        """Mean, covariance, controls and gains with named dimensions and times. Needs xarray.

        Raises:
            ImportError: without it.
        """
        return export.to_xarray(self)

    def replace(self, **changes: Any) -> Plan:
        """A copy with some fields changed, for example `gains`."""
        return dataclasses.replace(self, **changes)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write everything but `shot` and functions of the problem to an .npz file, atomically.

        The problem is kept if it has `to_json()` and its class is registered under the entry
        point group `slipcar.problems` (Scenario is). Of any other the control bounds, weight and
        angles are kept, so that `OpenLoop` and `Feedback` of the loaded plan act as before; its
        functions are not, and what needs them (`certificate`) says so.

        Args:
            path: `.npz` is added to a name without it; :meth:`load` finds the file by either.

        Returns:
            The file.

        Raises:
            OSError: if it cannot be written, naming it.
        """
        return plan_file.write(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Read what :meth:`save` wrote. No pickled code is run.

        Raises:
            FileNotFoundError: if there is no such file, with or without `.npz`.
            ValueError: if it is no plan, is damaged or has another format.
        """
        return cls(**plan_file.read(path))


def plan_of(outcome: Outcome, model: Model, problem: Problem, **others: Any) -> Plan:
    """A plan of what `outcome` found for `model`, which completes `problem`."""
    return Plan(
        **fields_of(outcome, model, outcome.penalty, outcome.trust_multiplier),
        times=model.times,
        iterations=outcome.iterations,
        history=outcome.history,
        gains=None,
        problem=problem,
        message="; ".join(filter(None, (outcome.message, _through(outcome, model)))),
        **others,
    )


def _through(outcome: Outcome, model: Model) -> str:
    """What a converged mean runs through, in words: penalties allow what constraints forbid."""
    if not (outcome.status.ok and model.has("constraint")):
        return ""
    t, x = model.times[1:], outcome.x[1:]
    c = np.asarray(model.problem.constraint(t, x))  # type: ignore[attr-defined]
    if not c.size or not (worst := c.max()) > 0.0:
        return ""
    k, row = np.unravel_index(c.argmax(), c.shape)
    return f"the mean violates constraint[{row}] by {worst:.3g} at t = {t[k]:.4g}"


def fields_of(
    ended: Outcome | Steered, model: Model, obstacle_cost: float, trust_multiplier: float = 0.0
) -> dict[str, Any]:
    """What a plan takes over from where an iteration ended."""
    multipliers = Multipliers.of(ended.adjoint, ended.terminal, trust_multiplier, ended.A)
    return {
        "status": ended.status,
        "mean": ended.x,
        "controls": ended.u,
        "covariance": ended.covariance,
        "effort": ended.effort,
        "obstacle_cost": obstacle_cost,
        "running_cost": ended.running,
        "variance": trace_integral(ended.covariance, model.dt),
        "multipliers": multipliers,
        "A": ended.A,
        "B": ended.B,
    }


def steered_fields(steered: Steered, model: Model) -> dict[str, Any]:
    """The same for an iteration on an expected cost, and its gains."""
    return fields_of(steered, model, penalty_cost(model, steered.x)) | {"gains": steered.gains}

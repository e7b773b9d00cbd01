"""What a plan proves: its multipliers and the residuals of the maximum principle.

The iteration promises (Theorems 3.3 and 3.4) that what it accumulates at satisfies the maximum
principle of the *non-linear* problem, if p⁰_k ≠ 0 all along. Both are checked here afterwards,
from the plan and the problem alone: the adjoint equation is run backwards from 𝔭 (see
:mod:`.maximum_principle`), and every condition's residual is measured, in the problem's units and
relative to its natural scale. Zero residuals make the plan an extremal, a candidate for a local
optimum: the maximum principle is necessary, not sufficient.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.planner.display import brief, facts
from slipcar.planner.extremal.maximum_principle import (
    FirstOrder,
    Scales,
    adjoint_of,
    best_step,
    first_order,
    model_for,
    scales,
    time_slope,
)
from slipcar.planner.problem.model import Model
from slipcar.planner.records import Multipliers
from slipcar.planner.status import Status

Array = np.ndarray

#: Multipliers are normalised to length one; a |p⁰| below this is as good as none.
_VANISHING = 1e-14
#: A sub-problem that lacks more than this of its terminal condition, per unit of the state, was
#: solved with that condition relaxed: its multiplier is the limit ρ, and normal by construction.
_RELAXED = 1e-6
#: Feasibility is asked for more strictly than optimality, as the iteration does.
_FEASIBLE, _FEASIBILITY = ("dynamics", "terminal condition", "u in U"), 1e-4
_quiet = np.errstate(over="ignore", invalid="ignore", divide="ignore")


@dataclasses.dataclass(frozen=True)
class Violations:
    """How far a trajectory with multiplier 𝔭 is from the maximum principle, in its own units."""

    at: FirstOrder
    dynamics: float  # largest |F_k(x_k, u_k) − x_{k+1}|
    terminal: float  # largest |g(x_K)| beyond its tolerance
    control: float  # largest |argmax_U H_k − u_k|, p from the adjoint recursion
    hamiltonian: float  # largest max_U H_k − H_k(u_k) ≥ 0
    bounds: float  # largest distance of a u_k from U
    gap: float  # largest Σ_k |F_k(x_k, u_k) − x_{k+1}| of a state, relative to how far it moves
    end: float  # largest |g_j| beyond its tolerance, relative to how far it moves
    maximality: float  # largest distance of u_k from argmax_U H_k, relative to the controls' size
    outside: float  # and from U
    adjoint: Array  # λ_1..λ_K = −p_1..−p_K by the recursion, (K, n)
    scales: Scales

    __repr__ = brief

    @property
    def relative(self) -> dict[str, float]:
        """Residuals by name, divided by their scales."""
        return {
            "dynamics": self.gap,
            "terminal condition": self.end,
            "u = argmax H": self.maximality,
            "u in U": self.outside,
        }

    @property
    def largest(self) -> float:
        """The largest of them."""
        return _worst(self.relative)


@_quiet
def violations(
    model: Model,
    x: Array,
    u: Array,
    terminal: Array,
    *,
    variance_weight: float,
    terminal_tolerance: float = 0.0,
) -> Violations:
    """Measure any trajectory: an iterate of SCP, a point of the shooting method, a plan.

    States x (N, n), controls u (K, m) and ν = −𝔭 of the sub-problem, (q,); w ≥ 0 and half the width
    of the terminal box.
    """
    at = first_order(model, x, u, variance_weight)
    plain, closed = (_maximality(model, at, terminal, answered) for answered in (False, True))
    adjoint, e, gain = plain if _largest(plain[1]) <= 100.0 * _largest(closed[1]) else closed
    beyond = np.maximum(np.abs(at.lin.g) - terminal_tolerance, 0.0)
    out, units = model.admissible(u) - u, scales(model, at, adjoint)
    return Violations(
        at=at,
        dynamics=_largest(at.lin.defect),
        terminal=_largest(beyond),
        control=_largest(e),
        hamiltonian=max(0.0, float(np.max(gain))),
        bounds=_largest(out),
        gap=_largest(np.abs(at.lin.defect).sum(axis=0) / units.state),
        end=_largest(beyond / units.end),
        maximality=float(np.linalg.norm(e / units.control, axis=1).max()),
        outside=float(np.linalg.norm(out / units.control, axis=1).max()),
        adjoint=adjoint,
        scales=units,
    )


def _maximality(
    model: Model, at: FirstOrder, terminal: Array, answered: bool
) -> tuple[Array, Array, Array]:
    """An adjoint, the way to argmax_U H, and what that gains: either adjoint proves an extremal."""
    adjoint = adjoint_of(model, at, terminal, answered=answered)
    return adjoint, *best_step(model, at, adjoint)


@dataclasses.dataclass(frozen=True)
class Certificate:
    """The maximum principle, checked; `print(certificate)` says what came out.

    Attributes:
        status: of the plan.
        multipliers: (𝔭, p⁰, p¹) and p(t) of the plan, normalised to ‖(𝔭, p⁰, p¹)‖ = 1.
        terminal_history: 𝔭_k of every sub-problem, normalised, (iterations, q).
        cost_history: p⁰_k, (iterations,).
        trust_region_history: p¹_k, (iterations,).
        relaxed: sub-problems whose terminal condition had to be relaxed, (iterations,) bool.
        violations: residuals of the non-linear problem.
        adjoint: p at every node by the adjoint recursion, p⁰ = −1, (N, n).
        adjoint_difference: largest difference from the plan's own adjoint.
        adjoint_off: the same, relative to the largest of each component.
        limit: |p⁰| of the plan and its last sub-problem, the smaller, beside multipliers in units
            of the cost and of how far each terminal condition moves.
        transversality: max_U H at the end, which vanishes when the final time is free; None when
            it is fixed.
        cost_rate: mean cost per time, the scale of `transversality`.
        tolerance: largest relative residual of an extremal; of dynamics, terminal condition and
            bounds at most 1e-4.
    """

    status: Status
    multipliers: Multipliers
    terminal_history: Array
    cost_history: Array
    trust_region_history: Array
    relaxed: Array
    violations: Violations
    adjoint: Array
    adjoint_difference: float
    adjoint_off: float
    limit: float
    transversality: float | None
    cost_rate: float
    tolerance: float

    @property
    def smallest_cost_multiplier(self) -> float:
        """min_k |p⁰_k|."""
        return float(np.min(np.abs(self.cost_history), initial=abs(self.multipliers.cost)))

    @property
    def normal(self) -> bool:
        """Whether p⁰ ≠ 0 in the limit, which Theorem 3.4 supposes of every iteration.

        Multipliers of early iterates may be huge far from anything feasible, and say nothing.
        """
        return self.limit > _VANISHING

    @property
    def residuals(self) -> dict[str, float]:
        """Every residual relative to its scale."""
        relative = self.violations.relative
        relative["adjoint equation"] = self.adjoint_off
        if self.transversality is not None:
            relative["transversality"] = abs(self.transversality) / self.cost_rate
        return relative

    @property
    def residual(self) -> float:
        """The largest relative residual; inf if one is not finite."""
        return _worst(self.residuals)

    @property
    def extremal(self) -> bool:
        """Whether the plan is an extremal to the tolerance, whatever its status says."""
        return self.normal and not self._failed()

    def _failed(self) -> list[str]:
        """Conditions that do not hold, the worst first."""
        strict = min(self.tolerance, _FEASIBILITY)
        excess = {
            name: np.nan_to_num(value / limit, nan=np.inf)
            for name, value in self.residuals.items()
            if not value <= (limit := strict if name in _FEASIBLE else self.tolerance)
        }
        return sorted(excess, key=lambda name: -excess[name])

    def __repr__(self) -> str:
        return f"Certificate({self.verdict})"

    def _repr_html_(self) -> str:
        relative = {name: f"{value:.1e} of its scale" for name, value in self.residuals.items()}
        rows = {"smallest |p⁰_k|": f"{self.smallest_cost_multiplier:.3g}", **relative}
        failed = [f"not met: {', '.join(self._failed())}"] if not self.extremal else []
        return facts(f"Certificate: {self.verdict}", rows, failed)

    @property
    def verdict(self) -> str:
        """What came out, in a line."""
        ended = f" ({self.status})"
        if self.extremal:
            verdict = f"EXTREMAL to {self.residual:.1e}: the maximum principle holds"
        else:
            verdict = "NO extremal shown: the cost's multiplier p⁰ vanishes (abnormal)"
            if self.normal:
                worst = self._failed()[0]
                size = f"{self.residuals[worst]:.1e}"
                verdict = f"NO extremal: {worst} violated by {size} of its scale"
            if self.status.ok:
                ended = " (CONVERGED: ask for a smaller tolerance)"
        return verdict + ended

    def __str__(self) -> str:
        v, relaxed = self.violations, int(self.relaxed.sum())
        lines = [
            self.verdict,
            f"  normal      min |p⁰_k| = {self.smallest_cost_multiplier:.3g} over "
            f"{len(self.cost_history)} iterations"
            + (f", {relaxed} with a relaxed terminal condition" if relaxed else ""),
            f"  dynamics    mean misses its own step by {v.dynamics:.1e}",
            f"  terminal    |g(x(T))| = {v.terminal:.1e} beyond its tolerance",
            f"  adjoint     p from 𝔭 and p of the sub-problem differ by "
            f"{self.adjoint_difference:.1e} of {v.scales.adjoint.max():.2g}",
            f"  maximality  u misses argmax H by {v.control:.1e} of {v.scales.control.max():.2g}; "
            f"H by {v.hamiltonian:.1e}; U by {v.bounds:.1e}",
        ]
        if self.transversality is not None:
            lines.append(f"  final time  max H = {self.transversality:.1e} at the end")
        return "\n".join(lines)


@_quiet
def certify(plan: Any, *, tolerance: float = 1e-2, time_weight: float | None = None) -> Certificate:
    """Check a plan against the maximum principle; never raises for how the plan ended.

    Args:
        plan: a :class:`slipcar.planner.Plan` that knows its problem.
        tolerance: largest relative residual of an extremal (of feasibility at most 1e-4). Of
            100 random worlds 99 meet the default with `plan`'s own default stopping rule, and all
            with its `tolerance=1e-6`.
        time_weight: cost of a unit of final time when the final time was free: its
            transversality condition is checked too. None when it was fixed.

    Raises:
        ValueError: if the plan does not know its problem, or the tolerance is not > 0.
    """
    if not (np.isfinite(tolerance) and tolerance > 0.0):
        raise ValueError(f"tolerance must be finite and > 0, not {tolerance!r}")
    model, own, weight = model_for(plan), plan.multipliers, plan.options["variance_weight"]
    q = len(own.terminal)
    broken = violations(
        model, plan.mean, plan.controls, -own.terminal,
        variance_weight=weight, terminal_tolerance=plan.options["terminal_tolerance"],
    )  # fmt: skip
    lin = broken.at.lin
    adjoint = -np.vstack([lin.A[0].T @ broken.adjoint[0], broken.adjoint])
    off = adjoint[1:] - own.adjoint[1:]
    ends = [own.terminal, *(h.terminal_multiplier for h in plan.history[-1:])]
    history = [
        Multipliers(-h.terminal_multiplier, -1.0, -h.trust_multiplier, own.adjoint).normalized()
        for h in plan.history
    ]
    lacking = np.array([h.virtual_control for h in plan.history])
    transversality = None
    if time_weight is not None:
        transversality = -time_slope(model, broken.at, broken.adjoint, weight) - time_weight
    rate = (lin.effort + lin.penalty) / (model.times[-1] - model.times[0])
    return Certificate(
        plan.status, own.normalized(),
        terminal_history=np.reshape([h.terminal for h in history], (len(history), q)),
        cost_history=np.array([h.cost for h in history]),
        trust_region_history=np.array([h.trust_region for h in history]),
        relaxed=lacking > _RELAXED * broken.scales.end.max(initial=0.0),
        violations=broken, adjoint=adjoint,
        adjoint_difference=_largest(off),
        adjoint_off=_largest(off / broken.scales.adjoint),
        limit=_limit(model, broken, ends),
        transversality=transversality, cost_rate=max(rate, abs(time_weight or 0.0), 1e-300),
        tolerance=float(tolerance),
    )  # fmt: skip


def _limit(model: Model, broken: Violations, multipliers: list[Array]) -> float:
    """The least |p⁰| of ‖(𝔭, p⁰)‖ = 1, 𝔭 (q,) in units that do not matter."""
    lin, size = broken.at.lin, broken.scales.control
    least = float(size * size @ np.diagonal(model.R)) * float(model.dt.sum())
    unit = broken.scales.end / (lin.effort + lin.penalty + abs(lin.running) + least)
    return min(float(1.0 / np.sqrt(1.0 + np.square(unit * p).sum())) for p in multipliers)


def _largest(values: Array) -> float:
    return float(np.max(np.abs(values), initial=0.0))


def _worst(residuals: dict[str, float]) -> float:
    values = np.array(list(residuals.values()))
    return float(values.max()) if np.isfinite(values).all() else np.inf

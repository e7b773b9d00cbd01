"""`plan`: the one call; `Plan`: what it returns."""

from __future__ import annotations

import dataclasses
import json
import os
import time
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np

from slipcar.planner import moments
from slipcar.planner.backends import Solver, make_solver
from slipcar.planner.multipliers import Multipliers
from slipcar.planner.problem import Problem, checked_trajectory, model_of
from slipcar.planner.scp import Iteration, Settings, iterate
from slipcar.planner.status import Status
from slipcar.planner.trust_region import TRUST_REGIONS

Array = np.ndarray

_FORMAT = 1


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """Open-loop controls, the mean they steer and the covariance predicted around it.

    Attributes:
        status: how planning ended; only CONVERGED is an answer.
        times: nodes, (N,) [s].
        mean: μ, (N, n), in the units of the problem's state.
        controls: u, (N−1, m), constant on each interval.
        covariance: Σ, (N, n, n).
        effort: Σ dt uᵀRu.
        obstacle_cost: Σ dt Σ w max(0, c(μ))².
        variance: ∫ tr Σ dt.
        iterations: sub-problems solved.
        history: one :class:`Iteration` for each.
        guess: states the iteration started from, (N, n).
        multipliers: of the last sub-problem.
        A: I + dt ∂b/∂x along the plan, (N−1, n, n).
        B: dt ∂b/∂u, (N−1, n, m).
        gains: feedback gains, (N−1, m, n), or None.
        solve_time: wall-clock seconds of `plan`, callback included.
        options: what `plan` was called with.
        problem: the problem planned for; None after loading if it could not be saved.
        message: the solver's own words if it failed.
    """

    status: Status
    times: Array
    mean: Array
    controls: Array
    covariance: Array
    effort: float
    obstacle_cost: float
    variance: float
    iterations: int
    history: tuple[Iteration, ...]
    guess: Array
    multipliers: Multipliers
    A: Array
    B: Array
    gains: Array | None
    solve_time: float
    options: dict[str, Any]
    problem: Problem | None
    message: str = ""

    @property
    def cost(self) -> float:
        """Effort plus obstacle cost."""
        return self.effort + self.obstacle_cost

    def __repr__(self) -> str:
        return (
            f"Plan({self.status}, effort={self.effort:.6g}, "
            f"obstacle_cost={self.obstacle_cost:.3g}, variance={self.variance:.4g}, "
            f"iterations={self.iterations}, solve_time={1e3 * self.solve_time:.1f} ms)"
        )

    def replace(self, **changes: Any) -> Plan:
        """A copy with some fields changed, for example `gains`."""
        return dataclasses.replace(self, **changes)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write everything but the history's arrays of functions to an .npz file, atomically.

        The problem is kept if it has `to_json()` and its class is registered under the entry
        point group `slipcar.problems` (Scenario is).
        """
        path = Path(path)
        if path.suffix != ".npz":
            path = path.with_name(path.name + ".npz")
        arrays: dict[str, Any] = {
            name: getattr(self, name)
            for name in ("times", "mean", "controls", "covariance", "guess", "A", "B", "gains")
            if getattr(self, name) is not None
        }
        arrays |= {f"multipliers.{k}": v for k, v in self.multipliers.as_dict().items()}
        for field in dataclasses.fields(Iteration):
            if self.history:
                rows = [getattr(h, field.name) for h in self.history]
                arrays[f"history.{field.name}"] = np.stack(rows)
        scalars = ("effort", "obstacle_cost", "variance", "iterations", "solve_time", "message")
        header = {
            "format": _FORMAT,
            "status": self.status.name,
            "options": self.options,
            "problem": _problem_to_data(self.problem),
            **{name: getattr(self, name) for name in scalars},
        }
        arrays["header"] = np.array(json.dumps(header))
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp.npz")
        try:
            np.savez_compressed(temporary, allow_pickle=False, **arrays)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        return path

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Read what :meth:`save` wrote. No pickled code is run.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is no plan, is damaged or has another format.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"no plan at {path}")
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            header = json.loads(str(arrays.pop("header")))
            version = header.get("format")
        except Exception as error:  # zipfile, NumPy and JSON each raise their own
            raise ValueError(f"{path} is not a plan or is damaged: {error}") from error
        if version != _FORMAT:
            raise ValueError(f"{path} has plan format {version!r}; this version reads {_FORMAT}")
        try:
            return cls._from_file(header, arrays)
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path} is not a plan or is damaged: {error!r}") from error

    @classmethod
    def _from_file(cls, header: dict[str, Any], arrays: dict[str, Array]) -> Plan:
        return cls(
            status=Status[header["status"]],
            times=arrays["times"],
            mean=arrays["mean"],
            controls=arrays["controls"],
            covariance=arrays["covariance"],
            effort=header["effort"],
            obstacle_cost=header["obstacle_cost"],
            variance=header["variance"],
            iterations=header["iterations"],
            history=_history_from(arrays),
            guess=arrays["guess"],
            multipliers=Multipliers.from_dict(_strip(arrays, "multipliers.")),
            A=arrays["A"],
            B=arrays["B"],
            gains=arrays.get("gains"),
            solve_time=header["solve_time"],
            options=header["options"],
            problem=_problem_from_data(header["problem"]),
            message=header["message"],
        )


def plan(
    problem: Problem,
    *,
    variance_weight: float = 1.0,
    solver: str | Solver = "structured",
    tolerance: float = 1e-3,
    max_iterations: int = 100,
    trust_region: str = "adaptive",
    linearization: str = "composite",
    terminal_tolerance: float = 0.0,
    guess: Plan | tuple[Array, Array] | None = None,
    callback: Callable[[Iteration], bool | None] | None = None,
) -> Plan:
    """Plan by stochastic sequential convex programming (paper §3 and §6, SPEC §3).

        minimise  ∫ uᵀRu + Σ w max(0, c(μ))² + variance_weight · tr Σ dt

    Args:
        problem: anything that satisfies :class:`slipcar.planner.Problem`; a Scenario does.
        variance_weight: w ≥ 0; 0 is deterministic SCP.
        solver: `"structured"`, `"osqp"` or `"cvxpy"`, or an object with their interface; see
            :mod:`slipcar.planner.backends`.
        tolerance: stop when ∫ ‖u_{k+1} − u_k‖² + ‖u_k − u_{k−1}‖² dt falls to it, > 0.
        max_iterations: at most so many sub-problems, ≥ 1.
        trust_region: `"adaptive"`, `"paper"` (Δ₀ = 100, × 0.99) or `"none"`.
        linearization: `"composite"` keeps max(0, ·)² and linearises its argument; `"literal"`
            linearises the obstacle cost whole, as the paper writes it.
        terminal_tolerance: half-width of a box round E g = 0; 0 asks for equality.
        guess: where to start: a plan, or states (N, n) and controls (N−1, m); None takes the
            problem's own.
        callback: called with each :class:`Iteration`; returning True stops.

    Returns:
        A plan; look at `status` before using it.

    Raises:
        TypeError: if `problem` lacks a required member.
        ValueError: for an option or a problem's function out of range, naming it.
    """
    began = time.perf_counter()
    _check_number("variance_weight", variance_weight, zero_allowed=True)
    _check_number("tolerance", tolerance, zero_allowed=False)
    _check_number("terminal_tolerance", terminal_tolerance, zero_allowed=True)
    if (
        isinstance(max_iterations, bool)
        or not isinstance(max_iterations, (int, np.integer))
        or max_iterations < 1
    ):
        raise ValueError(f"max_iterations must be an integer >= 1, not {max_iterations!r}")
    if trust_region not in TRUST_REGIONS:
        raise ValueError(f"unknown trust_region {trust_region!r}; known: {list(TRUST_REGIONS)}")
    if linearization not in ("composite", "literal"):
        raise ValueError(
            f"unknown linearization {linearization!r}; known: ['composite', 'literal']"
        )
    model = model_of(problem)
    if guess is None:
        x, u = model.guess()
    elif isinstance(guess, Plan):
        x, u = checked_trajectory(model, guess.mean, guess.controls)
    else:
        if not isinstance(guess, (tuple, list)) or len(guess) != 2:
            raise ValueError(f"guess must be a Plan or a pair (states, controls), not {guess!r}")
        x, u = checked_trajectory(model, *guess)
    settings = Settings(
        variance_weight=float(variance_weight),
        tolerance=float(tolerance),
        max_iterations=int(max_iterations),
        composite=linearization == "composite",
        terminal_tolerance=float(terminal_tolerance),
        callback=callback,
    )
    backend = make_solver(solver) if isinstance(solver, str) else solver
    found = iterate(model, backend, TRUST_REGIONS[trust_region](), settings, x, u)
    at = found.at
    covariance = moments.covariance(at.A, at.sigma, model.dt)
    return Plan(
        status=found.status,
        times=model.times,
        mean=at.x,
        controls=at.u,
        covariance=covariance,
        effort=at.effort,
        obstacle_cost=at.penalty,
        variance=moments.trace_integral(covariance, model.dt),
        iterations=len(found.history),
        history=found.history,
        guess=x,
        multipliers=Multipliers.of(found.adjoint, found.terminal, found.trust_multiplier, at.A),
        A=at.A,
        B=at.B,
        gains=None,
        solve_time=time.perf_counter() - began,
        options={
            "variance_weight": float(variance_weight),
            "solver": solver if isinstance(solver, str) else type(solver).__name__,
            "tolerance": float(tolerance),
            "max_iterations": int(max_iterations),
            "trust_region": trust_region,
            "linearization": linearization,
            "terminal_tolerance": float(terminal_tolerance),
        },
        problem=problem,
        message=found.message,
    )


def _check_number(name: str, value: Any, *, zero_allowed: bool) -> None:
    allowed = "finite and >= 0" if zero_allowed else "finite and > 0"
    try:
        good = bool(np.isfinite(value) and (value >= 0 if zero_allowed else value > 0))
    except (TypeError, ValueError):  # no number, or an array of several
        good = False
    if not good:
        raise ValueError(f"{name} must be {allowed}, not {value!r}")


def _strip(arrays: dict[str, Array], prefix: str) -> dict[str, Array]:
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _history_from(arrays: dict[str, Array]) -> tuple[Iteration, ...]:
    columns = _strip(arrays, "history.")
    if not columns:
        return ()
    rows = len(next(iter(columns.values())))
    return tuple(
        Iteration(**{k: v[i] if v.ndim > 1 else v[i].item() for k, v in columns.items()})
        for i in range(rows)
    )


def _problem_to_data(problem: Problem | None) -> dict[str, str] | None:
    to_json = getattr(problem, "to_json", None)
    if to_json is None:
        return None
    cls = type(problem)
    for entry in entry_points(group="slipcar.problems"):
        if entry.value == f"{cls.__module__}:{cls.__qualname__}":
            return {"class": entry.name, "json": to_json()}
    return None


def _problem_from_data(data: dict[str, str] | None) -> Any:
    if data is None:
        return None
    for entry in entry_points(group="slipcar.problems"):
        if entry.name == data["class"]:
            return entry.load().from_json(data["json"])
    return None

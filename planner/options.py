"""The options of `plan` and `plan_batch`, checked at the boundary."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from slipcar.planner.convex.solvers import Solver
from slipcar.planner.convex.trust_region import TRUST_REGIONS
from slipcar.planner.history import Iteration
from slipcar.planner.problem.integrators import INTEGRATORS

METHODS = ("auto", "newton", "convex")


@dataclasses.dataclass(frozen=True)
class Options:
    """What an iteration is told; the fields are documented at `slipcar.planner.plan`."""

    variance_weight: float = 1.0
    solver: str | Solver = "structured"
    method: str = "auto"
    tolerance: float = 1e-3
    max_iterations: int = 100
    trust_region: str | None = None
    linearization: str = "composite"
    terminal_tolerance: float = 0.0
    integrator: str = "euler"
    compiled: bool | None = None
    callback: Callable[[Iteration], bool | None] | None = None

    def __post_init__(self) -> None:
        check_number("variance_weight", self.variance_weight, zero_allowed=True)
        check_number("tolerance", self.tolerance)
        check_number("terminal_tolerance", self.terminal_tolerance, zero_allowed=True)
        check_count("max_iterations", self.max_iterations)
        check_choice("method", self.method, METHODS)
        if self.trust_region is not None:
            check_choice("trust_region", self.trust_region, TRUST_REGIONS)
        check_choice("linearization", self.linearization, ("composite", "literal"))
        check_choice("integrator", self.integrator, INTEGRATORS)
        if self.compiled not in (None, True, False):
            raise ValueError(f"compiled must be None, True or False, not {self.compiled!r}")
        if self.compiled and self.callback is not None:
            raise ValueError("compiled=True leaves no room for a callback: leave compiled out")
        if self.callback is not None and not callable(self.callback):
            raise ValueError(f"callback must be a function of an Iteration, not {self.callback!r}")
        if not isinstance(self.solver, str) and not hasattr(self.solver, "solve"):
            raise ValueError(
                f"solver must be a name or an object with solve(subproblem), not {self.solver!r}"
            )
        convex = self.only_convex or ("method='convex'" if self.method == "convex" else "")
        if self.compiled and convex:
            raise ValueError(
                f"compiled=True is of Newton's method, which cannot be combined with {convex}: "
                f"leave compiled out"
            )
        if self.method == "newton" and self.only_convex:
            raise ValueError(
                f"method='newton' cannot be combined with {self.only_convex}: "
                f"method='convex' can (or leave method out)"
            )

    @property
    def only_convex(self) -> str:
        """The option that asks for exact convex sub-problems, in words; empty if none does."""
        if self.solver != "structured":
            return f"solver={self.solver!r}"
        if self.trust_region is not None:
            return f"trust_region={self.trust_region!r}"
        if self.linearization != "composite":
            return f"linearization={self.linearization!r}"
        if self.terminal_tolerance > 0.0:
            return f"terminal_tolerance={self.terminal_tolerance:g}"
        return ""

    def as_dict(self) -> dict[str, Any]:
        """Plain data, to be kept with a plan."""
        solver = self.solver if isinstance(self.solver, str) else type(self.solver).__name__
        return {
            "variance_weight": float(self.variance_weight),
            "solver": solver,
            "method": self.method,
            "tolerance": float(self.tolerance),
            "max_iterations": int(self.max_iterations),
            "trust_region": self.trust_region,
            "linearization": self.linearization,
            "terminal_tolerance": float(self.terminal_tolerance),
            "integrator": self.integrator,
            "compiled": self.compiled,
        }


def check_choice(name: str, value: Any, known: Iterable[str]) -> None:
    """Raise ValueError unless the value is one of the known ones."""
    if not isinstance(value, str) or value not in (known := list(known)):
        raise ValueError(f"unknown {name} {value!r}; known: {list(known)}")


def check_number(name: str, value: Any, *, zero_allowed: bool = False) -> None:
    """Raise ValueError unless the value is a finite number > 0 (or ≥ 0)."""
    allowed = "finite and >= 0" if zero_allowed else "finite and > 0"
    try:
        good = bool(np.isfinite(value) and (value >= 0 if zero_allowed else value > 0))
    except (TypeError, ValueError):  # no number, or an array of several
        good = False
    if not good:
        raise ValueError(f"{name} must be {allowed}, not {value!r}")


def check_count(name: str, value: Any, *, least: int = 1) -> None:
    """Raise ValueError unless the value is an integer ≥ `least`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise ValueError(f"{name} must be an integer >= {least}, not {value!r}")

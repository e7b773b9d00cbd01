"""The options of `plan` and `plan_batch`, checked at the boundary."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection
from typing import Any, Literal, TypedDict, get_args

import numpy as np

from slipcar.planner.convex.solvers.interface import Solver
from slipcar.planner.records import Iteration

#: What options may be, for type checkers and for the checks below.
Method = Literal["auto", "newton", "convex"]
RiskAt = Literal["nodes", "path"]
Backend = Literal["structured", "osqp", "cvxpy"]
TrustRegionName = Literal["adaptive", "paper", "none"]
Linearization = Literal["composite", "literal"]
IntegratorName = Literal["euler", "rk4"]
ColdStart = Literal["auto", "always", "never"]


@dataclasses.dataclass(frozen=True)
class Options:
    """How an iteration runs.

    Attributes:
        variance_weight: w ≥ 0 of w ∫ tr Σ dt; 0 is deterministic SCP. In `plan`, None is 1, or 0
            with one of `risk`, `risk_price`, `feedback` and `expected`, whose cost counts the
            noise already. Without them, w > 0 asks for a diffusion that depends on no uncertain
            state.
        solver: of the convex method: `"structured"`, `"osqp"` or `"cvxpy"`, or an object with
            their interface; see :mod:`slipcar.planner.convex.solvers`.
        method: `"newton"`: one LQ problem per iteration and Newton's method at the end, quadratic
            (:mod:`slipcar.planner.newton`); `"convex"`: the paper's scheme, exact convex
            sub-problems. `"auto"` takes the first unless an option or the problem asks for the
            second: another solver, a trust region, the literal linearisation, a terminal box, a
            ball of controls. Where the first does not converge, the second goes on.
        tolerance: stop when the square of the maximum principle's relative residual falls to it,
            > 0: of how far u is from argmax_U H beside the controls' own size, in the norm of R.
            The dynamics then hold to 5e-5 and the terminal condition to 1e-6 of how far the states
            in them move, and to less in proportion for tolerances below the default. No units
            matter; :mod:`slipcar.planner.extremal.certificate` measures the same.
        max_iterations: at most so many sub-problems from each guess, ≥ 1; of those beyond 60
            half are kept for a second run and for the convex method, should the first not converge.
        trust_region: of the convex method: `"adaptive"` (None is), `"paper"` (Δ₀ = 100, × 0.99)
            or `"none"`.
        linearization: `"composite"` keeps max(0, ·)² and linearises its argument; `"literal"`
            linearises the obstacle cost whole, as the paper writes it.
        terminal_tolerance: half-width of a box round E g = 0; 0 asks for equality.
        integrator: of the mean: `"euler"` (the paper's) or `"rk4"`; controls are constant on each
            interval either way. In `plan`, None is `"euler"`, with `risk_at="path"` `"rk4"`.
            See :mod:`slipcar.planner.problem.integrators`.
        compiled: run Newton's method as machine code. None: where llvmlite is installed; False
            never compiles, the same steps in NumPy; True insists, and refuses functions that
            cannot be traced.
        callback: called with each :class:`Iteration`, from whichever guess and at whichever
            horizon; returning True stops that guess (all others begin nonetheless) and any search
            of a final time.

    Raises:
        ValueError: for a value out of range, naming it.
    """

    variance_weight: float = 1.0
    solver: Backend | Solver = "structured"
    method: Method = "auto"
    tolerance: float = 1e-4
    max_iterations: int = 200
    trust_region: TrustRegionName | None = None
    linearization: Linearization = "composite"
    terminal_tolerance: float = 0.0
    integrator: IntegratorName = "euler"
    compiled: bool | None = None
    callback: Callable[[Iteration], bool | None] | None = None

    def __post_init__(self) -> None:
        check_number("variance_weight", self.variance_weight, zero_allowed=True)
        check_number("tolerance", self.tolerance)
        check_number("terminal_tolerance", self.terminal_tolerance, zero_allowed=True)
        check_count("max_iterations", self.max_iterations)
        check_choice("method", self.method, get_args(Method))
        if self.trust_region is not None:
            check_choice("trust_region", self.trust_region, get_args(TrustRegionName))
        check_choice("linearization", self.linearization, get_args(Linearization))
        check_choice("integrator", self.integrator, get_args(IntegratorName))
        check_flag("compiled", self.compiled, none_allowed=True)
        if self.callback is not None and not callable(self.callback):
            raise ValueError(f"callback must be a function of an Iteration, not {self.callback!r}")
        if not isinstance(self.solver, str) and not hasattr(self.solver, "solve"):
            raise ValueError(
                f"solver must be a name or an object with solve(subproblem), not {self.solver!r}"
            )
        if self.compiled and self.convex:
            raise ValueError(
                f"compiled=True is of Newton's method, which cannot be combined with "
                f"{self.convex}: leave compiled out"
            )
        if self.method == "newton" and self.convex:
            raise ValueError(
                f"method='newton' cannot be combined with {self.convex}: "
                f"method='convex' can (or leave method out)"
            )

    def with_iterations(self, limit: int) -> Options:
        """The same with at most so many iterations; nothing is checked again."""
        copy = object.__new__(Options)
        vars(copy).update(vars(self), max_iterations=limit)
        return copy

    @property
    def convex(self) -> str:
        """The option that asks for exact convex sub-problems, in words; empty if none does."""
        if self.solver != "structured":
            return f"solver={self.solver!r}"
        if self.trust_region is not None:
            return f"trust_region={self.trust_region!r}"
        if self.linearization != "composite":
            return f"linearization={self.linearization!r}"
        if self.terminal_tolerance > 0.0:
            return f"terminal_tolerance={self.terminal_tolerance:g}"
        return "method='convex'" if self.method == "convex" else ""

    def as_dict(self) -> dict[str, Any]:
        """Plain data, to be kept with a plan."""
        data = {name: value for name, value in vars(self).items() if name != "callback"}
        for name in ("variance_weight", "tolerance", "terminal_tolerance"):
            data[name] = float(data[name])
        if not isinstance(self.solver, str):
            data["solver"] = type(self.solver).__name__
        return data | {"max_iterations": int(self.max_iterations)}


@dataclasses.dataclass(frozen=True)
class Guesses:
    """Where iterations begin, and which horizons they try.

    Attributes:
        starts: guesses to try, ≥ 1: the problem's own (with and without its penalties at first) and
            others round the obstacles; the best plan is returned and `alternatives` says what
            became of each. None is 1, or 6 for an expected cost: the way round the obstacles that
            is cheapest for the mean may be the riskiest.
        guess: where to start: a plan (resampled if its time grid is another), or states (N, n)
            and controls (N−1, m); None takes the problem's own.
        cold_start: when the problem's own guess is tried beside `guess` and the better plan
            returned: `"auto"` unless `guess` is a converged plan that fits the problem at least
            as well and leads to a converged one, `"always"` or `"never"`. A converged plan is a
            local optimum, as a rule in its guess's homotopy class; only a comparison tells
            whether the problem's own guess leads to a better one. `message` says which was taken.
        free_first: leave the penalties out until the first steps have settled, so that the path
            that would be best without obstacles decides which way round them, not the guess.
            None: from the problem's own guess, unless an option asks for the convex method.
        shooting: once an iterate of the convex method is near an extremal, solve the maximum
            principle itself by Newton's method, to 1e-12 (paper §3.3); SCP goes on where that
            fails. `shot` says what became of it.
        free_final_time: choose the horizon too: minimise cost + time_weight · T over a uniform
            dilation of the time grid (paper §5); `final_time` and `time_search` say what came out.
        time_weight: cost of a second of final time, > 0.
        final_time_bounds: least and largest final time [s], counted from the first node; None is
            1/10 and 10 times the problem's.
        check_derivatives: compare every Jacobian with differences before planning.

    Raises:
        ValueError: for a value out of range, naming it.
    """

    starts: int | None = None
    guess: Any = None
    cold_start: ColdStart = "auto"
    free_first: bool | None = None
    shooting: bool = False
    free_final_time: bool = False
    time_weight: float = 1.0
    final_time_bounds: tuple[float, float] | None = None
    check_derivatives: bool = False

    def __post_init__(self) -> None:
        if self.starts is not None:
            check_count("starts", self.starts)
        check_choice("cold_start", self.cold_start, get_args(ColdStart))
        check_flag("free_first", self.free_first, none_allowed=True)
        for name in ("shooting", "free_final_time", "check_derivatives"):
            check_flag(name, getattr(self, name))
        if (self.starts or 1) > 1 and self.guess is not None:
            raise ValueError(
                "starts > 1 and guess exclude each other: starts makes its own guesses"
            )
        if self.free_final_time:
            check_number("time_weight", self.time_weight)


class BatchOptions(TypedDict, total=False):
    """Options of `plan_batch`, as a type checker sees them; those of :class:`Options` and one of
    :class:`Guesses`.
    """

    variance_weight: float
    solver: Backend | Solver
    method: Method
    tolerance: float
    max_iterations: int
    trust_region: TrustRegionName | None
    linearization: Linearization
    terminal_tolerance: float
    integrator: IntegratorName
    compiled: bool | None
    free_first: bool | None


def plain(value: Any) -> Any:
    """A NumPy scalar as Python's number or truth value, which every file can hold; others as is."""
    return value.item() if isinstance(value, np.generic) else value


def check_choice(name: str, value: Any, known: Collection[str]) -> None:
    """Raise ValueError unless the value is one of the known ones."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"unknown {name} {value!r}; known: {list(known)}")


def check_flag(name: str, value: Any, *, none_allowed: bool = False) -> None:
    """Raise ValueError unless the value is a truth value (or None)."""
    if value is None and none_allowed:
        return
    if not isinstance(value, (bool, np.bool_, int)) or value not in (0, 1):
        known = "None, True or False" if none_allowed else "True or False"
        raise ValueError(f"{name} must be {known}, not {value!r}")


def check_number(name: str, value: Any, *, zero_allowed: bool = False) -> None:
    """Raise ValueError unless the value is a finite number > 0 (or ≥ 0)."""
    allowed = "finite and >= 0" if zero_allowed else "finite and > 0"
    try:
        good = math.isfinite(value) and bool(value >= 0 if zero_allowed else value > 0)
    except (TypeError, ValueError, OverflowError):  # no number, or an array of several
        good = False
    if not good:
        raise ValueError(f"{name} must be {allowed}, not {value!r}")


def check_count(name: str, value: Any, *, least: int = 1) -> None:
    """Raise ValueError unless the value is an integer ≥ `least`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise ValueError(f"{name} must be an integer >= {least}, not {value!r}")

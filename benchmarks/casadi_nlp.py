"""The whole deterministic problem as one non-linear programme in CasADi: the peers to beat.

Built once, solved from the scenario's own guess; exact Jacobians and Hessians by CasADi. IPOPT
with MUMPS treats it as any sparse programme; fatrop sees the stages (`structure_detection`
"auto", for which variables and constraints must come stage by stage, dynamics first) and solves
the Newton systems by a Riccati recursion.

Both are given CasADi's `expand`, which turns the graph of matrices into one of scalars: the
times of a graph left as it is are several times longer (one row shows them).
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from casadi_car import bounds, stacked, stage_cost, step, unstacked, variables
from contenders import Answer, Contender, UnavailableError, stopwatch

from slipcar.envs import Scenario

#: `tol` of both solvers.
TOLERANCE = 1e-6

QUIET: dict[str, dict[str, Any]] = {
    "ipopt": {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"},
    "fatrop": {"print_time": False, "fatrop.print_level": 0},
}


class WholeNlp:
    """Whole-problem programme of one scenario.

    Args:
        scenario: what to plan for.
        solver: `"ipopt"` or `"fatrop"`.
        tolerance: the solver's `tol`.
        expand: let CasADi expand the graph into scalar operations.
        compiled: translate the derivatives to C and compile them; needs gcc.
        terminal_box: half-width of a box round the goal; 0 asks for equality.
    """

    def __init__(
        self,
        scenario: Scenario,
        solver: str = "ipopt",
        *,
        tolerance: float = TOLERANCE,
        expand: bool = True,
        compiled: bool = False,
        terminal_box: float = 0.0,
    ) -> None:
        began = time.perf_counter()
        N = scenario.nodes
        advance, price = step(scenario), stage_cost(scenario)
        xs, us, everything = variables(ca.MX, N)
        constraints: list[Any] = []
        for k in range(N - 1):
            constraints.append(xs[k + 1] - advance(xs[k], us[k]))
            if k == 0:
                constraints.append(xs[0] - scenario.start)
        constraints.append(xs[-1] - scenario.goal)
        nlp = {
            "x": everything,
            "f": sum(price(us[k], xs[k + 1]) for k in range(N - 1)),
            "g": ca.vertcat(*constraints),
        }
        slack = np.zeros(nlp["g"].numel())
        slack[-scenario.goal.size :] = terminal_box
        options: dict[str, Any] = {**QUIET[solver], f"{solver}.tol": tolerance, "expand": expand}
        if solver == "fatrop":
            options |= {"structure_detection": "auto", "equality": (slack == 0.0).tolist()}
        self._solver = (_compile if compiled else ca.nlpsol)("plan", solver, nlp, options)
        bound = bounds(scenario)
        self._limits = {"lbx": -bound, "ubx": bound, "lbg": -slack, "ubg": slack}
        self._guess = stacked(*scenario.initial_guess())
        self.build_seconds = time.perf_counter() - began

    def solve(self, guess: tuple[np.ndarray, np.ndarray] | None = None) -> dict[str, Any]:
        """CasADi's own dictionary of results, from states and controls or the scenario's guess."""
        x0 = self._guess if guess is None else stacked(*guess)
        return self._solver(x0=x0, **self._limits)

    def answer(self, found: dict[str, Any]) -> Answer:
        """What `solve` returned, as an answer."""
        stats = self._solver.stats()
        return Answer(unstacked(found["x"])[1], int(stats["iter_count"]), bool(stats["success"]))


def ipopt(scenario: Scenario, **options: Any) -> Contender:
    """IPOPT on the whole problem."""
    return _contender("CasADi + IPOPT", WholeNlp(scenario, "ipopt", **options), options)


def fatrop(scenario: Scenario, **options: Any) -> Contender:
    """Fatrop on the whole problem."""
    return _contender("CasADi + fatrop", WholeNlp(scenario, "fatrop", **options), options)


def makers(scenario: Scenario) -> dict[str, Callable[[], Contender]]:
    """All of them on one scenario, by name."""
    return {
        "CasADi + fatrop": lambda: fatrop(scenario),
        "CasADi + fatrop, compiled": lambda: fatrop(scenario, compiled=True),
        "CasADi + IPOPT": lambda: ipopt(scenario),
        "CasADi + IPOPT, not expanded": lambda: ipopt(scenario, expand=False),
    }


def _contender(name: str, nlp: WholeNlp, options: dict[str, Any]) -> Contender:
    if options.get("compiled"):
        name += ", derivatives compiled"
    if not options.get("expand", True):
        name += ", graph not expanded"
    return Contender(
        name=name,
        tolerance=f"KKT {options.get('tolerance', TOLERANCE):.0e}",
        solve=stopwatch(nlp.solve, nlp.answer),
        build_seconds=nlp.build_seconds,
    )


def _compile(name: str, solver: str, nlp: dict[str, Any], options: dict[str, Any]) -> ca.Function:
    if shutil.which("gcc") is None:
        raise UnavailableError("needs gcc, which is not installed")
    # CasADi writes C and libraries into the working directory. The library is open by then, so
    # the folder can go; CasADi's own tidying would look for the files where we are later.
    jit: dict[str, Any] = {"jit": True, "compiler": "shell", "jit_cleanup": False}
    jit["jit_options"] = {"flags": ["-O2"], "cleanup": False}
    with tempfile.TemporaryDirectory(prefix="slipcar-bench-") as folder, contextlib.chdir(folder):
        return ca.nlpsol(name, solver, nlp, {**options, **jit})

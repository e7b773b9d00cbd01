"""From models to the compiled iteration and back: arrays in, arrays out, problems in parallel."""

from __future__ import annotations

import dataclasses
import itertools
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from slipcar.planner.history import Columns, Iteration
from slipcar.planner.newton import compiled
from slipcar.planner.newton.caching import prepare
from slipcar.planner.newton.functions import Functions
from slipcar.planner.newton.settings import TUNING
from slipcar.planner.newton.traced import Kernels
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.feasibility import not_finite
from slipcar.planner.problem.linearization import linearize
from slipcar.planner.problem.model import Model
from slipcar.planner.status import Status

Array = np.ndarray

#: Whether the compiled code is loaded.
_prepared = False
STATUS = {
    compiled.CONVERGED: Status.CONVERGED,
    compiled.MAX_ITERATIONS: Status.MAX_ITERATIONS,
    compiled.STALLED: Status.STALLED,
    compiled.NO_STEP: Status.SOLVER_FAILED,
    compiled.NOT_FINITE: Status.SOLVER_FAILED,
}


@dataclasses.dataclass(frozen=True)
class Answers:
    """What the compiled iteration found, problem by problem (first axis).

    Attributes:
        x: (P, N, n).
        u: (P, K, m).
        adjoint: λ_1..λ_K, (P, K, n).
        terminal: ν, (P, q).
        A: (P, K, n, n).
        B: (P, K, n, m).
        covariance: (P, N, n, n).
        costs: effort, penalty, running, w ∫ tr Σ dt, (P, 4).
        table: `compiled.COLUMNS` of each step tried, (P, max_iterations, columns).
        steps: trajectories x, u and multipliers ν of the steps tried, (P, kept, ...).
        ended: `compiled`'s status and steps tried, (P, 2).
        seconds: wall-clock time of all.
    """

    x: Array
    u: Array
    adjoint: Array
    terminal: Array
    A: Array
    B: Array
    covariance: Array
    costs: Array
    table: Array
    steps: tuple[Array, Array, Array]
    ended: Array
    seconds: float

    def status(self, i: int) -> Status:
        """How problem i ended."""
        return STATUS[int(self.ended[i, 0])]

    def finite(self, i: int) -> bool:
        """Whether the functions of problem i are finite along its guess."""
        return int(self.ended[i, 0]) != compiled.NOT_FINITE

    def outcome(self, i: int, variance_weight: float, seconds: float) -> Outcome:
        """What became of problem i, which took so many seconds."""
        effort, penalty, running, variance = self.costs[i].tolist()
        return Outcome(
            status=self.status(i),
            x=self.x[i],
            u=self.u[i],
            A=self.A[i],
            B=self.B[i],
            covariance=self.covariance[i],
            effort=effort,
            penalty=penalty,
            running=running,
            adjoint=self.adjoint[i],
            terminal=self.terminal[i],
            trust_multiplier=0.0,
            iterations=int(self.ended[i, 1]),
            history=self.history(i, variance_weight, seconds),
            objective=effort + penalty + running + variance,
        )

    def history(self, i: int, variance_weight: float, seconds: float) -> Sequence[Iteration]:
        """The steps tried for problem i; its `seconds` are shared out by processor cycles."""
        tried = int(self.ended[i, 1])
        if self.steps[0].shape[1] == 0:
            return ()
        kept = min(tried, self.steps[0].shape[1])
        return Columns(lambda: self._columns(i, kept, variance_weight, seconds), kept)

    def _columns(
        self, i: int, kept: int, variance_weight: float, seconds: float
    ) -> dict[str, Array]:
        """The fields of the first steps of problem i."""
        table = self.table[i, :kept]
        column = {name: table[:, j] for j, name in enumerate(compiled.COLUMNS)}
        weight = variance_weight if variance_weight > 0.0 else np.nan
        began, solved = column["linearized"], column["solved"]
        ends = np.append(began[1:], solved[-1:])
        per_tick = seconds / ends[-1] if kept and ends[-1] > 0 else 0.0
        started = np.append(0.0, solved[:-1])
        x, u, nu = (array[i, :kept] for array in self.steps)
        return {
            "mean": x,
            "controls": u,
            "effort": column["effort"],
            "penalty": column["penalty"],
            "running": column["running"],
            "variance": column["variance"] / weight,
            "merit": column["merit"],
            "predicted": column["predicted"],
            "actual": column["actual"],
            "step": column["step"],
            "trust_radius": column["radius"],
            "trust_multiplier": column["shift"],
            "virtual_control": np.zeros(kept),
            "defect": column["defect"],
            "terminal_residual": column["terminal_residual"],
            "terminal_multiplier": nu,
            "accepted": column["accepted"] > 0.0,
            "solver_iterations": column["solves"].astype(np.int64),
            "linearize_seconds": per_tick * (began - started),
            "solve_seconds": per_tick * (solved - began),
        }


def solve_one(
    model: Model, functions: Functions, options: Options, x: Array, u: Array, *, free_first: bool
) -> Outcome:
    """`loop.iterate`, compiled; options without a callback.

    Raises:
        ValueError: if a function of the problem is not finite along the guess.
    """
    assert functions.kernels is not None
    found = run(
        functions.kernels,
        [model],
        functions.parameters[None],
        x[None],
        u[None],
        variance_weight=options.variance_weight,
        tolerance=options.tolerance,
        max_iterations=options.max_iterations,
        keep=options.max_iterations,
        free_first=free_first,
    )
    if not found.finite(0):
        raise ValueError(not_finite(linearize(model, x, u)) + " is not finite along the guess")
    return found.outcome(0, options.variance_weight, found.seconds)


def run(
    kernels: Kernels,
    models: Sequence[Model],
    parameters: Array,
    x: Array,
    u: Array,
    *,
    variance_weight: float,
    tolerance: float,
    max_iterations: int,
    keep: int,
    free_first: bool | Array,
    workers: int = 1,
) -> Answers:
    """Solve problems of one kind and one grid size.

    Args:
        kernels: compiled functions of the kind.
        models: one for each problem, or one for all.
        parameters: of each problem, (P, ·).
        x: guesses, (P, N, n).
        u: (P, K, m).
        variance_weight: w ≥ 0.
        tolerance: of the steps.
        max_iterations: at most so many steps.
        free_first: whether to leave the hinges out at first, for all or for each, (P,).
        keep: how many steps' trajectories to keep.
        workers: threads; 0 takes one for each processor.
    """
    (P, N, n), (K, m) = x.shape, u.shape[1:]
    q = kernels.terminal.outputs["g"]
    d = kernels.stage.outputs["sigma"] // n

    def copied(values: Any) -> Array:
        """Contiguous, because kernels are handed addresses; writable: numba sees one type."""
        return np.array(values, dtype=np.float64, order="C")

    def stacked(name: str) -> Array:
        """A field of the models, one row for each problem."""
        if len(models) == 1:
            value = getattr(models[0], name)
            return copied(value[None] if P == 1 else np.broadcast_to(value, (P, *value.shape)))
        return copied([getattr(model, name) for model in models])

    answers = Answers(
        x=np.empty((P, N, n)),
        u=np.empty((P, K, m)),
        adjoint=np.empty((P, K, n)),
        terminal=np.empty((P, q)),
        A=np.empty((P, K, n, n)),
        B=np.empty((P, K, n, m)),
        covariance=np.zeros((P, N, n, n)),
        costs=np.empty((P, 4)),
        table=np.empty((P, max_iterations, len(compiled.COLUMNS))),
        steps=(np.empty((P, keep, N, n)), np.empty((P, keep, K, m)), np.empty((P, keep, q))),
        ended=np.empty((P, 2), dtype=np.int64),
        seconds=0.0,
    )
    per_problem = [
        copied(parameters),
        *(stacked(name) for name in ("times", "R", "lower", "upper", "weight")),
    ]
    answers.covariance[:, 0] = stacked("start_covariance")
    guesses = [copied(x), copied(u)]
    found = [
        answers.x, answers.u, answers.adjoint, answers.terminal, answers.A, answers.B,
        answers.covariance, answers.costs, answers.table, *answers.steps, answers.ended,
    ]  # fmt: skip
    fixed = (float(variance_weight), float(tolerance), int(max_iterations), TUNING)
    first = np.full(P, free_first, dtype=np.bool_)

    def part(where: slice) -> None:
        compiled.solve_many(
            kernels.addresses,
            *(array[where] for array in per_problem),
            *fixed,
            first[where],
            d,
            *(array[where] for array in (*guesses, *found)),
        )

    global _prepared
    if not _prepared:
        prepare(compiled.solve_many, lambda: part(slice(0, 0)))
        _prepared = True
    began = time.perf_counter()
    workers = min(workers or os.cpu_count() or 1, P)
    if workers == 1:
        part(slice(None))
    else:
        # Several pieces for each thread: problems differ in how long they take.
        edges = np.linspace(0, P, min(P, 8 * workers) + 1).astype(int)
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(part, [slice(a, b) for a, b in itertools.pairwise(edges)]))
    return dataclasses.replace(answers, seconds=time.perf_counter() - began)

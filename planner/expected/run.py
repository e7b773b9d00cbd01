"""From models to the compiled iteration and back: arrays in, arrays out, problems in parallel."""

from __future__ import annotations

import dataclasses
import itertools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from slipcar.planner.expected import compiled
from slipcar.planner.expected.loop import Steered
from slipcar.planner.expected.settings import TUNING, Tuning
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.caching import prepare
from slipcar.planner.newton.compiled import CONVERGED, NOT_FINITE
from slipcar.planner.newton.functions import Functions
from slipcar.planner.newton.run import STATUS
from slipcar.planner.newton.traced import Kernels
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: Whether the compiled code is loaded.
_prepared = False


@dataclasses.dataclass(eq=False)
class Batch:
    """Problems on their way, the first axis counts them; written in place by :func:`advance`.

    Attributes:
        x: means, (P, N, n).
        u: (P, K, m).
        gains: (P, K, m, n).
        held: (P, K, p).
        adjoint: (P, K, n).
        terminal: (P, q).
        A: (P, K, n, n).
        B: (P, K, n, m).
        covariance: (P, N, n, n); the first of each is that of its start, zero in new problems.
        c: expectations, (P, K, p).
        s: (P, K, p).
        values: effort, running cost, objective, (P, 3).
        ended: how, and steps tried, (P, 2).
    """

    x: Array
    u: Array
    gains: Array
    held: Array
    adjoint: Array
    terminal: Array
    A: Array
    B: Array
    covariance: Array
    c: Array
    s: Array
    values: Array
    ended: Array

    @classmethod
    def of(cls, x: Array, u: Array, p: int, q: int) -> Batch:
        """New problems from guesses x (P, N, n), u (P, K, m) with p rows, q terminal conditions."""
        (P, N, n), (K, m) = x.shape, u.shape[1:]
        return cls(
            x=np.array(x, dtype=np.float64, order="C"),
            u=np.array(u, dtype=np.float64, order="C"),
            gains=np.zeros((P, K, m, n)),
            held=np.zeros((P, K, p)),
            adjoint=np.zeros((P, K, n)),
            terminal=np.zeros((P, q)),
            A=np.empty((P, K, n, n)),
            B=np.empty((P, K, n, m)),
            covariance=np.zeros((P, N, n, n)),
            c=np.empty((P, K, p)),
            s=np.empty((P, K, p)),
            values=np.empty((P, 3)),
            ended=np.empty((P, 2), dtype=np.int64),
        )

    def ok(self) -> Array:
        """Which have converged, (P,)."""
        return self.ended[:, 0] == CONVERGED


def advance(
    kernels: Kernels,
    model: Model,
    parameters: Array,
    stakes: Stakes,
    batch: Batch,
    *,
    times: Array | None = None,
    tolerance: float,
    max_iterations: int,
    warm: bool,
    workers: int = 1,
    tuning: Tuning = TUNING,
) -> Batch:
    """Iterate on problems of one model that differ in start and guess; `batch` is written to.

    Args:
        kernels: compiled functions of the model's problem.
        model: for bounds and weights.
        parameters: one row.
        stakes: what is charged.
        batch: where each begins; x[:, 0] are the starts.
        times: the node times, if they are not all the model's, (N,).
        tolerance: of the steps.
        max_iterations: at most so many steps.
        warm: whether gains, weights and multipliers of the batch are to be used.
        workers: threads; 0 takes one for each processor.
        tuning: of the iteration.
    """
    P = len(batch.x)
    grid = model.times if times is None else times
    d = kernels.stage.outputs["sigma"] // batch.x.shape[2]

    def shared(value: Any) -> Array:
        # Copied, because numba takes an array with a stride of zero for one of another type.
        row = np.asarray(value, dtype=np.float64)
        return np.array(np.broadcast_to(row, (P, *row.shape)), order="C")

    same = [shared(v) for v in (parameters, grid, model.R, model.lower, model.upper, stakes.weight)]
    tail = np.array(stakes.tail, dtype=np.bool_)
    W = shared(stakes.terminal)
    fixed = (
        bool(stakes.soft),
        bool(stakes.feedback),
        float(stakes.variance_weight),
        float(stakes.saturation),
        float(stakes.damping),
        float(tolerance),
        int(max_iterations),
        tuning,
        bool(warm),
        int(d),
    )
    own = [getattr(batch, field.name) for field in dataclasses.fields(batch)]

    def part(where: slice) -> None:
        compiled.solve_many(
            kernels.addresses,
            *(array[where] for array in same),
            tail,
            W[where],
            *fixed,
            *(array[where] for array in own),
        )

    global _prepared
    if not _prepared:
        prepare(compiled.solve_many, lambda: part(slice(0, 0)))
        _prepared = True
    workers = min(workers or os.cpu_count() or 1, P)
    if workers <= 1:
        part(slice(None))
    else:
        edges = np.linspace(0, P, min(P, 8 * workers) + 1).astype(int)
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(part, [slice(a, b) for a, b in itertools.pairwise(edges)]))
    return batch


def iterate(
    model: Model,
    functions: Functions,
    stakes: Stakes,
    x: Array,
    u: Array,
    *,
    tolerance: float,
    max_iterations: int,
    warm: Steered | None = None,
    tuning: Tuning = TUNING,
) -> Steered:
    """`loop.iterate`, compiled.

    Raises:
        ValueError: if the model functions are not finite along the guess.
    """
    assert functions.kernels is not None
    q = functions.kernels.terminal.outputs["g"]
    batch = Batch.of(x[None], u[None], len(stakes.weight), q)
    batch.covariance[0, 0] = model.start_covariance
    if warm is not None:
        batch.gains[0], batch.held[0] = warm.gains, warm.held
        batch.adjoint[0], batch.terminal[0] = warm.adjoint, warm.terminal
    advance(
        functions.kernels, model, functions.parameters, stakes, batch, tolerance=tolerance,
        max_iterations=max_iterations, warm=warm is not None, tuning=tuning,
    )  # fmt: skip
    if batch.ended[0, 0] == NOT_FINITE:
        raise ValueError("the problem's functions are not finite along the guess")
    return steered(batch, 0)


def steered(batch: Batch, i: int) -> Steered:
    """Problem i of a batch."""
    effort, running, objective = batch.values[i].tolist()
    return Steered(
        status=STATUS[int(batch.ended[i, 0])],
        x=batch.x[i],
        u=batch.u[i],
        gains=batch.gains[i],
        covariance=batch.covariance[i],
        held=batch.held[i],
        c=batch.c[i],
        s=batch.s[i],
        A=batch.A[i],
        B=batch.B[i],
        adjoint=batch.adjoint[i],
        terminal=batch.terminal[i],
        effort=effort,
        running=running,
        objective=objective,
        iterations=int(batch.ended[i, 1]),
    )

"""Posed problems into workspaces and back: what goes in, what comes out of the iteration."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from slipcar.planner.moments.losses import floored
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.equations import Form
from slipcar.planner.newton.loop import Ending, StepTaken, Task, iterate
from slipcar.planner.newton.posing import Posed
from slipcar.planner.newton.program import Workspace, borrow, give_back
from slipcar.planner.newton.tuning import MEAN, NOISE, Tuning
from slipcar.planner.options import Options
from slipcar.planner.outcome import Outcome
from slipcar.planner.problem.feasibility import not_finite
from slipcar.planner.problem.model import Model
from slipcar.planner.records import Columns, Iteration
from slipcar.planner.status import Status

Array = np.ndarray

#: Arrays that every run begins with at zero.
_CLEARED = (
    "d", "e", "held", "P", "Sigma", "H_psd", "lam", "lam_new", "nu", "nu_new", "reach", "price",
    "priced", "law",
)  # fmt: skip
_CLEARED_NOISY = ("gains", "eta", "offset", "s")
#: The equations of plans of the mean.
_MEAN = Form()


def load(workspace: Workspace, posed: Posed, weight: Array, x: Array, u: Array) -> None:
    """A problem's numbers and a guess, x (N, n) and u (K, m), into a workspace.

    Args:
        workspace: of the problem's program.
        posed: the problem.
        weight: of its rows, (p,).
        x: states.
        u: controls.
    """
    arrays, model, K = workspace.arrays, posed.model, workspace.K
    arrays["number"][0] = posed.numbers
    arrays["R"][0] = model.R.ravel()
    arrays["weight"][0] = weight
    arrays["t"][:, 0] = model.times
    arrays["dt"][:K, 0] = model.dt
    arrays["dn"][1:, 0] = model.dt
    dims = workspace.program.dims
    arrays["late"][:] = 0.0
    arrays["late"][max(K - 2 * -(-dims.q // dims.m) - 2, 0) :] = 1.0
    arrays["lower"][:], arrays["upper"][:] = model.lower, model.upper
    for name in _CLEARED:
        arrays[name].fill(0.0)
    arrays["Sigma"][0] = model.start_covariance.ravel()
    arrays["x"][:], arrays["u"][:K] = x, u
    if workspace.program.form.noisy:
        for name in _CLEARED_NOISY:
            arrays[name].fill(0.0)
        arrays["box_lower"][0], arrays["box_upper"][0] = model.lower, model.upper


# ------------------------------------------------------------------------------ plans of the mean


def solve_mean(
    posed: Posed,
    options: Options,
    x: Array,
    u: Array,
    *,
    free_first: bool,
    tuning: Tuning = MEAN,
    history: bool = True,
) -> Outcome:
    """A plan of the mean from the guess x (N, n), u (K, m).

    Args:
        posed: the problem.
        options: of the iteration.
        x: states.
        u: controls.
        free_first: leave the penalties out at first.
        tuning: numbers of the method.
        history: keep every step.

    Raises:
        ValueError: if a function of the problem is not finite along the guess.
    """
    model, w = posed.model, float(options.variance_weight)
    workspace = borrow(posed.program(_MEAN), len(model.dt))
    load(workspace, posed, model.weight, x, u)
    task = Task(
        tolerance=options.tolerance * model.coupling**2, max_iterations=options.max_iterations,
        bounded=model.bounded, state_cost=model.has("state_cost"),
        released=free_first and len(model.weight) > 0,
        variance_weight=w,
    )  # fmt: skip
    steps = _Steps(workspace, options.callback) if history or options.callback else None
    ending = iterate(workspace, task, tuning, posed.filler, None if steps is None else steps.watch)
    if ending.status is None:
        raise ValueError(not_finite(model, x, u))
    outcome = _outcome(workspace, model, ending, w, steps.columns() if steps else ())
    give_back(workspace)
    return outcome


def _outcome(
    workspace: Workspace, model: Model, ending: Ending, w: float, history: Sequence[Iteration]
) -> Outcome:
    side, at, K = ending.side, ending.at, workspace.K
    assert ending.status is not None
    workspace.kernels["spread"][side]()
    S = workspace.at(side, "Sigma").copy()
    objective = at.effort + at.penalty + at.running
    if w > 0.0:
        objective += w * float(np.einsum("k,kii", model.dt, S[1:]))
    return Outcome(
        status=ending.status,
        x=workspace.at(side, "x").copy(),
        u=workspace.at(side, "u")[:K].copy(),
        A=workspace.at(side, "A")[:K].copy(),
        B=workspace.at(side, "B")[:K].copy(),
        covariance=S,
        effort=at.effort,
        penalty=at.penalty,
        running=at.running,
        adjoint=(workspace.arrays["costate"] if ending.status.ok else workspace.at(side, "lam"))[
            1:
        ].copy(),
        terminal=workspace.at(side, "nu")[0].copy(),
        trust_multiplier=0.0,
        iterations=ending.tried,
        history=history,
        objective=objective,
        answered=ending.answered,
    )


class _Steps:
    """Keeps every step that an iteration tries, and tells a callback of it."""

    def __init__(
        self, workspace: Workspace, callback: Callable[[Iteration], bool | None] | None
    ) -> None:
        self._workspace, self._callback = workspace, callback
        self._rows: list[StepTaken] = []
        self._points: list[Array] = []
        self._reported: list[Iteration] = []

    def watch(self, row: StepTaken, side: int) -> bool:
        """Keep a step whose trajectory is on a side of the workspace; True stops."""
        self._rows.append(row)
        self._points.append(self._workspace.trajectories[side].copy())
        if self._callback is None:
            return False
        x, u, nu = self._workspace.trajectory(self._points[-1])
        step = Iteration(
            mean=x, controls=u, terminal_multiplier=nu, virtual_control=0.0, **row.numbers()
        )
        self._reported.append(step)
        return bool(self._callback(step))

    def columns(self) -> Sequence[Iteration]:
        """The steps, put together when they are first looked at."""
        if self._reported:
            return tuple(self._reported)
        rows, points, split = self._rows, self._points, self._workspace.trajectory
        return (
            Columns(lambda: _columns(rows, [split(p) for p in points]), len(rows)) if rows else ()
        )


def _columns(rows: list[StepTaken], points: list[tuple[Array, Array, Array]]) -> dict[str, Array]:
    numbers = [row.numbers() for row in rows]
    columns = {name: np.array([each[name] for each in numbers]) for name in numbers[0]}
    x, u, nu = (np.stack(parts) for parts in zip(*points, strict=True))
    none = np.zeros(len(rows))
    return columns | {
        "mean": x, "controls": u, "terminal_multiplier": nu, "virtual_control": none,
    }  # fmt: skip


# --------------------------------------------------------------------- plans that count the noise


@dataclasses.dataclass(frozen=True, eq=False)
class Steered:
    """Where an iteration on an expected cost ended; also where another may begin.

    Attributes:
        status: how it ended.
        x: mean, (N, n).
        u: controls, (K, m).
        gains: (K, m, n); zeros in open loop.
        covariance: Σ, (N, n, n).
        eta: what the rows' variances are charged, (K, p).
        c: rows' expectations at nodes 1..K, (K, p).
        s: their standard deviations, (K, p).
        A: (K, n, n).
        B: (K, n, m).
        adjoint: λ_1..λ_K, (K, n).
        terminal: ν, (q,); 2Wg where the terminal condition is charged.
        g: terminal residual, (q,).
        G: its Jacobian, (q, n).
        effort: Σ dt uᵀRu.
        running: Σ dt (H + ℓᵀu).
        objective: the cost of the last step, P held: the mean's, plus what the noise is charged;
            rows' spread is in both, and that of the start in neither.
        iterations: steps tried.
    """

    status: Status
    x: Array
    u: Array
    gains: Array
    covariance: Array
    eta: Array
    c: Array
    s: Array
    A: Array
    B: Array
    adjoint: Array
    terminal: Array
    g: Array
    G: Array
    effort: float
    running: float
    objective: float
    iterations: int


def form_of(posed: Posed, stakes: Stakes) -> Form:
    """Which equations charge what is at stake."""
    return Form(
        noisy=True, soft=stakes.soft, tails=posed.tails, bridged=stakes.bridged and posed.tails > 0
    )


def task_of(
    model: Model, stakes: Stakes, tolerance: float, max_iterations: int, warm: bool
) -> Task:
    """What an iteration on an expected cost is asked for."""
    return Task(
        tolerance=tolerance, max_iterations=max_iterations,
        bounded=model.bounded, state_cost=model.has("state_cost"),
        variance_weight=stakes.variance_weight,
        feedback=stakes.feedback, saturation=stakes.saturation, warm=warm,
    )  # fmt: skip


def solve_noise(
    posed: Posed,
    stakes: Stakes,
    x: Array,
    u: Array,
    *,
    tolerance: float,
    max_iterations: int,
    warm: Steered | None = None,
) -> Steered:
    """A plan of an expected cost from x (N, n), u (K, m).

    Args:
        posed: the problem, with its constraints as rows if they are priced.
        stakes: what is charged, of these rows.
        x: means.
        u: controls.
        tolerance: of the steps.
        max_iterations: at most so many steps.
        warm: gains, rows' weights and multipliers to begin with.

    Raises:
        ValueError: if a function of the problem is not finite along the guess.
    """
    model = posed.model
    workspace = borrow(posed.program(form_of(posed, stakes)), len(model.dt))
    load(workspace, posed, stakes.weight, x, u)
    workspace.arrays["W"][0] = stakes.terminal
    K = workspace.K
    if warm is not None:
        workspace.at(0, "gains")[:K] = warm.gains
        workspace.at(0, "eta")[1:] = warm.eta
        workspace.at(0, "lam")[1:] = warm.adjoint
        workspace.at(0, "nu")[0] = warm.terminal
    task = task_of(model, stakes, tolerance, max_iterations, warm is not None)
    tuning = NOISE._replace(renewal=stakes.renewal)
    ending = iterate(workspace, task, tuning, posed.filler)
    if ending.status is None:
        raise ValueError(not_finite(model, x, u))
    steered = _steered(workspace, stakes, ending)
    give_back(workspace)
    return steered


def _steered(workspace: Workspace, stakes: Stakes, ending: Ending) -> Steered:
    side, at, K = ending.side, ending.at, workspace.K

    def nodes(name: str) -> Array:
        return workspace.at(side, name)[1:].copy()

    def stages(name: str) -> Array:
        return workspace.at(side, name)[:K].copy()

    g = workspace.at(side, "g")[0].copy()
    terminal = 2.0 * stakes.terminal * g if stakes.soft else workspace.at(side, "nu")[0].copy()
    assert ending.status is not None
    return Steered(
        status=ending.status, x=workspace.at(side, "x").copy(), u=stages("u"),
        gains=stages("gains"), covariance=workspace.at(side, "Sigma").copy(), eta=nodes("eta"),
        c=nodes("c") + nodes("offset"),
        s=np.asarray(floored(nodes("s"), workspace.arrays["s_largest"][0])),
        A=stages("A"), B=stages("B"), adjoint=nodes("lam"), terminal=terminal, g=g,
        G=workspace.at(side, "G")[0].copy(), effort=at.effort,
        running=at.running, objective=at.effort + at.running + at.charged,
        iterations=ending.tried,
    )  # fmt: skip


def advance(
    posed: Posed,
    stakes: Stakes,
    batch: dict[str, Array],
    *,
    tolerance: float,
    max_iterations: int,
) -> list[Any]:
    """Iterate on problems of one model that differ in start and guess, in place.

    Args:
        posed: the problem; its times are the batch's, its start known.
        stakes: what is charged.
        batch: x (P, N, n), u (P, K, m), gains, eta, adjoint, terminal, A and B as in
            :class:`Steered`, the first axis counting the problems; written to.
        tolerance: of the steps.
        max_iterations: at most so many steps.

    Returns:
        How each ended, a :class:`Status`, or None where a function is not finite.
    """
    workspace = borrow(posed.program(form_of(posed, stakes)), len(posed.model.dt))
    load(workspace, posed, stakes.weight, batch["x"][0], batch["u"][0])
    workspace.arrays["W"][0] = stakes.terminal
    task = task_of(posed.model, stakes, tolerance, max_iterations, True)
    K, views = workspace.K, [_exchange(workspace, side) for side in (0, 1)]
    cleared = [workspace.arrays[name] for name in ("held", "d", "e")]
    endings = []
    for i in range(len(batch["x"])):
        for name, view in views[0].items():
            view[...] = batch[name][i]
        for array in cleared:
            array.fill(0.0)
        workspace.arrays["lower"][:] = posed.model.lower
        workspace.arrays["upper"][:] = posed.model.upper
        ending = iterate(workspace, task, NOISE._replace(renewal=stakes.renewal), posed.filler)
        for name, view in views[ending.side].items():
            batch[name][i] = view
        for name in ("A", "B"):
            batch[name][i] = workspace.at(ending.side, name)[:K]
        if stakes.soft:
            batch["terminal"][i] = 2.0 * stakes.terminal * workspace.at(ending.side, "g")[0]
        endings.append(ending.status)
    give_back(workspace)
    return endings


def _exchange(workspace: Workspace, side: int) -> dict[str, Array]:
    """What goes in and out of a workspace for each problem of a batch, by the batch's names."""
    K = workspace.K
    return {
        "x": workspace.at(side, "x"), "u": workspace.at(side, "u")[:K],
        "gains": workspace.at(side, "gains")[:K], "eta": workspace.at(side, "eta")[1:],
        "adjoint": workspace.at(side, "lam")[1:], "terminal": workspace.at(side, "nu")[0],
    }  # fmt: skip

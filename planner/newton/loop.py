"""Newton's iteration: one linear-quadratic problem each, for plans of the mean and of the belief.

Each iteration solves one quadratic model, cut down to what is smooth at the iterate:

* the hinges max(0, c)² that are on at the iterate are squares, the others are off; rows that are
  Gaussian are smooth (:mod:`slipcar.planner.moments.losses`). Which hinges are on settles over the
  iterations rather than within each (as exact sub-problems do it);
* bounds of the controls are kept exactly: the LQ problem is solved again while the set of active
  ones changes;
* without a better guess, rows are left out at first, until steps are short: which way round the
  obstacles is then decided by where the free path runs, not by where the guess did;
* at first the model is that of the paper's convex sub-problem. Whole steps are taken: bold ones
  are what finds a way. When they are no longer than the controls, or after some number of them, or
  where they lead nowhere, the curvature of dynamics, rows and terminal condition is added, weighed
  by the multipliers: Newton's method on the optimality conditions, quadratic at the end (with noise
  charged, whose weights P are held in a step, linear with a factor of some hundredths to tenths);
* where the model is then not convex in the controls (a pivot of the Riccati recursion is not
  positive) or along its step, a multiple of R is added: a trust region by its multiplier, −p¹ of
  the paper. Where that is not enough, the curvature is taken back towards the convex model;
* a line search on a merit function makes it descend: the linear step first, then roll-outs of its
  law, which follow the dynamics and so have no defects but what is left of the old ones;
* after a few rejected steps in a row the convex model's step, searched further, goes first;
* steps that no longer become shorter, and do not what the model says, go round in circles: then
  the multiple of R is kept from vanishing;
* it ends where the residual of the maximum principle, measured anew at the iterate, is small.

Plans that count the noise start from a plan of the mean, with curvature from the first step on.
After each step the belief follows: covariance, rows' spread, weights P and gains K
(:mod:`slipcar.planner.moments.propagation`). Its fixed points are stationary points of the expected
cost in controls and gains, but for how ∂b/∂x, σ′, C and ½ tr(∂²c Σ) follow.

The merit function is Φ = cost + Σ λᵀf + νᵀg + s (Σ |λᵀf| + Σ √(fᵀΛf) + Σ |ν_j g_j|), f the
defects of the dynamics, g the terminal condition and Λ the mean of λλᵀ over the path of the step
before, with s ≥ 1 large enough that the step descends. Nothing in it depends on the units or the
axes of states and controls.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from slipcar.planner.lq.riccati import SOFTNESS
from slipcar.planner.newton.equations import KNOBS, Evaluation, Model, Promise
from slipcar.planner.newton.program import Workspace
from slipcar.planner.newton.tuning import Tuning
from slipcar.planner.problem.linearization import nearest_semidefinite
from slipcar.planner.status import Status

Array = np.ndarray

_ALPHA, _DAMPING, _KAPPA, _HINGES, _CURVED, _CLIPPED, _ANSWERED, _RENEWAL = (
    KNOBS.index(name)
    for name in ("alpha", "damping", "kappa", "hinges", "curved", "clipped", "answered", "renewal")
)


class Task(NamedTuple):
    """What an iteration is asked for; the arrays of its workspace hold the rest.

    Attributes:
        tolerance: stop when the square of the relative residual of the maximum principle falls to
            it.
        max_iterations: at most so many steps.
        bounded: whether there are bounds of the controls.
        state_cost: whether there is a state cost, whose Hessian may need a projection.
        released: leave the rows out at first.
        variance_weight: w.
        feedback: plan gains.
        saturation: bounds are kept at so many standard deviations of the correction.
        warm: gains, rows' weights and multipliers in the workspace are those of a plan nearby.
    """

    tolerance: float
    max_iterations: int
    bounded: bool
    state_cost: bool
    released: bool = False
    variance_weight: float = 0.0
    feedback: bool = False
    saturation: float = 1.0
    warm: bool = False


class StepTaken(NamedTuple):
    """One step tried: where its line search ended, and how it came about.

    Attributes:
        trial: the end of its line search.
        solves: LQ problems solved for it.
        shift: added to the Hessian, a trust region's multiplier.
        variance: ∫ tr Σ dt; NaN where it weighs nothing.
        linearize_seconds: spent on the model and the search.
        solve_seconds: spent on LQ problems.
    """

    trial: _Trial
    solves: int
    shift: float
    variance: float
    linearize_seconds: float
    solve_seconds: float

    def numbers(self) -> dict[str, Any]:
        """Those of an `Iteration`, by its names."""
        trial, new = self.trial, self.trial.new
        return {
            "effort": new.effort, "penalty": new.penalty, "running": new.running,
            "variance": self.variance, "merit": trial.merit, "predicted": trial.predicted,
            "actual": trial.actual, "step": trial.step, "trust_radius": trial.radius,
            "trust_multiplier": self.shift, "defect": new.defect,
            "terminal_residual": new.residual, "accepted": trial.accepted,
            "solver_iterations": self.solves, "linearize_seconds": self.linearize_seconds,
            "solve_seconds": self.solve_seconds,
        }  # fmt: skip


class Ending(NamedTuple):
    """How an iteration ended.

    Attributes:
        status: None where a function is not finite along the guess.
        side: of the workspace, where the last iterate is.
        tried: steps.
        at: the last iterate's costs.
        answered: whether the adjoint was taken along paths that the step's feedback leads to.
    """

    status: Status | None
    side: int
    tried: int
    at: Evaluation
    answered: bool = False


class Filler(Protocol):
    """Fills the quantities of a problem that is not traced."""

    def point(self, workspace: Workspace, side: int) -> None:
        """Values and first derivatives at a point."""
        ...

    def second(self, workspace: Workspace, side: int) -> None:
        """Second derivatives there."""
        ...

    def rollout(self, workspace: Workspace, side: int) -> None:
        """Run the kernel `rollout`, with the dynamics node by node."""
        ...


#: Told of every step, and the side where its trajectory is; True stops.
Watcher = Callable[[StepTaken, int], bool | None]


class Iteration:
    """The state of one run, and what is done with it.

    Args:
        workspace: with the problem and the guess loaded, on side 0.
        task: what is asked for.
        tuning: numbers of the method.
        filler: for problems that are not traced.
        watch: told of every step.
    """

    def __init__(
        self,
        workspace: Workspace,
        task: Task,
        tuning: Tuning,
        filler: Filler | None = None,
        watch: Watcher | None = None,
    ) -> None:
        self.workspace, self.task, self.tuning = workspace, task, tuning
        self.filler, self.watch = filler, watch
        form = workspace.program.form
        self.noisy, self.exact = form.noisy, not form.soft
        self.charged = self.noisy or task.variance_weight > 0.0
        self._evaluate, self._shift = workspace.kernels["evaluate"], workspace.kernels["shift"]
        self._backward, self._forward = workspace.kernels["backward"], workspace.kernels["forward"]
        self._rollout = workspace.kernels["rollout"]
        self._knobs = workspace.knobs
        self.side, self.shift, self.floor = 0, 0.0, 0.0
        self.renewal = tuning.renewal
        self.shortest, self.stale, self.rejected, self.tried = math.inf, 0, 0, 0
        self.hopeless, self.curvature, self.bold = 0, 1.0, tuning.free_steps > 0
        self._bent = False

    def run(self) -> Ending:
        """Iterate."""
        ws, task, tuning = self.workspace, self.task, self.tuning
        given = {
            "hinges": 1.0, "variance_weight": task.variance_weight,
            "closed": 1.0 if task.feedback else 0.0, "saturation": task.saturation,
            "stiffness": tuning.bound_stiffness, "softness": SOFTNESS,
        }  # fmt: skip
        ws.arrays["knob"][0] = [given.get(name, 0.0) for name in KNOBS]
        self.at = self._evaluated(0)
        if not math.isfinite(sum(self.at)):
            return Ending(None, 0, 0, self.at)
        self._believe(fresh=not task.warm)
        self._backward[0]()  # with kappa zero: how far the last controls move the end
        self._knobs[_KAPPA] = tuning.terminal_curvature
        self._first_effort = self.at.effort
        status = self._iterate()
        if self.charged:
            self.at = self._evaluated(self.side)
        answered = bool(self._knobs[_ANSWERED] > 0.0)
        return Ending(status, self.side, self.tried, self.at, answered)

    def _iterate(self) -> Status:
        task, tuning = self.task, self.tuning
        settling = math.inf
        released = task.released
        clock = time.perf_counter()
        for iteration in range(task.max_iterations):
            effort = self.at.effort
            if released and (
                settling < tuning.released * effort
                or iteration >= tuning.released_steps
                or not self.bold
            ):
                released = False
            newton = not released and (
                iteration >= tuning.free_steps
                or not self.bold
                or (self.tried > 0 and settling < tuning.settled * effort)
            )
            fallback = tuning.falls_back and self.rejected >= tuning.rejections
            curved = newton and not fallback
            if self.noisy and task.bounded:
                self._confine()
            self._prepare(curved)
            linearized = time.perf_counter()
            step = self._step(newton, curved, released)
            if step is None:
                return Status.SOLVER_FAILED
            solved = time.perf_counter()
            trial = self._search(step, newton, fallback, released)
            self.tried += 1
            shift, there, status = self.shift if curved else 0.0, 1 - self.side, None
            if trial.accepted:
                settling = self.length = trial.length
                self._accepted(step, trial, newton)
                if not released and self._extremal():
                    status = Status.CONVERGED
                elif self.hopeless >= tuning.patience:
                    status = Status.STALLED
            else:
                status = self._refused(newton, fallback)
            now = time.perf_counter()
            solving = solved - linearized
            stop = self._tell(step, trial, shift, there, now - clock - solving, solving)
            clock = now
            if status is not None:
                return status
            if stop:
                return Status.STOPPED
        return Status.MAX_ITERATIONS

    # ------------------------------------------------------------------------- at the iterate

    def _evaluated(self, side: int) -> Evaluation:
        if self.filler is not None:
            self.filler.point(self.workspace, side)
        self._evaluate[side]()
        evaluation: Evaluation = self.workspace.evaluation()
        return evaluation

    def _roll_out(self, side: int) -> None:
        """The candidate on that side follows its dynamics and the step's law."""
        if self.filler is not None:
            self.filler.rollout(self.workspace, side)
        else:
            self._rollout[side]()

    def _believe(self, fresh: bool = False) -> None:
        """Let the belief follow the iterate: what noise is charged, and gains."""
        if not self.charged:
            return
        ws, side = self.workspace, self.side
        self._project()
        if not self.noisy:
            ws.kernels["weights"][side]()
            return
        self._bend()
        ws.kernels["spread"][side]()
        self._knobs[_RENEWAL] = 1.0 if fresh else self.renewal
        ws.kernels["stakes"][side]()
        ws.kernels["weights"][side]()
        if self.task.feedback:
            ws.kernels["spread"][side]()

    def _project(self) -> None:
        """The nearest semidefinite Hessian of the state cost, where there is one."""
        if self.task.state_cost:
            ws, side = self.workspace, self.side
            ws.at(side, "H_psd")[:] = nearest_semidefinite(ws.at(side, "H_xx"))

    def _confine(self) -> None:
        """Bring the controls within the bounds that the gains of now leave.

        Bounds follow the gains, so that the last step's controls may lie outside: a step back costs
        more than it gains, and measured from there none would be accepted.
        """
        ws, here, there = self.workspace, self.side, 1 - self.side
        u = ws.at(here, "u")
        inside = np.clip(u, ws.arrays["lower"], ws.arrays["upper"])
        if np.array_equal(inside[:-1], u[:-1]):
            return
        for name in ("x", "lam", "nu"):
            ws.at(there, name)[:] = ws.at(here, name)
        ws.at(there, "u")[:] = inside
        moved = self._evaluated(there)
        if math.isfinite(sum(moved)):
            self.side, self.at, self._bent = there, moved, False

    def _prepare(self, curved: bool) -> None:
        """What the model needs beyond the point itself."""
        self._project()
        if curved:
            self._bend()

    def _bend(self) -> None:
        """Second derivatives at the iterate, where they have to be filled in; once."""
        if self.filler is not None and not self._bent:
            self.filler.second(self.workspace, self.side)
            self._bent = True

    # ------------------------------------------------------------------------------- the step

    def _step(self, newton: bool, curved: bool, released: bool) -> _Step | None:
        """The model's step: bounds settle, and the shift grows until the model is convex."""
        knobs, tuning = self._knobs, self.tuning
        knobs[_HINGES] = 0.0 if released else 1.0
        solves = 0
        for _ in range(tuning.inertia_trials):
            knobs[_DAMPING] = self.shift if curved else 0.0
            knobs[_CURVED] = self.curvature if curved else 0.0
            model, promise, rounds = self._settle(newton)
            solves += rounds
            if promise is not None and not (
                self.curvature > 0.0
                and curved
                and promise.pull - promise.slope < -tuning.bent * (promise.gap + promise.miss)
            ):
                if solves == rounds:
                    self.curvature = min(1.0, max(2.0 * self.curvature, tuning.least_curvature))
                return _Step(model, promise, solves)
            if not curved or self.curvature == 0.0:
                return None
            if self.shift < tuning.largest_shift:
                self.shift = max(tuning.shift_up * self.shift, tuning.first_shift)
            else:
                self.curvature *= 0.25
                if self.curvature < tuning.least_curvature:
                    self.curvature = 0.0
        return None

    def _settle(self, newton: bool) -> tuple[Model, Promise | None, int]:
        """Solve the LQ problem until bounds, and hinges that matter, are those it was solved with.

        Bold steps go through hinges that are off; judged ones see those that would cost as much
        as the step gains.
        """
        ws, tuning, arrays = self.workspace, self.tuning, self.workspace.arrays
        backward, forward = self._backward[self.side], self._forward[self.side]
        kept = None
        for attempt in range(1, tuning.bound_rounds + 1):
            backward()
            model: Model = ws.model()
            if model.bad != 0.0:
                return model, None, attempt
            forward()
            promise: Promise = ws.promise()
            if not math.isfinite(promise.total):
                return model, None, attempt
            turned = (
                newton
                and promise.turned != 0.0
                and (
                    kept is not None
                    or promise.unseen > tuning.unseen * abs(promise.pull - promise.slope)
                )
            )
            if promise.changed == 0.0 and not turned:
                return model, promise, attempt
            if attempt < tuning.bound_rounds:
                arrays["held"][:] = arrays["passed"]
                if turned:
                    on = ws.at(self.side, "on")
                    kept = on.copy() if kept is None else kept
                    on[:] = arrays["pushed"]
        if kept is not None:  # hinges do not settle: those of the iterate
            ws.at(self.side, "on")[:] = kept
            backward()
            model = ws.model()
        # The set does not settle: clip the controls and let the states follow.
        self._knobs[_CLIPPED] = 1.0
        forward()
        self._knobs[_CLIPPED] = 0.0
        return model, ws.promise(), attempt

    def _search(self, step: _Step, newton: bool, fallback: bool, released: bool) -> _Trial:
        """Shorten the step until the merit function falls; free steps are taken whole."""
        model, promise, tuning, at = step.model, step.promise, self.tuning, self.at
        lacking = promise.gap + promise.miss
        descent = promise.pull - promise.slope
        factor = max(1.0, -descent / (0.75 * lacking)) if lacking > 0.0 else 1.0
        descent += factor * lacking
        before = at.effort + at.running + model.charged + promise.pull + factor * lacking
        predicted = promise.pull - promise.change + factor * lacking
        size = at.effort + abs(at.running) + model.charged + abs(promise.pull)
        noise, bold = tuning.noise * size, tuning.boldness * (descent + size - abs(promise.pull))
        most = tuning.longest * (max(self._first_effort, at.effort) + 1e-3 * promise.length)
        alpha = math.sqrt(most / promise.length) if newton and promise.length > most else 1.0
        trials = (tuning.long_searches if fallback else tuning.searches) if newton else 1
        there = 1 - self.side
        rolled = False
        for trial in range(trials):
            self._knobs[_ALPHA] = alpha
            if rolled:
                self._roll_out(there)
            else:
                self._shift[self.side]()
            new = self._evaluated(there)
            merit = new.effort + new.running + new.charged + new.pull
            merit += factor * (new.gap + new.miss)
            actual = before - merit
            unseen = new.charged - model.charged if released else 0.0
            accepted = math.isfinite(merit) and (
                (not newton and actual + unseen >= -bold)
                or (descent <= noise and actual >= -noise)
                or actual >= tuning.armijo * alpha * descent
            )
            if accepted or trial == trials - 1:
                break
            if rolled:
                alpha *= 0.5
            rolled = True
        square = alpha * alpha
        moved, length = square * promise.step, square * promise.length
        if rolled:
            moved, length = self._moved(there)
        return _Trial(
            new, alpha, accepted, merit, predicted, actual, noise, moved, length,
            square * promise.radius,
        )  # fmt: skip

    def _moved(self, there: int) -> tuple[float, float]:
        """∫ ‖Δu‖² dt and ∫ ΔuᵀRΔu dt from the iterate to a candidate that was rolled out."""
        ws = self.workspace
        moved = (ws.at(there, "u") - ws.at(self.side, "u"))[:-1]
        weighted = ws.arrays["dt"][:-1] * moved
        return float(np.vdot(weighted, moved)), float(np.vdot(weighted @ ws.at(0, "R")[0], moved))

    # -------------------------------------------------------------------------- what follows

    def _refused(self, newton: bool, fallback: bool) -> Status | None:
        """Shorten the next step; a status where there is no point in trying it."""
        tuning = self.tuning
        if not newton:
            self.bold = False
            return None
        if fallback:
            return Status.STALLED
        self.rejected += 1
        self.shift = max(tuning.shift_up * self.shift, 0.1 * tuning.first_shift)
        return (
            Status.STALLED if not tuning.falls_back and self.rejected >= tuning.rejections else None
        )

    def _accepted(self, step: _Step, trial: _Trial, newton: bool) -> None:
        """Make the candidate the iterate; adapt shift and renewal."""
        tuning = self.tuning
        self.rejected = 0
        cost = abs(trial.new.effort + trial.new.running + trial.new.penalty)
        dear = step.model.dearest > tuning.dearest * tuning.dearest * cost
        self.hopeless = self.hopeless + 1 if newton and dear else 0
        if newton:
            least = tuning.first_shift
            self.stale += self.charged or trial.actual < 0.1 * trial.predicted
            if trial.length < 0.5 * self.shortest:
                self.shortest, self.stale = trial.length, 0
                self.floor /= tuning.shift_up
                if self.floor < 0.01 * least:
                    self.floor = 0.0
            elif self.stale == tuning.patience:  # round in circles
                self.floor, self.stale = max(tuning.shift_up * self.floor, 0.1 * least), 0
                self.renewal = max(0.5 * self.renewal, tuning.least_renewal)
            self.shift = max(self._next_shift(trial), self.floor)
        self.side, self.at, self._bent = 1 - self.side, trial.new, False
        self._believe()

    def _next_shift(self, trial: _Trial) -> float:
        """Less after a step that did what the model said, more after one that did not."""
        tuning, shift = self.tuning, self.shift
        least = 0.01 * tuning.first_shift
        fulfilled = trial.actual > 0.5 * trial.predicted or trial.predicted <= trial.noise
        if trial.alpha == 1.0 and fulfilled:
            return shift / tuning.shift_down if shift > least else 0.0
        if trial.alpha < 0.3 or trial.actual < 0.1 * trial.predicted:
            return max(2.0 * shift, least)
        return shift

    def _extremal(self) -> bool:
        """Whether the iterate meets the maximum principle, its dynamics and its end."""
        at = self.at
        tuning, cost = self.tuning, at.effort + abs(at.running)
        off = at.gap + at.miss
        if off > tuning.defective * cost or (
            self.length > tuning.long * at.effort and off > 1e-6 * cost
        ):
            return False  # not worth a closer look
        for answered in (0.0, 1.0):
            self._knobs[_ANSWERED] = answered
            self.workspace.kernels["residuals"][self.side]()
            off = self.workspace.residuals()
            strict = max(tuning.strictest, min(1.0, 1e4 * self.task.tolerance))
            if not (
                off.gap <= tuning.consistency * strict and off.end <= tuning.feasibility * strict
            ):
                return False
            # An adjoint that depends on a feedback is only as good as what it leaves.
            if off.control <= self.task.tolerance * (0.01 if answered else 1.0):
                return True
            if self.length > 1e-8 * self.task.tolerance * at.effort:
                return False
        return False

    def _tell(
        self, step: _Step, trial: _Trial, shift: float, there: int, linearizing: float,
        solving: float,
    ) -> bool:  # fmt: skip
        """Report the step, whose trajectory is on a side of the workspace; whether to stop."""
        if self.watch is None:
            return False
        new, w = trial.new, self.task.variance_weight
        variance = math.nan
        if w > 0.0:  # of the belief, where it has followed
            noise = self.workspace.view("noise")[0] if trial.accepted else new.charged - new.penalty
            variance = noise / w
        row = StepTaken(trial, step.solves, shift, variance, linearizing, solving)
        return bool(self.watch(row, there))


class _Step(NamedTuple):
    """The model, what its step promises, and LQ problems solved for it."""

    model: Model
    promise: Promise
    solves: int


class _Trial(NamedTuple):
    """Where a line search ended."""

    new: Evaluation
    alpha: float
    accepted: bool
    merit: float
    predicted: float
    actual: float
    noise: float
    step: float
    length: float
    radius: float


def iterate(
    workspace: Workspace,
    task: Task,
    tuning: Tuning,
    filler: Filler | None = None,
    watch: Watcher | None = None,
) -> Ending:
    """Run the iteration on a loaded workspace; see :class:`Iteration`."""
    iteration: Any = Iteration(workspace, task, tuning, filler, watch)
    return iteration.run()

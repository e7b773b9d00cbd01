"""Plans as controllers, with the `predict` signature of Stable-Baselines3.

A controller sees observations of an environment, on its own or in batches, and answers with
actions. How an observation encodes (t, x) and an action a control is the problem's business:
its `decode_observation` and `encode_control` are used when it has them; otherwise an
observation is (x, t) and an action the control itself.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from slipcar.planner.actuation import actuation_of
from slipcar.planner.moments import gains as tracking
from slipcar.planner.moments.gains import closed_loop_covariance, weight_matrix, wrap
from slipcar.planner.plan import Plan
from slipcar.planner.problem.control_set import project_controls
from slipcar.planner.problem.model import model_of
from slipcar.planner.search.replanning import applied

Array = np.ndarray


class OpenLoop:
    """Plays a plan's controls by the clock, whatever the state.

    Attributes:
        plan: what is played.
        observation: the kind of observation it would rather be given.
        closed_loop: False.

    Raises:
        ValueError: if the plan was loaded from a file that lacks what playing it takes; see
            :mod:`slipcar.planner.actuation`.
    """

    observation = "state"
    closed_loop = False

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._actuation = actuation_of(plan)
        self._angles = self._actuation.angles

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.plan!r})"

    @property
    def preparation_time(self) -> float:
        """Seconds of planning."""
        return self.plan.solve_time

    @property
    def status(self) -> Any:
        """The plan's status."""
        return self.plan.status

    def control(self, t: Any, x: Any) -> Array:
        """Control in physical units at times t (...,) [s] and states x (..., n): (..., m)."""
        return self.plan.controls[self._interval(t)]

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Array, None]:
        """Actions for observations (d,) or (batch, d): float32 (m,) or (batch, m), and None.

        Raises:
            ValueError: if the observation has the wrong length or is not finite.
        """
        return self._action(self.control(*self._decode(observation))), None

    def preview(self, state: Any = None, row: int = 0) -> tuple[Array, Array | None]:
        """What episode `row` of those with the `state` means to do, to be drawn: the whole plan.

        Returns:
            Mean states (N, n), and the covariances (N, n, n) of the car driven so: open loop or,
            with feedback, closed; None where they are not known.
        """
        return self.plan.mean, self.plan.covariance

    def fingerprint(self) -> str:
        """A hash of all that determines its actions."""
        digest = hashlib.sha256(type(self).__name__.encode())
        for array in self._numbers():
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def _numbers(self) -> list[Array]:
        lower, upper, radius = self._limits()
        angles = np.asarray(self._angles, dtype=np.int64)
        return [self.plan.times, self.plan.controls, lower, upper, np.array([radius]), angles]

    def _limits(self) -> tuple[Array, Array, float]:
        """Lower and upper bounds and the ball's radius, of the plan's problem."""
        actuation = self._actuation
        return actuation.lower, actuation.upper, actuation.radius

    def _action(self, u: Array) -> Array:
        encode = getattr(self.plan.problem, "encode_control", None)
        return np.asarray(u if encode is None else encode(u), dtype=np.float32)

    def _interval(self, t: Any) -> Array:
        times = self.plan.times
        k = np.searchsorted(times, np.asarray(t) + clock_slack(times), side="right") - 1
        return np.clip(k, 0, len(times) - 2)

    def _decode(self, observation: Any) -> tuple[Array, Array]:
        observed = np.asarray(observation, dtype=np.float64)
        if not np.isfinite(observed).all():
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(observed))[0])
            raise ValueError(f"observation{list(index)} is {observed[index]}; it must be finite")
        n = self.plan.mean.shape[1]
        decode = getattr(self.plan.problem, "decode_observation", None)
        if decode is not None:
            return decode(observed)
        if observed.ndim == 0 or observed.shape[-1] != n + 1:
            raise ValueError(
                f"an observation must hold the {n} states and the time on its last axis, not shape "
                f"{observed.shape}; the plan's problem has no decode_observation"
            )
        return observed[..., n], observed[..., :n]


class Feedback(OpenLoop):
    """u = ū + K (x − μ): a plan with gains, projected onto the admissible controls.

    Plans that have `gains` use them. Otherwise they are those of the time-varying LQR around
    the plan, min ∫ δxᵀQδx + δuᵀRδu dt + δx(T)ᵀQf δx(T), with R the problem's control weight.

    Args:
        plan: what to follow.
        Q: weight on deviations: scalar, (n,) or (n, n); default diag(10, 10, 1, 1, 1) for five
            states, the identity otherwise.
        R: weight on corrections; default the problem's control weight (or identity).
        Qf: weight on the final deviation; default 100.

    Raises:
        ValueError: for a weight of wrong shape or sign, or gains of wrong shape; or if the plan was
            loaded from a file that lacks what playing it takes.
    """

    closed_loop = True

    def __init__(self, plan: Plan, Q: Any = None, R: Any = None, Qf: Any = 100.0) -> None:
        n, m = plan.mean.shape[1], plan.controls.shape[1]
        gains = plan.gains
        if gains is None:
            own = actuation_of(plan).weight
            weights = (
                weight_matrix("Q", tracking.default_tracking(n) if Q is None else Q, n),
                weight_matrix("R", own if R is None else R, m, definite=True),
                weight_matrix("Qf", Qf, n),
            )
            with np.errstate(all="ignore"):  # of a plan that leads nowhere
                gains = tracking.lqr_gains(plan.A, plan.B, np.diff(plan.times), *weights)
            if not np.isfinite(gains).all():
                Q, R, Qf = (float(np.abs(weight).max()) for weight in weights)
                raise ValueError(
                    f"the LQR around this {plan.status.name} plan has no finite gains: weights are "
                    f"up to Q {Q:.3g}, R {R:.3g} and Qf {Qf:.3g}, its linearisation up to "
                    f"A {np.abs(plan.A).max():.3g} and B {np.abs(plan.B).max():.3g}; give Q and "
                    f"Qf in proportion to R, in the problem's units"
                )
        gains = np.asarray(gains, dtype=np.float64)
        wanted = (len(plan.controls), m, n)
        if gains.shape != wanted or not np.isfinite(gains).all():
            raise ValueError(
                f"the plan's gains must be finite and of shape {wanted}, not {gains.shape}"
            )
        super().__init__(plan.replace(gains=gains))
        self._admissible = self._limits()

    def control(self, t: Any, x: Any) -> Array:
        """Control in physical units at times t (...,) [s] and states x (..., n): (..., m)."""
        k = self._interval(t)
        error = wrap(np.asarray(x) - self.plan.mean[k], self._angles)
        assert self.plan.gains is not None
        u = self.plan.controls[k] + applied(self.plan.gains[k], error)
        return project_controls(u, *self._admissible)

    def preview(self, state: Any = None, row: int = 0) -> tuple[Array, Array | None]:
        """The plan and the covariances (N, n, n) of the closed loop; see `OpenLoop.preview`."""
        plan = self.plan
        assert plan.gains is not None
        if plan.expected is not None:  # planned for its own gains
            return plan.mean, plan.covariance
        if plan.problem is None:
            return plan.mean, None
        model, along = model_of(plan.problem), (plan.times, plan.mean, plan.A, plan.B, plan.gains)
        return plan.mean, closed_loop_covariance(model, *along, start=plan.covariance[0])

    def _numbers(self) -> list[Array]:
        assert self.plan.gains is not None
        return [*super()._numbers(), self.plan.mean, self.plan.gains]


def clock_slack(times: Array) -> float:
    """How early [s] an interval of these nodes begins: times are observed in float32."""
    rounding = np.finfo(np.float32).eps * (times[-1] - times[0])
    return float(max(1e-3 * np.min(np.diff(times)), rounding))

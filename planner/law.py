"""The law that a plan is played by, as numbers alone: for other languages.

    u(t, x) = P[ ū_k + K_k wrap(x − μ_k) ],    k the interval that t lies in

P projects onto the admissible controls, wrap takes the errors of angles to [−π, π]. It is what
`Feedback(plan).control` and `OpenLoop(plan).control` compute, projected.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.planner.actuation import Actuation, actuation_of
from slipcar.planner.controllers import Feedback, clock_slack
from slipcar.planner.moments.gains import wrap
from slipcar.planner.options import check_choice
from slipcar.planner.plan import Plan
from slipcar.planner.problem.control_set import control_ball, control_limits, project_controls
from slipcar.planner.problem.numbers import finite
from slipcar.planner.search.replanning import applied

Array = np.ndarray

#: Which gains: the plan's own, those of the LQR around it, or none.
KINDS = ("planned", "lqr", "open-loop")
FORMAT, VERSION = "slipcar-law", 1


@dataclasses.dataclass(frozen=True, eq=False)
class Law:
    """A control law on K intervals of n states and m controls.

    Attributes:
        times: nodes, (K+1,) [s]; an interval begins `slack` before its node, the first one
            at −∞, and the last one lasts for ever.
        controls: ū, (K, m).
        mean: μ at the beginning of each interval, (K, n).
        gains: K, (K, m, n); zeros in open loop.
        lower: (m,), −inf where unbounded.
        upper: (m,), inf where unbounded.
        radius: of the ball ‖u‖₂ ≤ radius, inf where there is none.
        angles: states of period 2π.
        slack: [s].
    """

    times: Array
    controls: Array
    mean: Array
    gains: Array
    lower: Array
    upper: Array
    radius: float
    angles: tuple[int, ...]
    slack: float

    @classmethod
    def of(cls, plan: Plan, kind: str = "planned", *, unbounded: bool = False) -> Law:
        """The law of a plan.

        Args:
            plan: converged.
            kind: `planned`, its own gains; `lqr`, as `Feedback` tracks a plan without gains;
                `open-loop`, none.
            unbounded: allow a problem without bounds on its controls.

        Raises:
            ValueError: for a plan that did not converge, has no gains of this kind, or no bounds.
        """
        check_choice("law", kind, KINDS)
        if not plan.status.ok:
            raise ValueError(f"only a converged plan is exported; this one ended {plan.status}")
        if kind == "planned" and plan.gains is None:
            raise ValueError(
                "this plan has no gains: plan with feedback (plan(..., feedback=True), or slipcar "
                "plan --feedback), or export another law: 'lqr' tracks it, 'open-loop' plays it"
            )
        actuation = _actuation(plan)
        limits = np.isfinite([*actuation.lower, *actuation.upper, actuation.radius])
        if not limits.any() and not unbounded:
            raise ValueError(
                "this plan's problem has no bounds on its controls, and neither would the law: "
                "give it control_bounds or control_radius, or export it as unbounded"
            )
        K, m, n = len(plan.controls), plan.controls.shape[1], plan.mean.shape[1]
        gains: Any = np.zeros((K, m, n))
        if kind != "open-loop":
            known = plan if kind == "planned" else plan.replace(gains=None)
            gains = Feedback(known.replace(problem=None, actuation=actuation)).plan.gains
        return cls(
            times=plan.times, controls=plan.controls, mean=plan.mean[:-1], gains=gains,
            lower=actuation.lower, upper=actuation.upper, radius=float(actuation.radius),
            angles=actuation.angles, slack=clock_slack(plan.times),
        )  # fmt: skip

    def control(self, t: float, x: Array) -> Array:
        """Controls (..., m) at a time [s] for states (..., n)."""
        begun = np.searchsorted(self.times, t + self.slack, side="right")
        k = min(max(int(begun) - 1, 0), len(self.controls) - 1)
        error = wrap(np.asarray(x, dtype=np.float64) - self.mean[k], self.angles)
        u = self.controls[k] + applied(self.gains[k], error)
        return project_controls(u, self.lower, self.upper, self.radius)

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON, None where there is no bound; :meth:`from_dict` reads it."""
        data = {name: np.asarray(value).tolist() for name, value in vars(self).items()}
        for name in ("lower", "upper"):
            data[name] = [value if np.isfinite(value) else None for value in data[name]]
        data["radius"] = self.radius if np.isfinite(self.radius) else None
        K, m, n = self.gains.shape
        sizes = {"intervals": K, "controls_dim": m, "states_dim": n}
        return {"format": FORMAT, "version": VERSION, **sizes, **data}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Law:
        """The law that :meth:`as_dict` described.

        Raises:
            ValueError: for another format, missing entries, or numbers that do not fit.
        """
        if (data.get("format"), data.get("version")) != (FORMAT, VERSION):
            known = f"format {FORMAT!r}, version {VERSION}"
            raise ValueError(
                f"not a law of {known}: {data.get('format')!r}, version {data.get('version')!r}"
            )
        try:
            fields = {field.name: data[field.name] for field in dataclasses.fields(cls)}
        except KeyError as missing:
            raise ValueError(f"a law has {missing.args[0]!r}, which is missing") from None
        gains = finite("gains", fields["gains"], (None, None, None))
        K, m, n = gains.shape
        shapes = {"times": (K + 1,), "controls": (K, m), "mean": (K, n), "slack": ()}
        fields |= {name: finite(name, fields[name], shape) for name, shape in shapes.items()}
        bounds = [
            [none if value is None else value for value in fields[name]]
            for name, none in (("lower", -np.inf), ("upper", np.inf))
        ]
        lower, upper = control_limits(bounds, m)
        limits = {"lower": lower, "upper": upper}
        radius = control_ball(fields["radius"], lower, upper)
        if any(not isinstance(i, int) or not 0 <= i < n for i in fields["angles"]):
            raise ValueError(f"angles must be components of {n} states, not {fields['angles']}")
        exact = {"gains": gains, "angles": tuple(fields["angles"]), "slack": float(fields["slack"])}
        return cls(**{**fields, **limits, **exact, "radius": radius})


def _actuation(plan: Plan) -> Actuation:
    """Bounds and angles: of a loaded plan too whose problem translated observations."""
    if plan.problem is None and plan.actuation is not None:
        # The law is of states and controls themselves: nothing is translated.
        return dataclasses.replace(plan.actuation, translators=())
    return dataclasses.replace(actuation_of(plan), translators=())

"""What playing a plan takes from its problem: the set U, the weight R, and what is an angle.

A problem is the user's object and, as a rule, in no file; these few numbers are. With them a loaded
plan plays the very controls that it played before it was saved.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.planner.problem.control_set import control_ball, control_limits
from slipcar.planner.problem.numbers import finite

Array = np.ndarray

#: Members of a problem that translate between it and an environment.
_TRANSLATORS = ("decode_observation", "encode_control")


@dataclasses.dataclass(frozen=True, eq=False)
class Actuation:
    """Numbers of a problem that its controllers need.

    Attributes:
        weight: R, (m, m).
        lower: lower control bounds, (m,), −inf where unbounded.
        upper: upper control bounds, (m,).
        radius: of the ball of controls, inf where there is none.
        angles: components of the state of period 2π.
        translators: which of `decode_observation` and `encode_control` the problem has. They are
            functions, and in no file.
    """

    weight: Array
    lower: Array
    upper: Array
    radius: float
    angles: tuple[int, ...]
    translators: tuple[str, ...] = ()

    @classmethod
    def of(cls, problem: Any, m: int) -> Actuation:
        """Those of a problem with m controls.

        Raises:
            ValueError: for bounds or a radius out of range.
        """
        lower, upper = control_limits(getattr(problem, "control_bounds", None), m)
        return cls(
            weight=np.array(getattr(problem, "control_weight", np.eye(m)), dtype=np.float64),
            lower=lower,
            upper=upper,
            radius=control_ball(getattr(problem, "control_radius", None), lower, upper),
            angles=tuple(int(i) for i in getattr(problem, "angles", ())),
            translators=tuple(n for n in _TRANSLATORS if getattr(problem, n, None) is not None),
        )

    def as_dict(self) -> dict[str, Array]:
        """Arrays by name, for a file."""
        return {name: np.asarray(value) for name, value in vars(self).items()}

    @classmethod
    def from_dict(cls, data: dict[str, Array]) -> Actuation:
        """What :meth:`as_dict` gave."""
        return cls(
            **{name: data[name] for name in ("weight", "lower", "upper")},
            radius=data["radius"].item(),
            angles=tuple(data["angles"].tolist()),
            translators=tuple(data["translators"].tolist()),
        )

    def check(self, n: int, m: int) -> None:
        """Raise ValueError unless these are of a problem with n states and m controls."""
        finite("weight", self.weight, (m, m))
        kinds = {np.asarray(value).dtype.kind for value in (self.lower, self.upper, self.radius)}
        if kinds != {"f"}:
            raise ValueError(f"bounds must be real, not {self.lower}, {self.upper}, {self.radius}")
        control_ball(self.radius, *control_limits(np.stack([self.lower, self.upper]), m))
        if any(not isinstance(i, int) or not 0 <= i < n for i in self.angles):
            raise ValueError(f"angles must be components of {n} states, not {self.angles}")


def actuation_of(plan: Any) -> Actuation:
    """What playing this plan takes, from its problem or from the file that it was loaded from.

    Raises:
        ValueError: if neither knows it, or the problem had functions that no file keeps.
    """
    if plan.problem is not None:
        return Actuation.of(plan.problem, plan.controls.shape[1])
    again = "give it its problem again: plan.replace(problem=...)"
    if plan.actuation is None:
        raise ValueError(
            "this plan knows neither its problem nor its control bounds, weight and angles (files "
            f"of earlier versions did not keep them): {again}"
        )
    if lost := plan.actuation.translators:
        raise ValueError(
            f"the problem of this plan has {' and '.join(lost)}, which its file cannot keep, and "
            f"without them observations or actions would mean something else: {again}"
        )
    return plan.actuation

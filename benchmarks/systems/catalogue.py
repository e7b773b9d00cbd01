"""The systems by name, what they cost at best, and in which units their numbers are.

A variant is another guess for a system, other units or another horizon; the eleven are the rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from .flight import Quad12, Rocket
from .ground import Corridor, Dubins, Race
from .mechanisms import Arm, CartPole, FallingArm, Upright
from .processes import CSTR, Glucose
from .space import FreeFlyer, Rendezvous
from .units import MILLIMETRES, Dimensions, in_units


@dataclasses.dataclass(frozen=True)
class System:
    """A system of a user's.

    Attributes:
        make: a new object of the user's class.
        dimensions: of its numbers.
        optimum: cost of IPOPT's plan from the problem's own guess, tolerance 1e-9; of the first
            seven as it was handed to us, found by another transcription than ours.
        variant: whether it is another's.
    """

    make: Callable[[], Any]
    dimensions: Dimensions
    optimum: float
    variant: bool = False


_ARM = Dimensions("1 1 1/s 1/s", "N N", "", "1 1 1/s 1/s")
_FLYER = Dimensions(
    "m m m m/s m/s m/s 1 1 1 1 1/s 1/s 1/s", "m/s2 m/s2 m/s2 N N N", "m2 m2",
    "m m m m/s m/s m/s 1 1 1 1/s 1/s 1/s",
)  # fmt: skip

SYSTEMS: dict[str, System] = {
    "CartPole": System(
        CartPole, Dimensions("m 1 m/s 1/s", "N", "m m", "m 1 m/s 1/s"), optimum=0.447852
    ),
    "Rocket": System(
        Rocket,
        Dimensions("m m m/s m/s 1 1/s", "m/s2 1/s2", "m 1", "m m m/s m/s 1 1/s"),
        optimum=7.85823,
    ),
    "Quad12": System(
        Quad12,
        Dimensions(
            "m m m m/s m/s m/s 1 1 1 1/s 1/s 1/s", "m/s2 N N N", "m2 m2 m2",
            "m m m m/s m/s m/s 1 1 1 1/s 1/s 1/s",
        ),
        optimum=19.684004,
    ),
    "Dubins": System(Dubins, Dimensions("m m 1", "1/s", "m2 m2 m2", "m m 1"), optimum=2.75514),
    "Race": System(
        Race, Dimensions("m m 1 m/s m/s 1/s 1", "m/s2 1/s", "m m", "m m 1"), optimum=0.0759653
    ),
    "Corridor": System(
        Corridor,
        Dimensions("m m m/s m/s", "m/s2 m/s2", "m2 " * 50 + "m m", "m m m/s m/s"),
        optimum=1.06774,
    ),
    "CSTR": System(CSTR, Dimensions("m 1", "N", "1", "m 1"), optimum=-719.957941),
    "Arm": System(Arm, _ARM, optimum=0.52787767),
    "FreeFlyer": System(FreeFlyer, _FLYER, optimum=0.95030083),
    "Rendezvous": System(
        Rendezvous,
        Dimensions("m m m m/s m/s m/s", "m/s2 m/s2 m/s2", "", "m m m m/s m/s m/s"),
        optimum=0.0061169113,
    ),
    "Glucose": System(Glucose, Dimensions("m 1/s N", "N/s", "m", "m N"), optimum=1302.0965),
    "FallingArm": System(FallingArm, _ARM, optimum=0.45028068, variant=True),
    "FreeFlyerMm": System(
        lambda: in_units(FreeFlyer(), _FLYER, MILLIMETRES), _FLYER, optimum=0.95030083, variant=True
    ),
    "Upright": System(Upright, Dimensions("1 1/s", "N", "", "1 1/s"), 5.703873, variant=True),
}  # fmt: skip

#: Those that are planned in other units.
IN_UNITS = ("CartPole", "Rocket", "Race", "FreeFlyer", "CSTR")


def chosen(names: Sequence[str]) -> list[str]:
    """The systems whose names begin with one of these; upper and lower case are the same.

    Raises:
        ValueError: for a name that no system's begins with.
    """
    for name in names:
        if not any(system.lower().startswith(name.lower()) for system in SYSTEMS):
            raise ValueError(f"no system is called {name}: there are {', '.join(SYSTEMS)}")
    return [s for s in SYSTEMS if any(s.lower().startswith(name.lower()) for name in names)]

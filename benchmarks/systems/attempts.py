"""One call of `plan`, whatever becomes of it, as a record."""

from __future__ import annotations

import dataclasses
import time
import warnings
from typing import Any

import numpy as np

from slipcar.planner import Plan, plan

from .deadline import TooLong, deadline
from .judge import Judged, judge

Array = np.ndarray

#: Seconds that a call is given.
PATIENCE = 60.0
_NOTHING = Judged(np.nan, np.inf, np.inf, np.inf)


@dataclasses.dataclass(frozen=True)
class Attempt:
    """What `plan` made of a problem.

    Attributes:
        status: its word; the exception's name where it raised, TOO_LONG where it did not end.
        ok: whether it says CONVERGED.
        iterations: its own count.
        judged: the plan, measured by the problem's functions.
        verdict: the certificate's first line; empty without a plan.
        certified: whether the certificate holds.
        seconds: of the call.
        message: the plan's, or the exception's.
        plan: the plan, if there is one.
    """

    status: str
    ok: bool
    iterations: int
    judged: Judged
    verdict: str
    certified: bool
    seconds: float
    message: str
    plan: Plan | None = None

    @property
    def solved(self) -> bool:
        """Whether it says CONVERGED and what it says is a trajectory of the problem."""
        return self.ok and self.judged.feasible


def attempt(problem: Any, patience: float = PATIENCE, **options: Any) -> Attempt:
    """Plan for the mean, with a limit of time and no exception."""
    began = time.perf_counter()
    try:
        with deadline(patience), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            p = plan(problem, variance_weight=0.0, **options)
            seconds = time.perf_counter() - began
            verdict, certified = str(p.certificate).partition("\n")[0], p.certificate.extremal
    except TooLong as limit:
        return _failed("TOO_LONG", patience, str(limit))
    except Exception as error:
        return _failed(type(error).__name__, time.perf_counter() - began, str(error))
    return Attempt(
        status=p.status.name,
        ok=p.status.ok,
        iterations=p.iterations,
        judged=judge(problem, p.mean, p.controls),
        verdict=verdict,
        certified=certified,
        seconds=seconds,
        message=p.message,
        plan=p,
    )


def _failed(status: str, seconds: float, message: str) -> Attempt:
    return Attempt(status, False, 0, _NOTHING, "", False, seconds, message)

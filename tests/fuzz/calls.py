"""One call under guard: what it returned or raised, what it warned of, how long it took."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

#: Seconds of the processor that any call may take.
PATIENCE = 30.0
#: Words that a refusal may name its cause by: members of a problem, options, files, functions.
CAUSES = (
    "start", "times", "control", "drift", "diffusion", "terminal", "penalty", "constraint",
    "state_cost", "angles", "guess", "variance_weight", "solver", "method", "tolerance",
    "max_iterations", "trust_region", "linearization", "integrator", "compiled", "cold_start",
    "free_first", "shooting", "final_time", "time_weight", "risk", "feedback", "expected",
    "check_derivatives", "callback", "workers", "handover", "iterations", "saturation",
    "observation", "horizon", "nodes", "obstacles", "clearance", "weight", "slip", "goal",
    "process_noise", "plan", "scenario", "state", "batch", "problem",
)  # fmt: skip


class TooLong(BaseException):
    """Raised inside a call; no `except Exception` on the way keeps it."""


@dataclasses.dataclass(frozen=True)
class Called:
    """What became of a call: its value, or what it raised; and what is wrong with that."""

    value: Any
    error: BaseException | None
    findings: tuple[str, ...]
    seconds: float


def call(function: Callable[[], Any], *, refusal: tuple[type[Exception], ...] = ()) -> Called:
    """Run it; only ValueError and TypeError with a cause, and `refusal`, may leave it."""
    value, error, found, began = None, None, [], time.perf_counter()
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            with _deadline(PATIENCE):
                value = function()
        except TooLong as late:
            error = late
            found.append(f"took more than {PATIENCE:g} s")
        except Exception as raised:  # whatever it is, it is judged
            error = raised
            found += _judged(raised, refusal)
    found += [f"warned: {w.category.__name__}: {w.message}" for w in heard]
    return Called(value, error, tuple(found), time.perf_counter() - began)


def _judged(error: Exception, refusal: tuple[type[Exception], ...]) -> list[str]:
    words = str(error)
    if isinstance(error, refusal):
        return []
    if type(error) not in (ValueError, TypeError):
        return [f"raised {type(error).__name__}: {words}"]
    return [] if any(cause in words for cause in CAUSES) else [f"names no cause: {error!r}"]


@contextlib.contextmanager
def _deadline(seconds: float) -> Iterator[None]:
    def over(*_: object) -> None:
        raise TooLong

    before = signal.signal(signal.SIGPROF, over)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)

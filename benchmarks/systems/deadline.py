"""A call that may take no longer than it is given."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from typing import NoReturn


class TooLong(BaseException):
    """Raised inside the call; no `except Exception` on the way keeps it."""


@contextlib.contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """Raise `TooLong` in the block when its time is over; in the main thread, on POSIX."""

    def over(*_: object) -> NoReturn:
        raise TooLong(f"more than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)

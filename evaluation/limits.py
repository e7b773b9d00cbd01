"""How long a controller may take: one that hangs must not cost the other rows."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any


class TimeLimitError(RuntimeError):
    """A controller took longer than it was allowed to."""


@contextlib.contextmanager
def time_limit(seconds: float | None, what: str) -> Iterator[Callable[[], None]]:
    """Stop what takes longer than `seconds` (None: no limit).

    In a process's main thread a timer interrupts Python code wherever it is, also in a `predict`
    that never returns. Elsewhere (a thread of a Dask worker, Windows) only the function that this
    yields looks at the clock: call it now and then.

    Args:
        seconds: > 0, or None.
        what: took so long, for the message: "1024 episodes".

    Raises:
        TimeLimitError: when the time is up.
    """
    if seconds is None:
        yield lambda: None
        return
    deadline = time.perf_counter() + seconds

    def stop(*_: Any) -> None:
        raise TimeLimitError(
            f"{what} took longer than {seconds:g} s; a slower controller needs a higher time limit "
            "(time_limit=, --time-limit)"
        )

    def look() -> None:
        if time.perf_counter() > deadline:
            stop()

    timer = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    if not timer:
        yield look
        return
    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield look
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)

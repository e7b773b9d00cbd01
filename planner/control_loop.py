"""A slow answer in the service of a fast loop: on time with the last good one, if need be.

    step k:   ask for a better law;  there in time  ->  play it
                                     not there      ->  play the last good one, count it, and
                                                        take the better one over when it comes

The slow part runs in a thread of its own, one request at a time. Threads of Python take turns, by
default of 5 ms; while a deadline runs, of a tenth of it.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYetError
from typing import Generic, TypeVar

import numpy as np

Array = np.ndarray
State = TypeVar("State")


class _Turns:
    """How long a thread of Python runs before another may: shorter while anyone asks for it."""

    def __init__(self) -> None:
        self._lock, self._asked, self._usual = threading.Lock(), 0, 0.0

    @contextlib.contextmanager
    def of(self, seconds: float) -> Iterator[None]:
        """Turns of at most so many seconds."""
        with self._lock:
            if self._asked == 0:
                self._usual = sys.getswitchinterval()
            self._asked += 1
            sys.setswitchinterval(max(min(sys.getswitchinterval(), seconds), 1e-6))
        try:
            yield
        finally:
            with self._lock:
                self._asked -= 1
                if self._asked == 0:
                    sys.setswitchinterval(self._usual)


_TURNS = _Turns()


class ControlLoop(Generic[State]):
    """One episode, step by step.

    Args:
        play: (state, x (n,), interval) -> controls (m,) by the law in the state, fast.
        renew: (state, x (n,), interval) -> controls and a better state, slow; it leaves the state
            as it is.
        state: at the beginning.

    Attributes:
        state: the last good one.
        late: steps whose renewal did not come in time.
    """

    def __init__(
        self,
        play: Callable[[State, Array, int], Array],
        renew: Callable[[State, Array, int], tuple[Array, State]],
        state: State,
    ) -> None:
        self._play, self._renew = play, renew
        self.state = self._first = state
        self._last = 0
        self._asked: Future[tuple[Array, State]] | None = None
        self._thread: ThreadPoolExecutor | None = None
        self.late = 0

    def step(self, x: Array, interval: int, deadline: float | None) -> Array:
        """Controls (m,) for the state x (n,) at an interval; one that goes back begins anew.

        Args:
            x: observed, finite.
            interval: of the control.
            deadline: seconds until there must be an answer; None waits for the renewal.
        """
        began = time.perf_counter()
        if interval < self._last:
            self.state, self._asked = self._first, None
        self._last = interval
        if deadline is None or (self._asked is not None and self._asked.done()):
            self._take_over()
        if deadline is None:
            u, self.state = self._renew(self.state, x, interval)
            return u
        u = self._play(self.state, x, interval)
        if self._asked is None:
            self._thread = self._thread or ThreadPoolExecutor(1, thread_name_prefix="replan")
            self._asked = self._thread.submit(self._renew, self.state, x, interval)
            with contextlib.suppress(NotYetError), _TURNS.of(0.1 * deadline):
                left = deadline - (time.perf_counter() - began)
                u, self.state = self._asked.result(max(left, 0.0))
                self._asked = None
                return u
        self.late += 1
        return u

    def _take_over(self) -> None:
        """What an earlier step asked for, waiting for it."""
        asked, self._asked = self._asked, None
        if asked is not None:
            self.state = asked.result()[1]

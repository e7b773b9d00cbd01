"""How long a controller may take: one that hangs must not cost the other rows."""

from __future__ import annotations

import contextlib
import ctypes
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

#: Longer limits are none [s]: timers of the system overflow.
_LONGEST = 1e7
#: What was stopped and went on all the same is stopped again so often [s].
_AGAIN = 0.5
#: The shortest a timer is set to [s]; 0 would switch it off.
_SOON = 1e-6


class TimeLimitError(RuntimeError):
    """A controller took longer than it was allowed to."""


@contextlib.contextmanager
def time_limit(seconds: float | None, what: str) -> Iterator[Callable[[], None]]:
    """Stop what takes longer than `seconds` (None: no limit).

    In a process's main thread a timer interrupts Python code wherever it is, also in a `predict`
    that never returns. Elsewhere (a thread of a Dask worker, Windows) another thread has the
    error raised in this one, at its next line of Python. What that cannot stop is a single call
    of compiled code that does not return: one that sleeps or waits, or that keeps the
    interpreter's lock (then nor can the timer). Between such calls, the function that this yields
    looks at the clock: call it now and then.

    Code that swallows the error is stopped again twice a second, and told when it leaves. Limits
    can be nested, and another's alarm (pytest-timeout's) still rings when it is due.

    Args:
        seconds: > 0, or None; more than 10⁷ s are no limit.
        what: took so long, for the message: "1024 episodes".

    Raises:
        TimeLimitError: when the time is up.
    """
    if seconds is None or seconds > _LONGEST:
        yield lambda: None
        return
    deadline = time.perf_counter() + seconds
    message = (
        f"{what} took longer than {seconds:g} s; a slower controller needs a higher time limit "
        "(time_limit=, --time-limit)"
    )

    def look() -> None:
        if time.perf_counter() > deadline:
            raise TimeLimitError(message)

    timer = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    with (_alarm if timer else _watched)(deadline, message):
        yield look


@contextlib.contextmanager
def _alarm(deadline: float, message: str) -> Iterator[None]:
    """Raise in the main thread, by its timer, at a deadline of `time.perf_counter`."""
    left, every = signal.setitimer(signal.ITIMER_REAL, 0.0)
    # Another's alarm that is due within the block is passed on; none is infinitely far away.
    others = time.perf_counter() + left if left > 0.0 else float("inf")
    rung = leaving = False

    def ring(number: int, stack: Any) -> None:
        nonlocal rung, others
        if leaving:
            return
        now = time.perf_counter()
        if now >= others and callable(before):
            others = now + every if every > 0.0 else float("inf")
            before(number, stack)
        if now >= deadline:
            rung = True
            raise TimeLimitError(message)
        arm()

    def arm() -> None:
        due = min(deadline, others) if callable(before) else deadline
        signal.setitimer(signal.ITIMER_REAL, max(due - time.perf_counter(), _SOON), _AGAIN)

    before = signal.signal(signal.SIGALRM, ring)
    try:
        arm()
        yield
        if rung:  # and it was swallowed
            raise TimeLimitError(message)
    finally:
        leaving = True  # first of all: from here on nothing interrupts
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL if before is None else before)
        if others < float("inf"):
            signal.setitimer(signal.ITIMER_REAL, max(others - time.perf_counter(), _SOON), every)


@contextlib.contextmanager
def _watched(deadline: float, message: str) -> Iterator[None]:
    """Raise in this thread, from another one, at a deadline of `time.perf_counter`."""

    class InterruptionError(TimeLimitError):
        """What is raised is given as a class, so the class knows the message."""

        def __init__(self) -> None:
            super().__init__(message)

    # Locks are C: an error that arrives in between cannot leave one of them taken. `inside` is
    # released on leaving.
    thread, lock, inside = threading.get_ident(), threading.Lock(), threading.Lock()
    rung = leaving = False
    inside.acquire()

    def watch() -> None:
        nonlocal rung
        wait = max(deadline - time.perf_counter(), 0.0)
        while not inside.acquire(timeout=wait):
            with lock:
                if leaving:
                    return
                rung = True
                _raise_in(thread, ctypes.py_object(InterruptionError))
            wait = _AGAIN

    try:
        try:
            threading.Thread(target=watch, name="time limit", daemon=True).start()
            yield
        finally:
            leaving = True  # first of all: from here on nothing is raised that was not already
            inside.release()
            with lock:
                if rung:  # perhaps not delivered yet
                    _raise_in(thread, ctypes.py_object())
        if rung:  # and it was swallowed
            raise TimeLimitError(message)
    except InterruptionError as error:
        raise TimeLimitError(message).with_traceback(error.__traceback__) from None


def _raise_in(thread: int, error: ctypes.py_object[Any]) -> None:
    """Raise a class of errors in a thread at its next line of Python; NULL takes it back."""
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), error)

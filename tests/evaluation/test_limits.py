"""Time limits: in the main thread, in others, nested, and against code that will not stop."""

import contextlib
import signal
import threading
import time

import pytest

from slipcar.evaluation.limits import TimeLimitError, time_limit

TOO_LONG = r"^12 episodes took longer than 0\.1 s"


def spin(seconds=5.0):
    """Python code that takes long."""
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pass


def swallow():
    """It will not be stopped, but does end when it was told several times."""
    told = 0
    while told < 3:
        try:
            spin()
        except Exception:
            told += 1
    return told


def in_thread(work):
    """What `work` returns, or the error that it raises, in another thread."""
    found = []

    def run():
        try:
            found.append(work())
        except Exception as error:
            found.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(20.0)
    assert not thread.is_alive()
    return found[0]


def limited(work):
    with time_limit(0.1, "12 episodes"):
        work()


@pytest.fixture
def alarms():
    """Times at which an alarm of somebody else rang."""
    rung = []
    before = signal.signal(signal.SIGALRM, lambda *_: rung.append(time.perf_counter()))
    yield rung
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("work", [spin, swallow, lambda: time.sleep(5.0)])
def test_what_takes_too_long_is_stopped(work):
    with pytest.raises(TimeLimitError, match=TOO_LONG):
        limited(work)
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.mark.parametrize("work", [spin, swallow])
def test_so_it_is_in_another_thread(work):
    error = in_thread(lambda: limited(work))
    assert type(error) is TimeLimitError
    with pytest.raises(TimeLimitError, match=TOO_LONG):
        raise error


def test_a_thread_that_was_in_time_is_left_alone():
    def work():
        for _ in range(200):
            with contextlib.suppress(TimeLimitError), time_limit(1e-3, "x"):
                spin(1e-3)
        spin(0.2)  # nothing that was due is raised here
        return "done"

    assert in_thread(work) == "done"


@pytest.mark.parametrize("somewhere", [in_thread, lambda work: work()])
def test_nested_limits_both_hold(somewhere):
    def work():
        found = []
        for outer, inner in ((0.2, 9.0), (9.0, 0.2)):
            try:
                with time_limit(outer, "outer"), time_limit(inner, "inner"):
                    spin()
            except TimeLimitError as error:
                found.append(str(error).split()[0])
        try:
            with time_limit(0.2, "outer"):
                with time_limit(9.0, "inner"):
                    pass
                spin()
        except TimeLimitError as error:
            found.append(str(error).split()[0])
        return found

    assert somewhere(work) == ["outer", "inner", "outer"]


def test_an_alarm_of_somebody_else_still_rings(alarms):
    handler = signal.getsignal(signal.SIGALRM)
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    with time_limit(9.0, "x"):
        pass
    assert signal.getsignal(signal.SIGALRM) is handler
    assert 0.0 < signal.getitimer(signal.ITIMER_REAL)[0] <= 0.2
    spin(0.4)
    assert len(alarms) == 1
    signal.setitimer(signal.ITIMER_REAL, 0.1, 0.1)
    with time_limit(9.0, "x"):
        spin(0.35)  # also within the block
    assert len(alarms) >= 3
    assert signal.getitimer(signal.ITIMER_REAL)[1] == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("seconds", [None, float("inf"), 1e15])
def test_no_limit(seconds):
    with time_limit(seconds, "x") as look:
        look()
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_looking_at_the_clock(monkeypatch):
    with time_limit(100.0, "x") as look:
        look()
        now = time.perf_counter()
        monkeypatch.setattr(time, "perf_counter", lambda: now + 101.0)
        with pytest.raises(TimeLimitError, match="x took longer than 100 s"):
            look()

"""Wherever work is done the values are the same, and a killed worker costs time alone."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from slipcar.evaluation.executors import LostWorkersError, open_executor, run


def values(work, tasks, executor):
    found = {}
    for task, value, error in run(work, tasks, executor):
        assert error is None, error
        found[task] = value
    return found


def square(task):
    return task * task


def odd_ones_fail(task):
    if task % 2:
        raise ValueError(f"{task} is odd")
    return task


def test_in_this_process_errors_are_told_and_the_others_go_on():
    outcomes = list(run(odd_ones_fail, range(4)))
    assert [outcome.value for outcome in outcomes] == [0, None, 2, None]
    assert [str(outcome.error) for outcome in outcomes if outcome.error] == ["1 is odd", "3 is odd"]


def test_tasks_are_taken_only_when_somebody_is_free():
    taken = []

    def tasks():
        for i in range(10):
            taken.append(i)
            yield i

    stream = run(square, tasks())
    next(stream)
    assert taken == [0]


def suicidal(folder):
    """Kills its worker the first time task 3 is done; the second time all is well."""

    def work(task, folder=str(folder)):
        mark = Path(folder) / "killed"
        if task == 3 and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.05)
        return task * task, os.environ.get("OMP_NUM_THREADS")

    return work


def test_loky_survives_a_killed_worker(tmp_path):
    with open_executor(2) as executor:
        found = values(suicidal(tmp_path), range(8), executor)
    assert (tmp_path / "killed").exists()
    assert found == {task: (task * task, "1") for task in range(8)}  # one thread in each


def test_what_kills_every_worker_is_told_and_the_others_go_on():
    def work(task):  # local, so that it is pickled by value: workers cannot import this file
        if task == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return task

    with open_executor(2) as executor:
        outcomes = {o.task: o for o in run(work, range(6), executor)}
    assert isinstance(outcomes[2].error, LostWorkersError)
    assert "died (killed, out of memory" in str(outcomes[2].error)
    assert [outcomes[i].value for i in (0, 1, 3, 4, 5)] == [0, 1, 3, 4, 5]


def test_what_cannot_be_sent_is_a_failed_task_and_errors_come_as_they_are():
    class Odd(Exception):  # noqa: N818  two arguments: it cannot be unpickled
        def __init__(self, one, two):
            super().__init__(f"{one} {two}")

    def work(task):
        if task == 1:
            raise Odd("no", "fuel")
        if task == 2:
            raise SystemExit(3)
        return task

    tasks = [0, 1, 2, threading.Lock(), 4]
    with open_executor(2) as executor:
        outcomes = {str(o.task)[:5]: o for o in run(work, tasks, executor)}
    assert str(outcomes["1"].error) == "Odd: no fuel"
    assert str(outcomes["2"].error) == "SystemExit: 3"
    assert isinstance(outcomes["<unlo"].error, Exception)
    assert (outcomes["0"].value, outcomes["4"].value) == (0, 4)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"workers": 0}, ValueError, "workers must be at least 1, not 0"),
        ({"cluster": "slurm"}, ValueError, "unknown cluster 'slurm'.*dask://HOST:PORT"),
        ({"cluster": "dask://"}, ValueError, "unknown cluster 'dask://'"),
        ({"cluster": "dask+tls"}, ValueError, r"unknown cluster 'dask\+tls'"),
        ({"cluster": "http://a:1"}, ValueError, "unknown cluster"),
    ],
)
def test_bad_clusters_are_named(options, error, message):
    with pytest.raises(error, match=message), open_executor(**options):
        pass

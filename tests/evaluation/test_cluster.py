"""The comparison on a real Dask cluster of two workers: the same bytes, also when one is killed."""

import os
import signal
import threading
import time

import pytest

from slipcar.evaluation import compare, executors
from slipcar.evaluation.executors import open_executor, worker_facts
from slipcar.planner import Feedback, OpenLoop, plan

distributed = pytest.importorskip("distributed")

EPISODES = 8000


@pytest.fixture(scope="module")
def cluster():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as running:
        yield running


@pytest.fixture
def rows(paper):
    class Slow:  # local, so that it is pickled by value: workers cannot import this file
        """Drives a plan, and lets some time pass at every step."""

        observation = "state"

        def __init__(self, controller):
            self.controller = controller

        def fingerprint(self):
            return self.controller.fingerprint()

        def predict(self, observation, **rest):
            time.sleep(0.002)
            return self.controller.predict(observation)

    planned = plan(paper)
    return {"SCP": OpenLoop(planned), "slow": Slow(Feedback(planned))}


def pids(cluster):
    return [nanny.process.pid for nanny in cluster.workers.values()]


def address(cluster):
    return cluster.scheduler_address.replace("tcp://", "dask://")


def test_the_table_is_the_same_also_when_a_worker_is_killed(rows, paper, cluster, tmp_path):
    alone = compare(rows, paper, EPISODES, folder=tmp_path / "alone", progress=False)
    killed = []

    def kill():
        deadline = time.monotonic() + 60.0
        while not list((tmp_path / "dask").rglob("*.npz")) and time.monotonic() < deadline:
            time.sleep(0.01)  # until it is under way
        victim = next(iter(pids(cluster)))
        os.kill(victim, signal.SIGKILL)
        killed.append(victim)

    killer = threading.Thread(target=kill)
    killer.start()
    spread = compare(
        rows, paper, EPISODES, cluster=address(cluster), folder=tmp_path / "dask", progress=False
    )
    killer.join()
    assert killed
    assert spread.errors == {}
    written = [c.save(tmp_path / name, figures=False) for name, c in (("a", alone), ("b", spread))]
    assert (tmp_path / "a/table.csv").read_bytes() == (tmp_path / "b/table.csv").read_bytes()
    assert len(written[0]) == len(written[1])
    # What either finished the other can use.
    again = compare(rows, paper, EPISODES, folder=tmp_path / "dask", progress=False)
    assert again.reused == tuple(rows)


def test_workers_with_other_software_are_refused(cluster, monkeypatch):
    facts = {**worker_facts(), "numpy": "0.1"}
    monkeypatch.setattr(executors, "worker_facts", lambda: facts)
    found = {"tcp://a:1": {**facts, "numpy": "9.9"}}
    with pytest.raises(ValueError, match=r"worker tcp://a:1 .* has numpy 9.9, not 0.1"):
        executors._check_versions(found, "tcp://b:2")


def test_an_address_that_does_not_answer_is_told(monkeypatch):
    monkeypatch.setattr(executors, "ANSWER", 1.0)
    with (
        pytest.raises(OSError, match=r"no Dask scheduler .*tcp://127.0.0.1:9 .*dask worker"),
        open_executor(cluster="dask://127.0.0.1:9"),
    ):
        pass

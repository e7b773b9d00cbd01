"""Where work is done: in this process, in processes of this machine (loky), or on a Dask cluster.

    with open_executor(workers=2) as executor:                   # loky, joblib's process pool
    with open_executor(cluster="dask://host:8786") as executor:  # a Dask scheduler's workers
        for task, value, error in run(work, tasks, executor):    # as they finish

Whatever does the work, the values are the same: a task says all that its value depends on. One
that raises gives its error. A worker that is killed costs time alone: what it had in hand is done
again by others; only a task that kills every worker it is given to fails.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import hashlib
import itertools
import logging
import os
import pickle
import platform
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from slipcar.envs.extras import install
from slipcar.envs.validate import checked_int
from slipcar.evaluation.provenance import code_digest, versions
from slipcar.evaluation.threads import ENVIRONMENT, one_thread

#: Seconds that a scheduler may take to answer, and a cluster may be without any worker.
ANSWER, WITHOUT_WORKERS = 10.0, 60.0
#: What `cluster` may be, for messages and help.
CLUSTERS = "loky, dask (local Dask workers), dask://HOST:PORT or dask+tls://HOST:PORT"
#: Packages whose versions must agree between this process and a cluster's workers.
_SAME = ("slipcar", "numpy", "scipy", "llvmlite")

_alone = threading.Lock()


class Outcome(NamedTuple):
    """A task that is done: its value, or what it raised."""

    task: Any
    value: Any
    error: BaseException | None


class LostWorkersError(RuntimeError):
    """A task was given up because workers died of it, or there are no workers left."""


@dataclasses.dataclass(frozen=True)
class Executor:
    """Something that work can be handed to.

    Attributes:
        name: for messages.
        workers: how many tasks are worked on at a time.
        open: a pool to submit to, with the interface of `concurrent.futures`; called again when
            the pool broke. None works in this process.
        alive: raises LostWorkersError if nobody is left to work; called while waiting.
        software: digest of the software that workers must have; None where they are this one's.
        local: whether workers see the files of this machine.
    """

    name: str = "this process"
    workers: int = 1
    open: Callable[[], Any] | None = None
    alive: Callable[[], None] = lambda: None
    software: str | None = None
    local: bool = False


def run(
    work: Callable[[Any], Any],
    tasks: Iterable[Any],
    executor: Executor | None = None,
    waiting: Callable[[], None] = lambda: None,
) -> Iterator[Outcome]:
    """Do tasks and yield them as they finish, in any order.

    Tasks are taken from the iterable when somebody is about to be free, so it may leave out those
    that have become pointless.

    Args:
        work: a function of a task, to be found by import where workers are.
        tasks: picklable.
        executor: see :func:`open_executor`; None works in this process.
        waiting: called now and then while others work.

    Raises:
        LostWorkersError: if the cluster is gone; what was yielded before is done.
    """
    if executor is None or executor.open is None:
        for task in tasks:
            try:
                with one_thread():
                    outcome = Outcome(task, work(task), None)
            except (Exception, SystemExit) as error:  # one bad task must not cost the others
                outcome = Outcome(task, None, _portable(error))
            yield outcome
        return
    yield from _run_in_pool(work, tasks, executor, waiting)


def _run_in_pool(
    work: Callable[[Any], Any],
    tasks: Iterable[Any],
    executor: Executor,
    waiting: Callable[[], None],
) -> Iterator[Outcome]:
    assert executor.open is not None
    pool, coming = executor.open(), iter(tasks)
    under_way: dict[concurrent.futures.Future, Any] = {}
    suspects: deque[Any] = deque()  # were in some worker's hands when a worker died
    alone: Any = None  # the suspect that runs by itself, to see whether it was the cause
    exhausted = False
    try:
        while not exhausted or suspects or under_way:
            # Two each, so that nobody waits for the next; suspects one at a time.
            free = 0 if suspects else 2 * executor.workers - len(under_way)
            ready = list(itertools.islice(coming, free)) if free > 0 and not exhausted else []
            exhausted = exhausted or (free > 0 and len(ready) < free)
            if suspects and not under_way:
                alone = suspects.popleft()
                ready = [alone]
            for task in ready:
                try:
                    under_way[pool.submit(_guarded, work, task, executor.software)] = task
                except concurrent.futures.BrokenExecutor:
                    suspects.append(task)
                    pool = executor.open()
                except Exception as error:  # it cannot even be sent
                    yield Outcome(task, None, error)
            if not under_way:
                continue
            done, _ = concurrent.futures.wait(
                under_way, timeout=1.0, return_when=concurrent.futures.FIRST_COMPLETED
            )
            waiting()
            if not done:
                executor.alive()
            broken = False
            for future in done:
                task = under_way.pop(future)
                try:
                    outcome = Outcome(task, future.result(), None)
                except concurrent.futures.BrokenExecutor:
                    broken = True
                    if task is alone:
                        yield Outcome(task, None, _killer(executor))
                    else:
                        suspects.append(task)
                    continue
                except concurrent.futures.CancelledError:
                    executor.alive()
                    raise LostWorkersError(
                        f"{executor.name} dropped work under way: it was shut down"
                    ) from None
                except Exception as error:
                    if type(error).__name__ == "KilledWorker":  # Dask's, after several workers
                        error = _killer(executor)
                    outcome = Outcome(task, None, error)
                yield outcome
            if broken:
                suspects.extend(under_way.values())
                under_way.clear()
                pool = executor.open()
    finally:
        for future in under_way:
            future.cancel()


def _killer(executor: Executor) -> LostWorkersError:
    return LostWorkersError(
        f"every worker of {executor.name} that had it in hand died (killed, out of memory, or a "
        "crash in compiled code)"
    )


def _guarded(work: Callable[[Any], Any], task: Any, software: str | None) -> Any:
    """In a worker: one task at a time in a process, on one thread.

    Dask workers may have several threads, but BLAS limits and planners' workspaces are the
    process's. A worker that joined a cluster late may have other software than those that were
    checked.
    """
    if software is not None and _software() != software:
        raise RuntimeError(
            f"a worker of the cluster has other software than this process: {worker_facts()}"
        )
    with _alone:
        for name, value in ENVIRONMENT.items():  # what a task may still import, torch say
            os.environ.setdefault(name, value)
        try:
            with one_thread():
                return work(task)
        except (Exception, SystemExit) as error:
            raise _portable(error) from None


def _portable(error: BaseException) -> BaseException:
    """The error itself if it can be sent between processes, else one that says the same."""
    if not isinstance(error, SystemExit):
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            pass
        else:
            return error
    told = RuntimeError(f"{type(error).__name__}: {error}")
    for note in getattr(error, "__notes__", []):
        told.add_note(note)
    return told


@contextlib.contextmanager
def open_executor(workers: int = 1, cluster: str | None = None) -> Iterator[Executor]:
    """Somebody to do the work.

    Args:
        workers: processes on this machine, >= 1; 1 without a cluster is this process itself. A
            cluster that is already running has as many as it has.
        cluster: None or "loky": processes of this machine; "dask": a Dask cluster of `workers`
            processes on this machine; "dask://HOST:PORT" or "dask+tls://HOST:PORT": the scheduler
            of a running one, whose workers must have the same slipcar and NumPy installed.

    Raises:
        ValueError: for an unknown cluster, or workers with other versions.
        ImportError: without Dask, saying what to install.
        OSError: if no scheduler answers or it has no workers.
    """
    workers = checked_int("workers", workers, at_least=1)
    if cluster is None or cluster == "loky":
        with _loky(workers) if workers > 1 else contextlib.nullcontext(Executor()) as executor:
            yield executor
        return
    scheme, _, address = str(cluster).partition("://")
    known = str(cluster) == "dask" or (scheme in ("dask", "dask+tls") and address)
    if not known:
        raise ValueError(f"unknown cluster {cluster!r}: it is one of {CLUSTERS}")
    try:
        import distributed
    except ImportError as error:
        raise ImportError(
            f"cluster={cluster!r} needs Dask ({error}): {install('cluster')}"
        ) from error
    with contextlib.ExitStack() as stack:
        if address:
            where = f"{'tls' if scheme == 'dask+tls' else 'tcp'}://{address}"
        else:
            local = distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                dashboard_address=None,
                silence_logs=logging.CRITICAL,
            )
            where = stack.enter_context(local).scheduler_address
        yield _dask(stack, where)


@contextlib.contextmanager
def _loky(workers: int) -> Iterator[Executor]:
    # joblib's own pool rather than joblib.Parallel: futures say which task was lost with a worker,
    # where Parallel gives up all of them.
    from joblib.externals.loky import get_reusable_executor

    def pool() -> Any:
        return get_reusable_executor(max_workers=workers, env=ENVIRONMENT, timeout=60)

    try:
        yield Executor(f"{workers} processes", workers, pool, local=True)
    except BaseException:  # an interruption must not wait for the tasks under way
        pool().shutdown(wait=False, kill_workers=True)
        raise


def _dask(stack: contextlib.ExitStack, address: str) -> Executor:
    import distributed

    try:
        client = stack.enter_context(
            distributed.Client(address, timeout=ANSWER, set_as_default=False)
        )
        client.wait_for_workers(1, timeout=ANSWER)
    except (OSError, TimeoutError, ValueError) as error:
        raise OSError(
            f"no Dask scheduler with workers answers at {address} within {ANSWER:g} s "
            f"({type(error).__name__}): start one with `dask scheduler`, and on each machine "
            f"`dask worker {address} --nthreads 1 --nworkers auto`"
        ) from None
    try:
        facts = client.run(worker_facts)
    except Exception as error:
        raise ValueError(
            f"the workers of the cluster at {address} cannot import slipcar "
            f"({type(error).__name__}: {error}): install the same version there"
        ) from None
    _check_versions(facts, address)
    threads = client.nthreads()
    last_seen = time.monotonic()

    def alive() -> None:
        nonlocal last_seen
        if client.status != "running":
            raise LostWorkersError(f"lost the connection to the Dask scheduler at {address}")
        if client.scheduler_info(n_workers=-1)["workers"]:
            last_seen = time.monotonic()
        elif time.monotonic() - last_seen > WITHOUT_WORKERS:
            raise LostWorkersError(
                f"the Dask cluster at {address} has had no workers for {WITHOUT_WORKERS:g} s"
            )

    executor = client.get_executor(pure=False)
    return Executor(
        f"the Dask cluster at {address}", len(threads), lambda: executor, alive, _software()
    )


def worker_facts() -> dict[str, str]:
    """Code and versions of this process, on which numbers may depend."""
    found = versions()
    return {
        "code": code_digest("envs", "planner", "policy", "core"),
        "python": platform.python_version(),
        **{name: found.get(name, "none") for name in _SAME},
    }


@functools.cache
def _software() -> str:
    return hashlib.sha256(repr(sorted(worker_facts().items())).encode()).hexdigest()


def _check_versions(workers: dict[str, dict[str, str]], address: str) -> None:
    here = worker_facts()
    for worker, facts in workers.items():
        other = [
            f"{name} {facts.get(name)}, not {value}"
            for name, value in here.items()
            if facts.get(name) != value
        ]
        if other:
            raise ValueError(
                f"worker {worker} of the cluster at {address} has {'; '.join(other)}: numbers are "
                "the same only where the software is"
            )

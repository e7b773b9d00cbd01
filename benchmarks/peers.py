"""Peers in an interpreter of their own: crocoddyl and OpenSCvx.

They are large (a gigabyte each), pin other versions than we do, and OpenSCvx sets JAX's global
switches. So each runs in a process, with any Python that has it:

    python3 -m venv build/peers && build/peers/bin/pip install crocoddyl openscvx

is found by itself; `--peers-python` names another. Parent and worker (:mod:`peer_worker`) speak
JSON, a line each way; the worker times itself, so the pipe is not in the time.
"""

from __future__ import annotations

import contextlib
import functools
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from contenders import Answer, Contender, UnavailableError

from slipcar.envs import Scenario

_FOLDER = Path(__file__).resolve().parent
_OWN_PYTHON = _FOLDER.parent / "build" / "peers" / "bin" / "python"
_WORKERS = {"crocoddyl FDDP": "peer_crocoddyl.py", "OpenSCvx": "peer_openscvx.py"}


def default_python() -> str:
    """The peers' own venv where there is one, else the running interpreter."""
    return str(_OWN_PYTHON) if _OWN_PYTHON.exists() else sys.executable


def makers(
    scenario: Scenario, python: str, stack: contextlib.ExitStack
) -> dict[str, Callable[[], Contender]]:
    """Both on one scenario, by name; their processes end with the stack."""
    return {
        name: functools.partial(_contender, name, scenario, python, script, stack)
        for name, script in _WORKERS.items()
    }


def _contender(
    name: str, scenario: Scenario, python: str, script: str, stack: contextlib.ExitStack
) -> Contender:
    worker = Worker(python, _FOLDER / script)
    stack.callback(worker.close)
    states, controls = scenario.initial_guess()
    guess = {"states": states.tolist(), "controls": controls.tolist()}
    told = worker.ask({**scenario.to_dict(), "dt": scenario.dt, **guess})
    if "missing" in told:
        raise UnavailableError(f"not installed ({told['missing']}); see benchmarks/peers.py")

    def solve() -> tuple[float, Answer]:
        reply = worker.ask("solve")
        answer = Answer(np.array(reply["controls"]), reply["iterations"], reply["found"])
        return reply["seconds"], answer

    solve()  # what cannot plan is noticed here
    return Contender(
        name=f"{name} {told['version']}",
        tolerance=told["tolerance"],
        solve=solve,
        solves=told["solves"],
        build_seconds=told["build_seconds"],
    )


class Worker:
    """A process that answers each line with a line."""

    def __init__(self, python: str, script: Path) -> None:
        self._complaints = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115
        try:
            self._process = subprocess.Popen(
                [python, str(script)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._complaints,
                text=True,
                encoding="utf-8",
            )
        except OSError as error:
            raise UnavailableError(f"cannot run {python}: {error.strerror}") from error

    def ask(self, request: Any) -> dict[str, Any]:
        """Send one request and wait for its answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        line = ""
        with contextlib.suppress(BrokenPipeError):
            print(json.dumps(request), file=self._process.stdin, flush=True)
            line = self._process.stdout.readline()
        if not line:
            self._complaints.seek(0)
            last = self._complaints.read().strip().rpartition("\n")[2]
            raise UnavailableError(f"its process ended: {last or 'without a word'}")
        return json.loads(line)

    def close(self) -> None:
        """End the process: it stops when it hears no more."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._complaints.close()

"""The worker's side of :mod:`peers`: NumPy and the peer alone, no slipcar.

First line in: the scenario with its guess. First line out: what the peer is. After that every
line in asks for one plan.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

#: A plan: controls (N−1, 2), iterations, whether it converged.
Planned = tuple[np.ndarray, int, bool]
#: Name, version, tolerance, what is solved, and the planner itself.
Peer = tuple[dict[str, str], Callable[[], Any], Callable[[Any], Planned]]


def serve(build: Callable[[dict[str, Any]], Peer]) -> None:
    """Answer until the input ends.

    Args:
        build: from the scenario to what is told of the peer, the call that is timed, and what
            reads its result; raises ImportError where the peer is not installed.
    """
    # Libraries print as they please: the real output is for answers alone.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def reply(answer: dict[str, Any]) -> None:
        print(json.dumps(answer), file=answers, flush=True)

    began = time.perf_counter()
    try:
        told, call, read = build(json.loads(sys.stdin.readline()))
    except ImportError as error:
        reply({"missing": str(error)})
        return
    reply({**told, "build_seconds": time.perf_counter() - began})
    for _ in sys.stdin:
        began = time.perf_counter()
        raw = call()
        seconds = time.perf_counter() - began
        controls, iterations, found = read(raw)
        reply(
            {
                "seconds": seconds,
                "controls": np.asarray(controls, dtype=float).tolist(),
                "iterations": int(iterations),
                "found": bool(found),
            }
        )

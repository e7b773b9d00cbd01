"""Many tasks, in order: shared out over threads, their errors named."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(
    solve: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> list[Result]:
    """What `solve` gives for each, in order; `workers` = 0 takes a thread for each processor.

    What NumPy does about overflow and its like is each thread's own: the caller's goes for all.
    """
    workers = min(workers or os.cpu_count() or 1, len(items))
    if workers <= 1:
        return [solve(item) for item in items]
    handled = np.geterr()

    def solved(item: Item) -> Result:
        with np.errstate(**handled):
            return solve(item)

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(solved, items))


@contextlib.contextmanager
def naming(name: str) -> Iterator[None]:
    """Errors that say what they are about."""
    try:
        yield
    except (TypeError, ValueError) as error:
        kind = ValueError if isinstance(error, ValueError) else TypeError
        raise kind(f"{name}: {error}") from error

"""One thread of BLAS and torch: in this process, and in workers that are started."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator

import threadpoolctl

#: What libraries read when they are loaded; for processes that have not loaded them yet.
ENVIRONMENT = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR")}


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """BLAS and torch on one thread, as in the workers.

    Threads split matrix products, and so the order of their sums, by how many there are; for
    the small matrices of a policy one is faster as well.
    """
    with threadpoolctl.threadpool_limits(1):
        torch = sys.modules.get("torch")
        if torch is None:
            yield
            return
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(threads)

"""Compiling an entry once: numba's cache on disk, kept honest and announced."""

from __future__ import annotations

import sys
import threading
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numba

_lock = threading.Lock()


def stamp(files: Iterable[Path]) -> int:
    """A number that changes with any of the files.

    numba's cache notices changes of the file an entry is in, no others; made a variable of a
    function that encloses the entry, the stamp is part of the cache's key.
    """
    return zlib.crc32(b"".join(path.read_bytes() for path in files))


def prepare(entry: Any, call: Callable[[], None]) -> None:
    """Compile an entry, or load it from numba's cache on disk, by a call that does nothing.

    Told on stderr where it takes long, which it does once after installation. LLVM's vectoriser
    would double that time and gains nothing on loops as short as the planner's.
    """
    with _lock:
        if entry.signatures:
            return
        if not _on_disk(entry):
            say = "slipcar: compiling the planner (once; kept on disk by numba) ..."
            print(say, file=sys.stderr, flush=True)
        config: Any = numba.config
        before, config.LOOP_VECTORIZE = config.LOOP_VECTORIZE, 0
        try:
            call()
        finally:
            config.LOOP_VECTORIZE = before


def _on_disk(entry: Any) -> bool:
    """Whether numba's cache has an index for the entry; True where that cannot be told."""
    try:
        return Path(entry._cache._cache_file._index_path).exists()
    except AttributeError:  # not a documented place
        return True

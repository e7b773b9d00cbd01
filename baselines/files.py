"""Files that are either whole or absent: a killed process leaves no half-written one."""

from __future__ import annotations

import os
from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Write beside `path`, then rename over it in one step of the file system.

    Args:
        path: the file; its folder is made if it is missing.
        content: the whole of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # The process id keeps two runs that write the same file from sharing a temporary one.
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)

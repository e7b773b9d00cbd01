"""Files that are either whole or absent: a killed process leaves no half-written one."""

from __future__ import annotations

import contextlib
import os
import platform
import re
from pathlib import Path


def write_atomically(path: Path, content: bytes) -> None:
    """Write beside `path`, then rename over it in one step of the file system.

    Args:
        path: the file; its folder is made if it is missing.
        content: the whole of it.

    Raises:
        OSError: if it cannot be written, naming `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Host and process keep two runs that write the same file from sharing a temporary one.
    temporary = path.with_name(f".{path.name}.{_host()}-{os.getpid()}")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is None:
            raise
        # It names the temporary file, which nobody asked for.
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of :func:`write_atomically` whose process was killed.

    Only those of this machine: whether a process of another is alive cannot be told.

    Args:
        folder: its own files, not those of folders in it; it need not exist.
    """
    for path in folder.glob(f".*.{_host()}-*"):
        pid = path.name.rpartition("-")[2]
        if pid.isdecimal() and not _alive(int(pid)):
            path.unlink(missing_ok=True)


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9]", "", platform.node()) or "host"


def _alive(pid: int) -> bool:
    if os.name != "posix":  # signal 0 is Ctrl-C there
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True

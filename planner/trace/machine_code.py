"""Machine code from LLVM's assembly, kept on disk.

A file holds one object under the hash of what it was made from: the structure of the expressions,
the generator's own source, the versions and the processor. So it can never be yesterday's code. It
is written atomically; one that is damaged or foreign is compiled anew, and a folder that cannot be
written to is done without.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

#: void f(int64 K, int64 address of the table of addresses); the lock of Python is let go.
PROTOTYPE = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)
#: Beyond so many characters of assembly LLVM's optimiser takes longer than its work saves.
_OPTIMISED = 1_000_000
_lock = threading.RLock()
_told: set[str] = set()


def available() -> bool:
    """Whether there is LLVM (the package llvmlite)."""
    return _machine() is not None


@functools.cache
def _machine() -> Any:
    """LLVM's target machines, unoptimised and optimised, or None without llvmlite."""
    try:
        import llvmlite.binding as llvm
    except ImportError:
        return None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    features = llvm.get_host_cpu_features().flatten()
    return [
        target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, opt=opt)
        for opt in (0, 1)
    ]


@functools.cache
def _surroundings() -> bytes:
    """What object code depends on beside its assembly: processor, LLVM, this package's source."""
    import llvmlite
    import llvmlite.binding as llvm

    digest = hashlib.sha256()
    for text in (llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten(),
                 llvmlite.__version__, llvm.get_process_triple()):  # fmt: skip
        digest.update(text.encode() + b"\0")
    planner = Path(__file__).parents[1]
    for room in ("trace", "problem", "moments", "lq", "newton"):
        for path in sorted((planner / room).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.digest()


class Code:
    """Functions of one object file, loaded into this process.

    Args:
        data: the object file.
        names: of its functions.

    Attributes:
        functions: by name, to be called with K and the address of a table of addresses.
    """

    def __init__(self, data: bytes, names: Sequence[str]) -> None:
        import llvmlite.binding as llvm

        with _lock:
            # An engine owns its machine, so each has one of its own.
            target = llvm.Target.from_default_triple()
            self._engine = llvm.create_mcjit_compiler(
                llvm.parse_assembly(""), target.create_target_machine()
            )
            self._engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(data))
            self._engine.finalize_object()
            self.functions = {
                name: PROTOTYPE(self._engine.get_function_address(name)) for name in names
            }


def code(key: bytes, names: Sequence[str], assembly: Callable[[], str], estimate: str = "") -> Code:
    """Functions known by a key: from disk, or from the assembly.

    Args:
        key: of all that the assembly is made from but this package's source.
        names: of the functions.
        assembly: makes the text; called where there is no object file.
        estimate: what to say on stderr before a long compilation; empty says nothing.
    """
    path = _file(hashlib.sha256(_surroundings() + key).hexdigest())
    data = _read(path)
    if data is not None:
        try:
            return Code(data, names)
        except Exception:  # whatever LLVM says of a file that is no object code
            tell_once(f"the cached code {path} is unusable: compiled anew")
    if estimate:
        print(f"slipcar: {estimate}", file=sys.stderr, flush=True)
    data = compiled(assembly())
    _write(path, data)
    return Code(data, names)


def compiled(assembly: str) -> bytes:
    """An object file."""
    import llvmlite.binding as llvm

    with _lock:
        module = llvm.parse_assembly(assembly)
        module.verify()
        return _machine()[len(assembly) <= _OPTIMISED].emit_object(module)


def tell_once(message: str) -> None:
    """Say something on stderr, once in a process."""
    if message not in _told:
        _told.add(message)
        print(f"slipcar: {message}", file=sys.stderr, flush=True)


@functools.cache
def folder() -> Path | None:
    """Where object files are kept: SLIPCAR_CACHE_DIR, else the user's cache; None without a home."""
    given = os.environ.get("SLIPCAR_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    try:
        base = Path(given) if given else Path.home() / ".cache"
    except RuntimeError:  # no home directory
        return None
    return base if os.environ.get("SLIPCAR_CACHE_DIR") else base / "slipcar"


def _file(name: str) -> Path | None:
    place = folder()
    return None if place is None else place / f"{name}.o"


def _read(path: Path | None) -> bytes | None:
    """The object in a file, if it is there and whole: its hash goes before it."""
    try:
        content = path.read_bytes() if path is not None else b""
    except OSError:
        return None
    digest, data = content[:32], content[32:]
    if not content:
        return None
    if hashlib.sha256(data).digest() != digest:
        tell_once(f"the cached code {path} is damaged: compiled anew")
        return None
    return data


def _write(path: Path | None, data: bytes) -> None:
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(data).digest() + data)
        os.replace(temporary, path)
    except OSError:  # a read-only or full disk: compiled again next time
        return

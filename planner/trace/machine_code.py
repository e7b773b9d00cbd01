"""Machine code from LLVM's assembly, kept on disk.

A file holds one object under the hash of what it was made from: the structure of the expressions,
the generator's own source, the versions and the processor. So it can never be yesterday's code. It
is written atomically; one that is damaged or foreign is compiled anew, and a folder that cannot be
written to is done without. Of more than 500 files the oldest are removed.
"""

from __future__ import annotations

import contextlib
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

#: void f(int64 K, int64 address of the table of addresses): those that let go of Python's lock, and
#: those that are over before another thread could take it.
LONG = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)
SHORT = ctypes.PYFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)
#: Beyond so many characters of assembly LLVM's optimiser takes longer than its work saves.
_OPTIMISED = 1_000_000
#: Most files that are kept.
_KEPT = 500
_lock = threading.RLock()
_told: set[str] = set()


def available() -> bool:
    """Whether there is LLVM (the package llvmlite)."""
    return _machine(1) is not None


@functools.cache
def _machine(opt: int) -> Any:
    """LLVM's target machine for a level of optimisation, or None without llvmlite."""
    try:
        import llvmlite.binding as llvm
    except ImportError:
        return None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    features = llvm.get_host_cpu_features().flatten()
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, opt=opt)


@functools.cache
def _surroundings() -> bytes:
    """What object code depends on beside its assembly: processor, LLVM, this package's source."""
    import llvmlite
    import llvmlite.binding as llvm

    features = llvm.get_host_cpu_features().flatten()
    processor = (llvm.get_host_cpu_name(), features, llvm.get_process_triple())
    digest = hashlib.sha256(repr((*processor, llvmlite.__version__)).encode())
    for room in ("trace", "problem", "moments", "lq", "newton"):
        for path in sorted((Path(__file__).parents[1] / room).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.digest()


class Code:
    """Functions of one object file, loaded into this process, by name: `short` and `long` ones.

    They are the same, called with K and the address of a table of addresses.
    """

    def __init__(self, data: bytes, names: Sequence[str]) -> None:
        import llvmlite.binding as llvm

        with _lock:
            # An engine owns its machine, so each has one of its own.
            machine = llvm.Target.from_default_triple().create_target_machine()
            self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
            self._engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(data))
            self._engine.finalize_object()
            addresses = {name: self._engine.get_function_address(name) for name in names}
            self.short = {name: SHORT(address) for name, address in addresses.items()}
            self.long = {name: LONG(address) for name, address in addresses.items()}


def code(key: bytes, names: Sequence[str], assembly: Callable[[], str], estimate: str = "") -> Code:
    """The named functions, from disk or from the assembly, which is made only where it is needed.

    The key is that of all that goes into it but our source; a long compilation is announced.
    """
    place, name = folder(), hashlib.sha256(_surroundings() + key).hexdigest()
    path = None if place is None else place / f"{name}.o"
    data = _read(path)
    if data is not None:
        try:
            return Code(data, names)
        except Exception:  # whatever LLVM says of a file that is no object code
            tell_once(f"the cached code {path} is unusable: compiled anew")
    if estimate:
        print(f"slipcar: {estimate}", file=sys.stderr, flush=True)
    data = compiled(assembly())
    if path is not None:
        with contextlib.suppress(OSError):  # a read-only or full disk: compiled again next time
            _write(path, data)
    return Code(data, names)


def compiled(assembly: str) -> bytes:
    """An object file."""
    import llvmlite.binding as llvm

    with _lock:
        module = llvm.parse_assembly(assembly)
        module.verify()
        return _machine(int(len(assembly) <= _OPTIMISED)).emit_object(module)


def tell_once(message: str) -> None:
    """Say something on stderr, once in a process."""
    if message not in _told:
        _told.add(message)
        print(f"slipcar: {message}", file=sys.stderr, flush=True)


@functools.cache
def folder() -> Path | None:
    """Where object files are kept; None without a home."""
    own, users = (os.environ.get(name) for name in ("SLIPCAR_CACHE_DIR", "XDG_CACHE_HOME"))
    try:
        return Path(own) if own else Path(users or Path.home() / ".cache") / "slipcar"
    except RuntimeError:  # no home directory
        return None


def _read(path: Path | None) -> bytes | None:
    """The object in a file, if it is there and whole: its hash goes before it."""
    try:
        content = path.read_bytes() if path is not None else b""
    except OSError:
        return None
    if hashlib.sha256(content[32:]).digest() == content[:32]:
        return content[32:]
    if content:
        tell_once(f"the cached code {path} is damaged: compiled anew")
    return None


def _write(path: Path, data: bytes) -> None:
    """Write an object into a file, all or nothing, and remove the oldest files of its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(data).digest() + data)
        os.replace(temporary, path)
    except OSError:
        os.unlink(temporary)
        raise
    for old in sorted(path.parent.glob("*.o"), key=os.path.getmtime)[:-_KEPT]:
        old.unlink(missing_ok=True)

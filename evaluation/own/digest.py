"""A digest of what a function does: its code, and whatever that refers to.

Stored rows of a comparison are reused where the controller is the same. A function is the same if
its code is, the values in its closure and defaults, and the globals that it names, followed to
the end. What cannot be followed makes the answer None: better driven twice than wrong.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import inspect
import sys
import types
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

#: Identity -> place in the order of visits, and the value.
_Seen = dict[int, tuple[int, Any]]
_PLAIN = (type(None), type(...), bool, int, float, complex, str, bytes, np.generic)


#: Names by which global generators are drawn from, of Python, NumPy and torch.
_RANDOM = {
    "random", "rand", "randn", "randint", "rand_like", "randn_like", "bernoulli", "multinomial",
}  # fmt: skip
#: Members of a class that change nothing; pickling adds `__slotnames__`.
_NOT_BEHAVIOUR = {
    "__dict__", "__weakref__", "__doc__", "__module__", "__annotations__", "__slotnames__",
    "__firstlineno__", "__static_attributes__",
}  # fmt: skip


class _UnknownError(Exception):
    """Something whose behaviour cannot be told."""


def behaviour_digest(thing: Any) -> str | None:
    """Hexadecimal digest of a function's, a network's or an object's behaviour, or None.

    Installed packages count by name and version, modules of the user by the bytes of their file.
    """
    digest = hashlib.sha256()
    try:
        for part in _parts(thing, {}):
            digest.update(repr(part).encode() if isinstance(part, str) else part)
            digest.update(b"\0")
    except (_UnknownError, RecursionError, OSError):
        return None
    return digest.hexdigest()


def _parts(value: Any, seen: _Seen) -> Iterator[str | bytes]:
    """Everything that a value's behaviour depends on, as text and bytes in a fixed order."""
    if isinstance(value, _PLAIN):
        yield f"{type(value).__name__} {value!r}"
        return
    if id(value) in seen:  # a cycle, or met before: by its place
        yield f"again {seen[id(value)][0]}"
        return
    seen[id(value)] = (len(seen), value)  # kept alive: another must not get its identity
    if hasattr(value, "detach") and hasattr(value, "cpu"):  # torch's tensors and parameters
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise _UnknownError
        yield f"array {value.dtype} {value.shape}"
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, Mapping):
        yield f"{type(value).__name__} of {len(value)}"
        yield from _each((part for item in value.items() for part in item), seen)
    elif isinstance(value, (list, tuple)):
        yield f"{type(value).__name__} of {len(value)}"
        yield from _each(value, seen)
    elif isinstance(value, (set, frozenset)):
        yield f"{type(value).__name__} of {len(value)}"
        yield from _each(sorted(value, key=repr), seen)
    elif isinstance(value, types.ModuleType):
        yield from _module(value, seen)
    elif isinstance(value, types.CodeType):
        yield from _code(value, seen)
    elif isinstance(value, types.FunctionType):
        yield from _function(value, seen)
    elif isinstance(value, types.MethodType):
        yield from _each((value.__func__, value.__self__), seen)
    elif isinstance(value, functools.partial):
        yield from _each((value.func, value.args, value.keywords), seen)
    elif isinstance(value, (staticmethod, classmethod)):
        yield from _each((value.__func__,), seen)
    elif isinstance(value, property):
        yield from _each((value.fget,), seen)
    elif inspect.isbuiltin(value) or isinstance(value, np.ufunc):
        yield f"built in {getattr(value, '__module__', '')} {value.__name__}"
        of = getattr(value, "__self__", None)  # a method holds its object, a function its module
        yield from () if isinstance(of, types.ModuleType) else _parts(of, seen)
    elif isinstance(value, type):
        yield from _class(value, seen)
    else:
        yield from _object(value, seen)


def _each(values: Iterable[Any], seen: _Seen) -> Iterator[str | bytes]:
    for value in values:
        yield from _parts(value, seen)


def _code(code: types.CodeType, seen: _Seen) -> Iterator[str | bytes]:
    yield code.co_code
    yield " ".join((*code.co_names, *code.co_varnames, *code.co_freevars))
    yield from _each(code.co_consts, seen)


def _function(function: types.FunctionType, seen: _Seen) -> Iterator[str | bytes]:
    if installed := _package(function.__module__):
        yield f"{installed} {function.__qualname__}"
        return
    yield from _parts(function.__code__, seen)
    # Its attributes say how it is called: per_row, observation, rows.
    yield from _each((function.__defaults__, function.__kwdefaults__, function.__dict__), seen)
    for cell in function.__closure__ or ():
        yield from _parts(cell.cell_contents, seen)
    names = _names(function.__code__)
    if names & _RANDOM:
        raise _UnknownError
    for name in sorted(names):
        if name in function.__globals__:
            yield f"global {name}"
            yield from _parts(function.__globals__[name], seen)


def _names(code: types.CodeType) -> set[str]:
    """Names that a function and those inside it look up, attributes among them."""
    inner = (const for const in code.co_consts if isinstance(const, types.CodeType))
    return set(code.co_names).union(*map(_names, inner))


def _class(kind: type, seen: _Seen) -> Iterator[str | bytes]:
    if installed := _package(kind.__module__):
        yield f"{installed} {kind.__qualname__}"
        return
    yield f"class {kind.__qualname__}"
    yield from _each(kind.__bases__, seen)
    for name, value in sorted(vars(kind).items()):
        if name in _NOT_BEHAVIOUR:
            continue
        if isinstance(value, (types.MemberDescriptorType, types.GetSetDescriptorType)):
            continue
        yield f"member {name}"
        yield from _parts(value, seen)


def _object(value: Any, seen: _Seen) -> Iterator[str | bytes]:
    """Its own fingerprint; else its class and what it holds."""
    yield from _parts(type(value), seen)
    own = getattr(value, "fingerprint", None)
    if callable(own):
        told = own()
        if not isinstance(told, str):
            raise _UnknownError
        yield told
    elif dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        yield from _each(((name, getattr(value, name)) for name in names), seen)
    elif hasattr(value, "__dict__") and type(value).__reduce__ is object.__reduce__:
        yield from _parts(vars(value), seen)
    else:  # written in C, or pickled in a way of its own: it may hold what cannot be seen
        raise _UnknownError


def _module(module: types.ModuleType, seen: _Seen) -> Iterator[str | bytes]:
    if installed := _package(module.__name__):
        yield f"{installed} {module.__name__}"
        return
    if not getattr(module, "__file__", None):
        raise _UnknownError
    yield Path(str(module.__file__)).read_bytes()
    own = {name: value for name, value in sorted(vars(module).items()) if name[:2] != "__"}
    yield from _parts(own, seen)  # what it imports, and what it read when it was imported


def _package(name: str | None) -> str:
    """Name and version of the installed package a module is of; empty for a user's own."""
    top = (name or "").partition(".")[0]
    if top == "slipcar":  # keys of stored rows hold a digest of all of it
        return top
    if top in sys.stdlib_module_names and top != "__main__":
        return f"python {sys.version_info[:3]} {top}"
    module = sys.modules.get(top)
    folders = Path(str(getattr(module, "__file__", None) or "")).parts
    if not {"site-packages", "dist-packages"} & set(folders):
        return ""  # of the user, perhaps installed as editable: its version says nothing
    version = getattr(module, "__version__", None) or _version(top)
    return f"{top} {version}" if version else ""


@functools.cache
def _version(top: str) -> str:
    """Version of the distribution that a top-level module was installed with."""
    names = importlib.metadata.packages_distributions().get(top)
    return importlib.metadata.version(names[0]) if names else ""

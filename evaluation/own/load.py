"""Controllers by name: the user's own, from modules, files and installed packages.

    [NAME=]module:object            [NAME=]path/to/file.py:object
    [NAME=]model.zip                a Stable-Baselines3 model; loading runs code: `trust`
    [NAME=]plan.npz                 a stored plan
    [NAME=]policy.safetensors       a stored policy, or its folder
    [NAME=]WORD                     an entry point of the group `slipcar.controllers`

What an object may be is said by :func:`slipcar.evaluation.own.as_controller.as_controller`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib
import importlib.metadata
import importlib.util
import operator
import os
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.controller import Controller
from slipcar.evaluation.own.as_controller import as_controller
from slipcar.evaluation.own.digest import behaviour_digest

if TYPE_CHECKING:
    from slipcar.planner import Plan

__all__ = [
    "GROUP",
    "OwnMaker",
    "entry_points",
    "load_controller",
    "load_maker",
    "load_object",
    "split_name",
]

#: Entry points of this group are controllers by name.
GROUP = "slipcar.controllers"
_FORMS = (
    "module:object, path/to/file.py:object, a Stable-Baselines3 model's .zip, a plan's .npz, or a "
    "policy's .safetensors or folder"
)


def load_controller(
    text: str, scenario: Scenario | str, *, trust: bool = False
) -> tuple[str, Controller]:
    """The controller that a text names, and what to call its row.

    Modules are looked for in the current folder as well, files beside themselves. Importing them
    runs them: they are code that the user names.

    Args:
        text: see the module's docstring; without NAME= the row is called after the file or object.
        scenario: where it is to drive.
        trust: whether a model may be loaded by unpickling, which runs whatever code is in it.

    Raises:
        ValueError: if there is no such module, object, file or entry point, if it is no
            controller, or if `trust` is needed.
        OSError: if a file cannot be read.
        ImportError: if Stable-Baselines3 is needed and not installed.
    """
    name, maker = load_maker(text, trust=trust)
    return name, maker(Scenario.of(scenario))


def load_maker(text: str, *, trust: bool = False) -> tuple[str, OwnMaker]:
    """What makes the controller that a text names for any scenario, and what to call its row.

    Raises:
        ValueError: as :func:`load_controller`, but for what shows only in a scenario.
        OSError: if a file cannot be read.
        ImportError: if Stable-Baselines3 is needed and not installed.
    """
    name, source = split_name(text)
    path = Path(source)
    thing: Any
    if path.suffix == ".zip":
        from slipcar.evaluation.own.sb3_models import load_model

        own, thing = path.stem, load_model(path, trust=trust)
    elif path.suffix == ".npz":
        from slipcar.planner import Plan

        own, thing = path.stem, StoredPlan(Plan.load(path))
    elif ":" in source:
        module, _, attribute = source.rpartition(":")
        own = f"{Path(module).stem if module.endswith('.py') else module}:{attribute}"
        thing = load_object(source)
    elif path.suffix in (".safetensors", ".json") or path.is_dir():
        from slipcar.baselines import load_policy

        own, thing = path.stem, load_policy(path)
    else:
        own, thing = source, _entry_point(source)
    return name or own, OwnMaker(thing, own)


def load_object(source: str) -> Any:
    """What `module:object` or `path/to/file.py:object` names; importing it runs the user's code.

    Raises:
        ValueError: if there is no such module, file or object, or importing it raises.
    """
    module, colon, attribute = source.rpartition(":")
    if not (module and colon and attribute):
        raise ValueError(f"{source!r} is neither module:object nor path/to/file.py:object")
    return _attribute(_imported(module), attribute, source)


@dataclasses.dataclass(frozen=True)
class OwnMaker:
    """Makes a controller of one's own for any scenario.

    Attributes:
        thing: what :func:`slipcar.evaluation.own.as_controller.as_controller` understands.
        name: what errors call it.
    """

    thing: Any
    name: str

    def __call__(self, scenario: Scenario) -> Controller:
        """The controller for this scenario, tried on its first step."""
        return as_controller(self.thing, scenario, self.name)

    def fingerprint(self) -> str | None:
        """Identifies what it makes, given the scenario; None if that cannot be told."""
        return behaviour_digest(self.thing)


@dataclasses.dataclass(frozen=True)
class StoredPlan:
    """A plan of a file: played by the clock, or with its gains.

    Attributes:
        plan: as stored.
    """

    plan: Plan

    def __call__(self, scenario: Scenario) -> Controller:
        """Its controller; the world it is played in says how actions scale."""
        from slipcar.planner import Feedback, OpenLoop

        found = self.plan.replace(problem=scenario)
        return OpenLoop(found) if found.gains is None else Feedback(found)

    def fingerprint(self) -> str:
        """Identifies what it plays."""
        gains = b"" if self.plan.gains is None else self.plan.gains.tobytes()
        arrays = (self.plan.times, self.plan.mean, self.plan.controls)
        return hashlib.sha256(b"".join(a.tobytes() for a in arrays) + gains).hexdigest()[:16]


def split_name(text: str) -> tuple[str | None, str]:
    """NAME and the rest of `NAME=rest`; None and the text if it has no name.

    What stands before the first `=` is a name unless it has a path's separator in it, or the
    whole text is an existing file.

    Raises:
        ValueError: for an empty name or an empty rest.
    """
    name, equals, rest = text.partition("=")
    named = equals and "/" not in name and os.sep not in name and not Path(text).exists()
    if not named:
        name, rest = "-", text
    if not name.strip() or not rest.strip():
        raise ValueError(f"a controller is [NAME=]{_FORMS}, not {text!r}")
    return (name.strip() if named else None), rest.strip()


def entry_points() -> dict[str, importlib.metadata.EntryPoint]:
    """Controllers that installed packages offer, by name (group `slipcar.controllers`).

    Raises:
        ValueError: if two packages offer one of the same name.
    """
    found: dict[str, importlib.metadata.EntryPoint] = {}
    for point in importlib.metadata.entry_points(group=GROUP):
        other = found.setdefault(point.name, point)
        if other.value != point.value:
            raise ValueError(
                f"two installed packages offer a controller {point.name!r}: {_origin(other)} and "
                f"{_origin(point)}; name one of them as module:object"
            )
    return found


def _origin(point: importlib.metadata.EntryPoint) -> str:
    told = f" of {point.dist.name}" if point.dist is not None else ""
    return f"{point.value}{told}"


def _entry_point(word: str) -> Any:
    known = entry_points()
    if word not in known:
        offered = f"installed packages offer {sorted(known)}" if known else "none is installed"
        raise ValueError(
            f"unknown controller {word!r}: it is {_FORMS}, or the name of an entry point of "
            f"{GROUP} ({offered})"
        )
    try:
        return known[word].load()
    except Exception as error:
        raise ValueError(
            f"the controller {word!r} ({_origin(known[word])}) cannot be loaded: "
            f"{type(error).__name__}: {error}"
        ) from error


def _attribute(module: types.ModuleType, attribute: str, source: str) -> Any:
    try:
        return operator.attrgetter(attribute)(module)
    except AttributeError:
        offered = [name for name in vars(module) if not name.startswith("_")]
        raise ValueError(
            f"{source}: {module.__name__} has no {attribute!r}; it has {offered}"
        ) from None


def _imported(name: str) -> types.ModuleType:
    """A module by name, from the current folder too, or by its file."""
    path = Path(name)
    if name.endswith(".py") or "/" in name or os.sep in name:
        if not path.is_file():
            raise ValueError(f"there is no file {name!r} (in {Path.cwd()})")
        return _run(name, lambda: _from_file(path.resolve()))
    if not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(f"{name!r} is neither a module's name nor a .py file")
    _search(Path.cwd())
    try:
        known = name in sys.modules or importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # of a parent
        known = False
    if not known:
        raise ValueError(
            f"there is no module {name!r}, neither installed nor in {Path.cwd()}; a file is named "
            f"by its path, such as folder/{name.replace('.', '/')}.py"
        )
    return _run(name, lambda: importlib.import_module(name))


def _run(name: str, load: Callable[[], types.ModuleType]) -> types.ModuleType:
    """Import; what is the user's own is then sent to workers whole.

    They may be on another machine, or may have been started before its folder was searched.
    """
    before = set(sys.modules)
    try:
        module = load()
    except (Exception, SystemExit) as error:  # scripts that parse their arguments exit
        raise ValueError(f"importing {name} raised {type(error).__name__}: {error}") from error
    new = [sys.modules[other] for other in set(sys.modules) - before if other in sys.modules]
    picklers = _picklers()
    for found in {id(part): part for part in (module, *new)}.values():
        if _is_own(found):
            for pickler in picklers:
                pickler.register_pickle_by_value(found)
    return module


def _from_file(path: Path) -> types.ModuleType:
    """The module of a file, as `python file.py` finds what it imports; the same file once."""
    digest = hashlib.sha256(f"{path}{path.stat().st_mtime_ns}".encode()).hexdigest()[:8]
    name = f"{path.stem}_{digest}"  # never that of an installed module
    if name in sys.modules:
        return sys.modules[name]
    _search(path.parent)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _search(folder: Path) -> None:
    """Last, so that nothing in it hides an installed package."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def _is_own(module: Any) -> bool:
    """Whether a module is the user's, not an installed one (or slipcar's, or Python's)."""
    name, file = getattr(module, "__name__", ""), getattr(module, "__file__", None)
    if not file or name.partition(".")[0] in {"slipcar", *sys.stdlib_module_names}:
        return False
    return not {"site-packages", "dist-packages"} & set(Path(str(file)).parts)


def _picklers() -> list[Any]:
    """What sends objects to workers: cloudpickle, of which older joblibs have a copy."""
    found = []
    for name in ("cloudpickle", "joblib.externals.cloudpickle"):
        with contextlib.suppress(ImportError):
            found.append(importlib.import_module(name))
    return found

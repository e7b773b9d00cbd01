"""Plans in .npz files: arrays as they are, the rest as JSON. No pickled code is read."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import numbers
import os
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np

from slipcar.planner import records
from slipcar.planner.actuation import Actuation
from slipcar.planner.problem.numbers import finite
from slipcar.planner.records import Columns, Iteration
from slipcar.planner.search.risk import Risk
from slipcar.planner.status import Status

Array = np.ndarray

#: 2: running costs, alternatives, horizons tried. 3: expected cost and risk. 4: actuation.
_FORMAT, _READ = 4, (2, 3, 4)
_ARRAYS = ("times", "mean", "controls", "covariance", "guess", "A", "B", "gains")
_SCALARS = (
    "effort", "obstacle_cost", "running_cost", "variance", "iterations", "solve_time", "message",
)  # fmt: skip
#: What a file that is no plan's, or no longer one's, makes of the steps that read it.
_DAMAGE = (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError)
_COLUMNS = [field.name for field in dataclasses.fields(Iteration)]


def write(plan: Any, path: str | os.PathLike[str]) -> Path:
    """Write a plan, atomically; see `Plan.save`."""
    path = _named(path)
    arrays = {name: getattr(plan, name) for name in _ARRAYS if getattr(plan, name) is not None}
    arrays |= {f"multipliers.{k}": v for k, v in plan.multipliers.as_dict().items()}
    arrays |= {f"history.{k}": v for k, v in _columns(plan.history).items()}
    actuation = plan.actuation
    if plan.problem is not None:
        actuation = Actuation.of(plan.problem, plan.controls.shape[1])
    if actuation is not None:
        arrays |= {f"actuation.{k}": v for k, v in actuation.as_dict().items()}
    header = {
        "format": _FORMAT,
        "status": plan.status.name,
        "options": plan.options,
        "problem": _problem_to_data(plan.problem),
        "alternatives": [
            {**dataclasses.asdict(row), "status": row.status.name} for row in plan.alternatives
        ],
        "time_search": [dataclasses.asdict(row) for row in plan.time_search],
        "expected": None if plan.expected is None else dataclasses.asdict(plan.expected),
        "risk": None if plan.risk is None else plan.risk.as_dict(),
        **{name: getattr(plan, name) for name in _SCALARS},
    }
    arrays["header"] = np.array(json.dumps(header, default=_plain))
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp.npz")
    try:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is None:
            raise
        # It names the temporary file, which nobody asked for.
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    return path


def _named(path: str | os.PathLike[str]) -> Path:
    """The file of a plan of this name."""
    path = Path(path)
    return path if path.suffix == ".npz" else path.with_name(path.name + ".npz")


def _plain(value: Any) -> Any:
    """NumPy's scalars and arrays as JSON's numbers and lists."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"a plan's options must be numbers and texts to be saved, not {value!r}")


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The fields of the plan that :func:`write` wrote; see `Plan.load`."""
    named = _named(path)
    file_path = named if named.is_file() else Path(path)  # a file may have been renamed
    if not file_path.is_file():
        beside = "" if named == Path(path) else f" or {named}"
        raise FileNotFoundError(f"no plan at {path}{beside}")
    try:
        # Opened here, for NumPy leaves open what turns out not to be a zip file.
        with open(file_path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop("header")))
        version = header.get("format")
    except Exception as error:  # zipfile, NumPy and JSON each raise their own
        raise ValueError(f"{path} is not a plan or is damaged: {error}") from error
    if version not in _READ:
        raise ValueError(f"{path} has plan format {version!r}; this version reads {list(_READ)}")
    try:
        fields = _fields(arrays, header)
        _check(fields)
    except _DAMAGE as error:
        raise ValueError(f"{path} is not a plan or is damaged: {error!r}") from error
    return fields


def _fields(arrays: dict[str, Array], header: dict[str, Any]) -> dict[str, Any]:
    """A plan's fields from what is in its file."""
    expected, risk = header.get("expected"), header.get("risk")  # not in format 2
    problem = _problem_from_data(header["problem"])
    actuation = _strip(arrays, "actuation.") if problem is None else {}  # not before 4
    return {
        **{name: arrays[name] for name in _ARRAYS if name != "gains"},
        **{name: header[name] for name in _SCALARS},
        "gains": arrays.get("gains"),
        "status": Status[header["status"]],
        "history": _history(_strip(arrays, "history.")),
        "multipliers": records.Multipliers.from_dict(_strip(arrays, "multipliers.")),
        "options": header["options"],
        "problem": problem,
        "actuation": Actuation.from_dict(actuation) if actuation else None,
        "alternatives": tuple(_alternative(row) for row in header["alternatives"]),
        "time_search": tuple(records.TimeStep(**row) for row in header["time_search"]),
        "expected": records.ExpectedCost(**expected) if expected else None,
        "risk": Risk.from_dict(risk) if risk else None,
    }


def _check(fields: dict[str, Any]) -> None:
    """Raise ValueError unless arrays are of one plan and the rest is of its type."""
    (N,) = finite("times", fields["times"], (None,)).shape
    n = finite("mean", fields["mean"], (N, None)).shape[1]
    m = finite("controls", fields["controls"], (N - 1, None)).shape[1]
    shapes = {
        "covariance": (N, n, n), "guess": (N, n), "A": (N - 1, n, n), "B": (N - 1, n, m),
        "gains": (N - 1, m, n),
    }  # fmt: skip
    for name in ("times", "mean", "controls", *shapes):
        array = fields[name]
        if array is None:  # gains alone may be
            continue
        if array.dtype.kind != "f" or array.shape != shapes.get(name, array.shape):
            raise ValueError(
                f"{name} must be real of shape {shapes[name]}, not {array.dtype} of {array.shape}"
            )
    for name in _SCALARS:
        kind = str if name == "message" else numbers.Real
        if not isinstance(fields[name], kind):
            raise ValueError(f"{name} must be a {kind.__name__}, not {fields[name]!r}")
    if not isinstance(fields["options"], dict):
        raise ValueError(f"options must be an object, not {fields['options']!r}")
    if (actuation := fields["actuation"]) is not None:
        actuation.check(n, m)


def _alternative(row: dict[str, Any]) -> records.Alternative:
    kind = row["homotopy"]
    kind = tuple(kind) if isinstance(kind, list) else kind
    return records.Alternative(**{**row, "status": Status[row["status"]], "homotopy": kind})


def _strip(arrays: dict[str, Array], prefix: str) -> dict[str, Array]:
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _columns(history: Sequence[Iteration]) -> dict[str, Array]:
    if not history:
        return {}
    if isinstance(history, Columns):
        return history.columns
    return {name: np.stack([getattr(row, name) for row in history]) for name in _COLUMNS}


def _history(columns: dict[str, Array]) -> Sequence[Iteration]:
    if missing := set(_COLUMNS) - set(columns):
        if columns:
            raise KeyError(f"history: {sorted(missing)}")
        return ()
    return Columns(columns)


def _problem_to_data(problem: Any) -> dict[str, str] | None:
    kind = f"{type(problem).__module__}:{type(problem).__qualname__}"
    for entry in entry_points(group="slipcar.problems") if hasattr(problem, "to_json") else ():
        if entry.value == kind:
            return {"class": entry.name, "json": problem.to_json()}
    return None


def _problem_from_data(data: dict[str, str] | None) -> Any:
    if data is None:
        return None
    for entry in entry_points(group="slipcar.problems"):
        if entry.name == data["class"]:
            return entry.load().from_json(data["json"])
    return None

"""Files of plans and scenarios, cut, flipped, edited or foreign: read as they were, or refused."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from slipcar.envs import Scenario
from slipcar.planner import Feedback, OpenLoop, Plan, plan

from .calls import call
from .problems import Own, Recipe


@dataclasses.dataclass(frozen=True)
class Damage:
    """What is done to a file.

    Attributes:
        of: "world" or "own", the plan; "json", a scenario's text.
        how: "cut", "flip", "header", "array" or "foreign".
        where: in parts of the file, in [0, 1).
        value: what is put there.
    """

    of: str
    how: str
    where: float
    value: Any


_VALUES = (
    None, 0, -1, 2.5, "", "x", [], {}, [1, 2], [[]], float("nan"), True, {"a": 1}, "CONVERGED",
)  # fmt: skip
damages = st.builds(
    Damage,
    of=st.sampled_from(("world", "own", "json")),
    how=st.sampled_from(("cut", "flip", "header", "array", "foreign")),
    where=st.floats(0.0, 0.999),
    value=st.sampled_from(_VALUES),
)

#: What becomes of an array in a file; None: it is gone.
_CHANGES = (
    lambda a: a[..., :-1] if a.ndim else a[None],
    lambda a: np.full(a.shape, np.nan),
    lambda a: a.astype(str),
    lambda a: None,
    lambda a: np.full(a.shape, 1j),
)


@functools.cache
def _whole(of: str) -> tuple[bytes, Plan | None]:
    """The file as it should be, and its plan."""
    if of == "json":
        return Scenario.named("paper").to_json().encode(), None
    problem = Scenario.named("paper") if of == "world" else Own(Recipe(bounds="box"))
    planned = plan(problem, feedback=True)
    with tempfile.TemporaryDirectory() as folder:
        return planned.save(Path(folder) / "plan.npz").read_bytes(), planned


def _damaged(data: bytes, damage: Damage) -> bytes:
    at = int(damage.where * len(data))
    if damage.how == "cut":
        return data[:at]
    if damage.how == "flip":
        return data[:at] + bytes([data[at] ^ (1 + at % 255)]) + data[at + 1 :]
    if damage.how == "foreign":
        return (b"", b"PK\x03\x04", b"\x93NUMPY", b"{}", b"null", b"[1]", b"\xff\xfe{\x00}\x00")[
            at % 7
        ]
    if damage.of == "json":
        fields = json.loads(data)
        fields[sorted(fields)[at % len(fields)]] = damage.value
        return json.dumps(fields).encode()
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    if damage.how == "header":
        header = json.loads(str(arrays["header"]))
        header[sorted(header)[at % len(header)]] = damage.value
        arrays["header"] = np.array(json.dumps(header))
    else:
        name = sorted(set(arrays) - {"header"})[at % (len(arrays) - 1)]
        changed = _CHANGES[at % len(_CHANGES)](arrays[name])
        arrays = {k: v for k, v in arrays.items() if k != name}
        if changed is not None:
            arrays[name] = changed
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def read_anyway(damage: Damage) -> list[str]:
    """Reading gives a ValueError or something that works."""
    whole, planned = _whole(damage.of)
    data = _damaged(whole, damage)
    if planned is None:
        made = call(lambda: Scenario.from_json(data.decode("utf-8", "replace")))
        return list(made.findings)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.npz"
        path.write_bytes(data)
        loaded = call(lambda: Plan.load(path))
    if loaded.error is not None or damage.how not in ("header", "array"):
        return list(loaded.findings)
    return [*loaded.findings, *_used(planned, loaded.value)]


def _used(planned: Plan, loaded: Plan) -> list[str]:
    """A plan that was read is played: finite actions, or a ValueError that says what is wrong."""
    n = planned.mean.shape[1]
    see = np.concatenate([planned.mean[1], planned.times[1:2]])
    decode = getattr(planned.problem, "decode_observation", None)
    if decode is not None:
        see = np.concatenate([planned.mean[1], planned.times[1:2]])[: n + 1]
    found = [*call(lambda: repr(loaded)).findings]
    for kind in (OpenLoop, Feedback):
        played = call(lambda k=kind: k(loaded).predict(see)[0])
        found += [f"{kind.__name__}: {finding}" for finding in played.findings]
        if played.error is None and not np.isfinite(played.value).all():
            found.append(f"{kind.__name__} plays {played.value}")
    return found

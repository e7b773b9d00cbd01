"""Where the time of a step goes: a clock round each part of it, in the running environment.

A part's time is its own: that of the parts which it calls is theirs. The clocks cost a little, in
proportion to the number of calls and not of environments; so they tell shares alone, of a time
that is measured without them.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import numpy as np
from environment_turns import Walker

from slipcar.envs import families, fleet, noise, noise_store, observation, vector

#: The module; in the package its name is that of a function.
transition = importlib.import_module("slipcar.envs.transition")

#: Where the functions of a step are looked up, and the part that each belongs to.
PLACES: tuple[tuple[Any, str, str], ...] = (
    (noise.Tapes, "take", "noise: random words"),
    (noise, "normals", "noise: normal variates"),
    (noise_store.NoiseStore, "put", "noise: kept for its step"),
    (noise_store.NoiseStore, "common", "noise: fetched for the step"),
    (noise_store.NoiseStore, "each", "noise: fetched for the step"),
    (families.Family, "draw", "worlds drawn"),
    (fleet.Worlds, "put", "worlds drawn"),
    (vector, "limited_action", "actions checked"),
    (vector, "step", "physics: effort"),
    (transition, "increments", "physics: increments"),
    (vector.SlipCarVectorEnv, "_add", "physics: sum in float64"),
    (transition, "proximity", "obstacles"),
    (vector, "proximity", "obstacles"),
    (observation, "entries", "observation: entries"),
    (observation, "_obstacles", "observation: obstacles seen"),
    (observation, "nearest", "observation: the nearest of them"),
    (observation, "fill", "observation: into rows"),
    (vector.SlipCarVectorEnv, "_info", "info"),
)
REST = "bookkeeping"


def unclocked() -> list[str]:
    """What is not, or no longer, called as :data:`PLACES` says; its time is its caller's."""
    return [f"{owner.__name__}.{name}" for owner, name, _ in PLACES if not hasattr(owner, name)]


class Clocks:
    """Seconds by part, each without those inside it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inside: list[float] = [0.0]

    def around(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        """The function with a clock round it."""

        @functools.wraps(function)
        def timed(*arguments: Any, **options: Any) -> Any:
            self._inside.append(0.0)
            began = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                took = time.perf_counter() - began
                self.seconds[part] = self.seconds.get(part, 0.0) + took - self._inside.pop()
                self._inside[-1] += took

        return timed

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Clocks round all parts; the time of none of them is the bookkeeping's."""
        with contextlib.ExitStack() as stack:
            for owner, name, part in PLACES:
                if not hasattr(owner, name):
                    continue
                timed = self.around(getattr(owner, name), part)
                stack.enter_context(mock.patch.object(owner, name, timed))
            self._inside = [0.0]
            began = time.perf_counter()
            yield
            took = time.perf_counter() - began
            self.seconds[REST] = self.seconds.get(REST, 0.0) + took - self._inside[0]


def shares(
    walkers: list[Walker], nanoseconds: dict[str, float], rounds: int
) -> list[dict[str, Any]]:
    """Share of a step by part, for each walker: medians over rounds.

    Args:
        walkers: `SlipCarVectorEnv`s.
        nanoseconds: of a step of each without clocks, by name; they are parted by these shares.
        rounds: walks of each.
    """
    parts = list(dict.fromkeys([part for _, _, part in PLACES] + [REST]))
    found = {walker.name: np.zeros((rounds, len(parts))) for walker in walkers}
    for walker in walkers:
        walker.walk()
    for k in range(rounds):
        for walker in walkers:
            clocks = Clocks()
            with clocks.running():
                walker.walk()
            took = np.array([clocks.seconds.get(part, 0.0) for part in parts])
            found[walker.name][k] = took / took.sum()
    middle = {name: np.median(each, axis=0) for name, each in found.items()}
    middle = {name: each / each.sum() for name, each in middle.items()}
    rows = []
    for i, part in enumerate(parts):
        row: dict[str, Any] = {"part": part}
        for name, each in middle.items():
            share = float(each[i])
            row[f"{name} [ns]"] = f"{share * nanoseconds[name]:.1f}" if share else ""
            row[f"{name} %"] = f"{100.0 * share:.1f}" if share else ""
        rows.append(row)
    total: dict[str, Any] = {"part": "in all"}
    for name in middle:
        total |= {f"{name} [ns]": f"{nanoseconds[name]:.1f}", f"{name} %": "100"}
    return [*rows, total]

"""What takes part in the benchmark, and the one judge for all: slipcar's own physics and costs.

A contender hands in controls. Whatever it believes of its answer, the controls are driven
through the non-linear dynamics of the scenario, and that path is what is reported:

    x_{k+1} = x_k + dt b(x_k, u_k),   cost = effort + obstacle,   miss = max |x_N − x^f|
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from slipcar.envs import Scenario

Raw = TypeVar("Raw")

#: What a contender solves, unless it says otherwise.
EXACT = "the problem"


class UnavailableError(Exception):
    """A contender cannot take part; the message says why in one line."""


@dataclasses.dataclass(frozen=True)
class Answer:
    """What a contender found.

    Attributes:
        controls: (N−1, 2) [m/s², rad/s²].
        iterations: its own count: sub-problems, interior-point or DDP iterations.
        found: whether it says that it converged.
    """

    controls: np.ndarray
    iterations: int
    found: bool


@dataclasses.dataclass(frozen=True)
class Contender:
    """One planner on one scenario, ready to be called again and again.

    Attributes:
        name: row of the table.
        tolerance: at which value of which of its own measures it stops.
        solve: plans from the scenario's own guess; returns seconds and the answer.
        solves: `EXACT`, or what it solves instead.
        build_seconds: what had to be built once beforehand took.
        plans: how many one call of `solve` makes; the answer is the first's.
        threads: cores it keeps busy.
    """

    name: str
    tolerance: str
    solve: Callable[[], tuple[float, Answer]]
    solves: str = EXACT
    build_seconds: float = 0.0
    plans: int = 1
    threads: int = 1


@dataclasses.dataclass(frozen=True)
class Judgement:
    """What controls do in the scenario.

    Attributes:
        effort: Σ dt ‖u‖².
        obstacle: Σ dt λ Σ max(0, c)².
        miss: largest component of |x_N − x^f| where the controls lead.
    """

    effort: float
    obstacle: float
    miss: float

    @property
    def cost(self) -> float:
        return self.effort + self.obstacle


def stopwatch(
    call: Callable[[], Raw], read: Callable[[Raw], Answer]
) -> Callable[[], tuple[float, Answer]]:
    """Time the call alone; reading the answer off is not planning."""

    def solve() -> tuple[float, Answer]:
        began = time.perf_counter()
        raw = call()
        seconds = time.perf_counter() - began
        return seconds, read(raw)

    return solve


def judge(scenario: Scenario, controls: np.ndarray) -> Judgement:
    """Drive the controls (N−1, 2) through the dynamics without noise and add the costs up."""
    t, dt = scenario.times, scenario.dt
    states = [np.array(scenario.start)]
    for k, u in enumerate(controls):
        states.append(states[-1] + dt * scenario.drift(t[k], states[-1], u))
    path = np.array(states)
    return Judgement(
        effort=float(dt * scenario.control_power(controls).sum()),
        obstacle=float(dt * scenario.obstacle_power(path[1:]).sum()),
        miss=float(np.abs(path[-1] - scenario.goal).max()),
    )


def available(
    makers: dict[str, Callable[[], Contender]], tell: Callable[[str], None] = print
) -> tuple[list[Contender], dict[str, str]]:
    """Build who can take part; the others are told, and returned with the reason."""
    contenders, skipped = [], {}
    for name, make in makers.items():
        try:
            contenders.append(make())
        except (ImportError, UnavailableError) as error:
            skipped[name] = str(error).partition("\n")[0]
            tell(f"skipped {name}: {skipped[name]}")
    return contenders, skipped

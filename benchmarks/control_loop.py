"""How late a control loop's answers come: `RecedingHorizon.step`, 10⁵ times, with its tail.

The car drives the paper's case again and again, by its own noise. A time is the whole call of
`step`: the state in, the controls out. It is the tail that decides whether a loop can be closed, so
the garbage collector runs as it does for everyone. Whatever else the machine does is in the times
of the clock, and not in those of the processor.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from report import Section
from rich.console import Console
from rich.progress import track

from slipcar.envs import Scenario
from slipcar.planner import RecedingHorizon

ABOUT = """\
The paper's case is driven again and again by its own noise; a time is a whole call of
`RecedingHorizon.step(x, t)`, replan and all, by the clock and by the processor's own time for the
thread that calls: where the two differ, other processes had the processor. With a deadline, at
steps 2.5 ms apart, the replan runs in a thread: late steps play the last good plan's feedback law,
and the replan serves the next.
"""
STEPS = 100_000
STEPS_DEADLINE, PERIOD = 10_000, 2.5e-3
DEADLINES = (None, 1e-3, 0.2e-3)


def section(steps: int = STEPS) -> Section:
    """The distribution for each deadline."""
    console = Console(stderr=True)
    rows, raw = [], {}
    for deadline in track(DEADLINES, "control loop", console=console):
        count = steps if deadline is None else min(steps, STEPS_DEADLINE)
        clock, processor, controller = latencies(count, deadline)
        rows.append(row("clock", clock, controller, deadline))
        if deadline is None:
            rows.append(row("processor", processor, controller, deadline))
        raw[str(deadline)] = np.quantile(clock, np.linspace(0.0, 1.0, 1001)).tolist()
    return Section(
        part="control_loop",
        title="Control loop",
        about=ABOUT,
        tables={"Milliseconds from the state to the control": rows},
        raw=raw,
    )


def latencies(steps: int, deadline: float | None) -> tuple[np.ndarray, np.ndarray, RecedingHorizon]:
    """Seconds of each step by the clock and by the processor, and the controller.

    The first episode's are left out.
    """
    scenario = Scenario.named("paper")
    controller, rng = RecedingHorizon(scenario), np.random.default_rng(0)
    seconds: list[tuple[float, float]] = []
    warm = scenario.nodes - 1
    while len(seconds) < steps + warm:
        x = scenario.start
        for t in scenario.times[:-1]:
            began, worked = time.perf_counter(), time.thread_time()
            u = controller.step(x, t, deadline=deadline)
            worked = time.thread_time() - worked
            seconds.append((time.perf_counter() - began, worked))
            if deadline is not None:
                time.sleep(max(0.0, PERIOD - (time.perf_counter() - began)))
            noise = scenario.diffusion(t, x) @ rng.standard_normal(3)
            x = x + scenario.dt * scenario.drift(t, x, u) + np.sqrt(scenario.dt) * noise
    clock, processor = np.array(seconds[warm : warm + steps]).T
    return clock, processor, controller


def row(
    by: str, seconds: np.ndarray, controller: RecedingHorizon, deadline: float | None
) -> dict[str, Any]:
    """What is said of a deadline."""
    ms = 1e3 * seconds
    return {
        "by": by,
        "deadline": "none" if deadline is None else f"{1e3 * deadline:g} ms",
        "steps": len(ms),
        "median": float(np.median(ms)),
        "99 %": float(np.quantile(ms, 0.99)),
        "99.9 %": float(np.quantile(ms, 0.999)),
        "worst": float(ms.max()),
        "late": controller.late,
        "replans failed": controller.failures,
    }

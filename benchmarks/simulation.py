"""Steps per second of the environments, and seconds per 10⁵ evaluated episodes."""

from __future__ import annotations

import time
from typing import Any

import gymnasium as gym
import numpy as np
from report import Section

from slipcar.envs import Scenario
from slipcar.evaluation import evaluate
from slipcar.planner import OpenLoop, plan

ABOUT = """\
One process: steps of `SlipCar-v0` with features observation and random actions, noise and resets
included; and `evaluate` of an open-loop plan with all its metrics.
"""


def section() -> Section:
    """All of it, to be printed and kept."""
    return Section(
        part="simulation",
        title="Environment and evaluation",
        about=ABOUT,
        tables={
            "Steps per second by batch size": environment_rows(),
            "Seconds for 100 000 episodes": evaluation_rows(),
        },
    )


def environment_rows(seconds: float = 1.0) -> list[dict[str, Any]]:
    """Steps per second by batch size, features observation, random actions drawn beforehand."""
    table = []
    rng = np.random.default_rng(0)
    env = gym.make("slipcar.envs:SlipCar-v0", disable_env_checker=True).unwrapped
    action = rng.uniform(-1, 1, 2).astype(np.float32)
    steps, began = 0, time.perf_counter()
    while time.perf_counter() - began < seconds:
        env.reset()
        for _ in range(40):
            env.step(action)
        steps += 40
    table.append({"environments": 1, "steps/s": steps / (time.perf_counter() - began)})
    for count in (64, 1024, 4096):
        envs = gym.make_vec(
            "slipcar.envs:SlipCar-v0", num_envs=count, vectorization_mode="vector_entry_point"
        )
        actions = rng.uniform(-1, 1, (count, 2)).astype(np.float32)
        envs.reset(seed=0)
        steps, began = 0, time.perf_counter()
        while time.perf_counter() - began < seconds:
            for _ in range(41):  # the 41st call is the reset of NEXT_STEP
                envs.step(actions)
            steps += 40 * count
        table.append({"environments": count, "steps/s": steps / (time.perf_counter() - began)})
    return table


def evaluation_rows() -> list[dict[str, Any]]:
    """Seconds for 10⁵ open-loop episodes with all metrics, one process."""
    scenario = Scenario.named("paper")
    controller = OpenLoop(plan(scenario))
    evaluate(controller, scenario, episodes=1024)
    began = time.perf_counter()
    result = evaluate(controller, scenario, episodes=100_000)
    return [
        {
            "what": "evaluate(open loop, 100 000 episodes)",
            "seconds": time.perf_counter() - began,
            "collisions": result.collision_rate,
        }
    ]

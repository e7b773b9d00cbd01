"""Steps per second by turns: each walker once a round, so that a busy machine is busy for all.

A ratio of two is the median over the rounds of the ratio within a round. Seconds are those that the
processor worked for this process: everything runs in one thread, so on a quiet machine they are the
clock's, and on a busy one they leave out what other processes took.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

#: Sets of actions that a walker takes in turn, drawn beforehand.
_SETS = 8

Rates = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Walker:
    """An environment with its actions, ready to be stepped again and again.

    Attributes:
        name: its key among the rates.
        walk: goes on from where it stands; returns how many steps that were. Calls that only
            reset are none, though their time counts.
    """

    name: str
    walk: Callable[[], int]


def by_turns(walkers: Sequence[Walker], rounds: int) -> Rates:
    """Steps per second of every walker in every round, (rounds,) each; a first walk is not counted.

    Walkers take turns in an order drawn anew each round.
    """
    for walker in walkers:
        walker.walk()
    found = {walker.name: np.empty(rounds) for walker in walkers}
    rng = np.random.default_rng(0)
    for k in range(rounds):
        for i in rng.permutation(len(walkers)):
            began = time.process_time()
            steps = walkers[i].walk()
            found[walkers[i].name][k] = steps / (time.process_time() - began)
    return found


def ratio(rates: Rates, ours: str, theirs: str) -> float:
    """How many times faster: the median of the ratios within a round."""
    return shortened(float(np.median(rates[ours] / rates[theirs])))


def middle(rates: np.ndarray) -> float:
    """The median, to three digits."""
    return shortened(float(np.median(rates)))


def shortened(value: float) -> float:
    """Three significant digits: no timing has more."""
    return float(f"{value:.3g}")


def vector_walker(name: str, envs: Any, calls: int) -> Walker:
    """A vector environment of Gymnasium with random actions, reset as NEXT_STEP does it."""
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(_SETS)]
    resetting = 0

    def walk() -> int:
        nonlocal resetting
        steps = 0
        for i in range(calls):
            _, _, terminated, truncated, _ = envs.step(actions[i % _SETS])
            steps += envs.num_envs - resetting
            resetting = int(np.count_nonzero(terminated | truncated))
        return steps

    return Walker(name, walk)


def single_walker(name: str, env: gym.Env[Any, Any], calls: int) -> Walker:
    """A single environment of Gymnasium with random actions, reset where an episode ends."""
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(_SETS)]

    def walk() -> int:
        for i in range(calls):
            _, _, terminated, truncated, _ = env.step(actions[i % _SETS])
            if terminated or truncated:
                env.reset()
        return calls

    return Walker(name, walk)


def calls_for(count: int) -> int:
    """Calls in a walk of a vector environment: whole episodes of 41, the last call a reset.

    A fleet fetches random words for up to 16 episodes ahead, so a walk is long enough to hold
    fetches in proportion: 48 episodes, or fewer where the fleet is large and fetches more often.
    """
    return 41 * min(48, max(1, math.ceil(2**17 / count)))


@contextlib.contextmanager
def one_core() -> Iterator[str]:
    """Keep this process on one of the cores it may use; says in a sentence whether it is."""
    if not hasattr(os, "sched_setaffinity"):
        yield "This system does not let a process be pinned to a core."
        return
    before = os.sched_getaffinity(0)
    core = max(before)
    os.sched_setaffinity(0, {core})
    try:
        yield "The process was pinned to one core (`os.sched_setaffinity`)."
    finally:
        os.sched_setaffinity(0, before)


def version(package: str) -> str:
    """Installed version of a package."""
    return f"{package} {importlib.metadata.version(package)}"

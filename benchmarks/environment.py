"""Steps per second of the environments beside their peers, where they go, and what they feed.

One process on one core. Everything that is compared is stepped by turns
(:mod:`environment_turns`).
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from typing import Any

import environment_peers
import environment_precision
import environment_share
import gymnasium as gym
import numpy as np
from environment_turns import (
    Rates,
    Walker,
    by_turns,
    calls_for,
    middle,
    one_core,
    ratio,
    shortened,
    single_walker,
    vector_walker,
)
from report import Section

from slipcar.baselines import train_ppo
from slipcar.baselines.config import PPOConfig
from slipcar.envs import Scenario
from slipcar.envs.overlay import Overlay
from slipcar.planner import plan

NAME = "slipcar.envs:SlipCar-v0"
COUNTS = (1, 64, 1024, 4096, 65536)
#: The fleet whose parts are timed, and that peers with vectors are compared at.
FLEET = 4096
ROUNDS = 7
PATHS = 100_000
PPO_STEPS = 400_000

#: Our vector environments, by column.
FLEETS: dict[str, dict[str, Any]] = {
    "state": {"observation": "state"},
    "features": {},
    "features, float64": {"dtype": "float64"},
    "family, egocentric": {"scenario": "family:random", "observation": "egocentric"},
}

ABOUT = f"""\
Random actions, drawn beforehand; noise, resets and, in a family, the drawing of worlds are in the
time. Calls that only reset (one of 41 here, about one of 19 for CartPole) are no steps. A rate is
the median of {ROUNDS} rounds, a ratio the median of the rounds' own. *state*, *features* and
*family, egocentric* are `SlipCarVectorEnv`'s observations of 6, 12 and 47 numbers, the last one of
`"family:random"` with its 8 obstacle slots; CartPole is Gymnasium's `CartPoleVectorEnv`, which has
4 numbers, no noise and one generator for all.

Seconds are the processor's for this process, Torch's excepted: it has one thread, so on a quiet
machine they are the clock's. The single environments are `gym.make`'s, peers with the configuration
they come with. *Where the time goes* has clocks round the parts of the running environment, at
{FLEET} cars, and parts the time that it takes without them; a part does not count what it calls.
*float32 against float64* drives the same worlds, noise and actions through both. *PPO* is
`train_ppo`, its validation included. *Torch* is `torch_speed.py`. *Frames* is `render()` of
`rgb_array` at 640 px width, the steps not counted.
"""


def section() -> Section:
    """All of it, to be printed and kept."""
    with one_core() as pinned:
        vectors = {count: by_turns(fleets(count), ROUNDS) for count in COUNTS}
        singles, skipped = single_rates()
        parts, unclocked = share_rows(vectors[FLEET])
        precision = environment_precision.rows(PATHS)
        ppo = ppo_row()
        torch, untold = torch_rows()
        frames = frame_rows()
    peers = peer_rows(*singles)
    return Section(
        part="environment",
        title="Environment",
        about=f"{ABOUT}\n{pinned}",
        tables={
            "What was asked for": target_rows(vectors, singles[1], ppo, torch, frames),
            "Steps per second by number of environments": vector_rows(vectors),
            "Beside single and vectorised peers": peers,
            f"Where the time goes, {FLEET} cars, a step of one": parts,
            "float32 against float64, largest differences": precision,
            "PPO end to end": [ppo],
            "Torch": torch,
            "Frames per second off screen": frames,
        },
        notes=(*skipped, *untold, *unclocked),
        raw={
            "vectors": {str(n): _listed(rates) for n, rates in vectors.items()},
            "singles": _listed(singles[1]),
        },
    )


# ------------------------------------------------------------------------------------ vectors


def fleets(count: int) -> list[Walker]:
    """Ours of every kind, and as many CartPoles."""
    ours = [
        vector_walker(
            name,
            gym.make_vec(NAME, num_envs=count, vectorization_mode="vector_entry_point", **options),
            calls_for(count),
        )
        for name, options in FLEETS.items()
    ]
    return [*ours, environment_peers.cart_poles(count)]


def vector_rows(vectors: dict[int, Rates]) -> list[dict[str, Any]]:
    """Steps per second of each column, and ratios to CartPole, a row for each batch size."""
    return [
        {"environments": count}
        | {name: middle(found) for name, found in rates.items()}
        | {f"{name} / CartPole": ratio(rates, name, "CartPole") for name in FLEETS}
        for count, rates in vectors.items()
    ]


def share_rows(measured: Rates) -> tuple[list[dict[str, Any]], list[str]]:
    """Where the time goes for three kinds; and a note on parts that were not found."""
    kinds = ("state", "features", "family, egocentric")
    walkers = [walker for walker in fleets(FLEET) if walker.name in kinds]
    bare = {name: 1e9 / middle(measured[name]) for name in kinds}
    gone = environment_share.unclocked()
    notes = [f"no clock round {', '.join(gone)}: not found"] if gone else []
    return environment_share.shares(walkers, bare, ROUNDS), notes


# ------------------------------------------------------------------------------------ singles

_OURS = "SlipCar-v0"
_WRAPPED = "SlipCar-v0 with gym.make's wrappers"
_FLEET = f"SlipCar-v0 x {FLEET}"

Singles = tuple[list[environment_peers.Peer], Rates]


def single_rates() -> tuple[Singles, list[str]]:
    """The peers that took part and the rates of all; and a line for each that did not."""
    found, skipped = environment_peers.available(environment_peers.peers(FLEET))
    ours = [
        single_walker(_OURS, gym.make(NAME).unwrapped, 2000),
        single_walker(_WRAPPED, gym.make(NAME), 2000),
        vector_walker(
            _FLEET,
            gym.make_vec(NAME, num_envs=FLEET, vectorization_mode="vector_entry_point"),
            calls_for(FLEET),
        ),
    ]
    rates = by_turns([*ours, *(walker for _, walker in found)], ROUNDS)
    return ([peer for peer, _ in found], rates), skipped


def peer_rows(peers: Sequence[environment_peers.Peer], rates: Rates) -> list[dict[str, Any]]:
    """Ours, then each peer beside ours of its size."""
    rows: list[dict[str, Any]] = [
        {
            "environment": name,
            "version": "",
            "a step": "5 states, 4 obstacles, 3 noises; observes 12",
            "environments": count,
            "steps/s": middle(rates[name]),
            "SlipCar-v0 / it": ratio(rates, _OURS, name) if name == _WRAPPED else "",
        }
        for name, count in ((_OURS, 1), (_WRAPPED, 1), (_FLEET, FLEET))
    ]
    for peer in peers:
        key = f"{peer.name} x {peer.count}"
        rows.append(
            {
                "environment": peer.name,
                "version": peer.version,
                "a step": peer.what,
                "environments": peer.count,
                "steps/s": middle(rates[key]),
                "SlipCar-v0 / it": ratio(rates, _OURS if peer.count == 1 else _FLEET, key),
            }
        )
    return rows


# ---------------------------------------------------------------------------- PPO, Torch, frames


def ppo_row(steps: int = PPO_STEPS) -> dict[str, Any]:
    """Environment steps per second of a short training run, its first iteration not counted."""
    at, done = [], []

    def after(progress: Any) -> None:
        at.append(time.process_time())
        done.append(progress.steps)

    config = PPOConfig(total_steps=steps)
    train_ppo("paper", config, progress=False, callback=after)
    each = np.diff(done) / np.diff(at)
    return {
        "environments": config.environments,
        "steps": done[-1] - done[0],
        "steps/s": shortened((done[-1] - done[0]) / (at[-1] - at[0])),
        "median iteration, no validation": middle(each),
    }


def torch_rows() -> tuple[list[dict[str, Any]], list[str]]:
    """Steps per second of the tensors on the processor and on a GPU, if there is one."""
    try:
        import torch
        import torch_speed
    except ImportError as error:
        return [], [f"skipped Torch: {error}"]
    found = _torch_rows(torch_speed, "cpu", 2**16, (False,))
    if not torch.cuda.is_available():
        return [*found, {"on": "GPU", "steps/s": "not measured (no GPU)"}], []
    return found + _torch_rows(torch_speed, "cuda", 10**6, (False, True)), []


def _torch_rows(
    speed: Any, device: str, paths: int, ways: tuple[bool, ...]
) -> list[dict[str, Any]]:
    where = {
        "on": "processor" if device == "cpu" else "GPU",
        "device": speed.name_of(device),
        "paths": paths,
    }
    rows = speed.rows(device, paths, 1.0, ways)
    return [where | row | {"steps/s": shortened(row["steps/s"])} for row in rows]


def frame_rows() -> list[dict[str, Any]]:
    """Frames per second of `render()`, without and with what a controller means to do."""
    scenario = Scenario.named("paper")
    p = plan(scenario)
    ahead = [Overlay(p.mean[k:], p.covariance[k:, :2, :2]) for k in range(scenario.nodes)]
    whole = itertools.repeat(ahead[0])
    env = gym.make(NAME, render_mode="rgb_array").unwrapped
    kinds = {
        "the scene and the trail": lambda: itertools.repeat(None),
        "and a plan with its ellipses": lambda: whole,
        "and a new plan in each frame": lambda: iter(ahead),
    }
    seconds: dict[str, list[float]] = {name: [] for name in kinds}
    for _ in range(ROUNDS + 1):
        for name, overlays in kinds.items():
            seconds[name].append(_drawn(env, overlays()))
    return [
        {"picture": name, "frames/s": middle((scenario.nodes - 1) / np.array(took[1:]))}
        for name, took in seconds.items()
    ]


def _drawn(env: Any, overlays: Any) -> float:
    """Seconds for the frames of one episode."""
    env.reset(seed=0)
    took, over = 0.0, False
    while not over:
        _, _, over, _, _ = env.step(np.array([0.3, 0.2], dtype=np.float32))
        env.overlay = next(overlays)
        began = time.process_time()
        env.render()
        took += time.process_time() - began
    return took


# ------------------------------------------------------------------------------------ targets


def target_rows(
    vectors: dict[int, Rates],
    singles: Rates,
    ppo: dict[str, Any],
    torch: list[dict[str, Any]],
    frames: list[dict[str, Any]],
) -> list[dict[str, Any]]:
    """What the issue asks for beside what was measured."""
    fleet = vectors[FLEET]
    rows = [
        ("single environment, steps/s", 25e3, middle(singles[_OURS])),
        (f"{FLEET} cars, state, over CartPole", 1.0, ratio(fleet, "state", "CartPole")),
        (f"{FLEET} cars, features, steps/s", 8e6, middle(fleet["features"])),
        (f"{FLEET} cars, features, over CartPole", 0.8, ratio(fleet, "features", "CartPole")),
        ("PPO end to end, steps/s", 30e3, ppo["steps/s"]),
        ("frames/s", 200.0, min(row["frames/s"] for row in frames)),
    ]
    highway = f"{environment_peers.HIGHWAY} x 1"
    if highway in singles:
        rows.insert(1, ("single environment over HighwayEnv", 50.0, ratio(singles, _OURS, highway)))
    told = [
        {
            "what": what,
            "at least": least,
            "measured": found,
            "reached": "yes" if found >= least else "no",
        }
        for what, least, found in rows
    ]
    gpu: dict[str, Any] = {"what": "Torch on a GPU, steps/s", "at least": 1e9}
    rates = [row["steps/s"] for row in torch if row["on"] == "GPU" and "device" in row]
    if not rates:
        return [*told, gpu | {"measured": "not measured (no GPU)", "reached": ""}]
    best = max(rates)
    return [*told, gpu | {"measured": best, "reached": "yes" if best >= 1e9 else "no"}]


def _listed(rates: Rates) -> dict[str, list[float]]:
    return {name: found.tolist() for name, found in rates.items()}

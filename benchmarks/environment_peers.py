"""Environments of others that the benchmark steps beside ours: CartPole, HighwayEnv, VMAS, ir-sim.

HighwayEnv, VMAS and ir-sim take part where they are installed. All of them are stepped through the
call that their users make, with random actions, resets included.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import tempfile
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
from contenders import UnavailableError
from environment_turns import Walker, calls_for, single_walker, vector_walker, version

#: Control steps of an episode, for those that never end one by themselves: as many as ours.
_EPISODE = 40
#: HighwayEnv's quick highway, which its users train on.
HIGHWAY = "highway-fast-v0"


@dataclasses.dataclass(frozen=True)
class Peer:
    """Somebody else's environment.

    Attributes:
        name: how its users call it.
        version: of the package.
        what: of what a step is made.
        count: how many environments a call steps.
        walker: makes it; raises ImportError or UnavailableError where it cannot take part.
    """

    name: str
    package: str
    what: str
    count: int
    walker: Callable[[str], Walker]

    @property
    def version(self) -> str:
        """Package and installed version."""
        return version(self.package)


def cart_poles(count: int) -> Walker:
    """Gymnasium's own CartPoleVectorEnv, named `CartPole`."""
    envs = gym.make_vec("CartPole-v1", num_envs=count, vectorization_mode="vector_entry_point")
    return vector_walker("CartPole", envs, calls_for(count))


def peers(count: int) -> list[Peer]:
    """Those of the second table; the vectorised ones with `count` environments."""
    return [
        Peer("CartPole-v1", "gymnasium", "4 states, no noise", 1, _gymnasium("CartPole-v1", 2000)),
        Peer(
            HIGHWAY, "highway-env", "20 other cars, 5 substeps", 1, _highway(HIGHWAY, 40),
        ),
        Peer(
            "parking-v0", "highway-env", "kinematic bicycle, 3 substeps", 1,
            _highway("parking-v0", 100),
        ),
        Peer("ir-sim, Ackermann car", "ir-sim", "4 discs; no observation, no noise", 1, _ir_sim),
        Peer("VMAS kinematic_bicycle", "vmas", "10 substeps, PyTorch, no noise", 1, _vmas(1, 100)),
        Peer(
            "VMAS kinematic_bicycle", "vmas", "10 substeps, PyTorch, no noise", count,
            _vmas(count, 40),
        ),
    ]  # fmt: skip


def available(
    found: list[Peer], told: Callable[[str], None] = print
) -> tuple[list[tuple[Peer, Walker]], list[str]]:
    """Peers that are installed, each with its walker, and a line for each that is not."""
    there, skipped = [], []
    for peer in found:
        try:
            there.append((peer, peer.walker(f"{peer.name} x {peer.count}")))
        except (ImportError, UnavailableError) as error:
            lines = str(error).strip().splitlines() or [type(error).__name__]
            skipped.append(f"skipped {peer.name}: {lines[0]}")
            told(skipped[-1])
    return there, skipped


def _gymnasium(name: str, calls: int) -> Callable[[str], Walker]:
    return lambda walker: single_walker(walker, gym.make(name), calls)


def _highway(name: str, calls: int) -> Callable[[str], Walker]:
    def make(walker: str) -> Walker:
        import highway_env

        gym.register_envs(highway_env)
        return single_walker(walker, gym.make(name), calls)

    return make


def _vmas(count: int, calls: int) -> Callable[[str], Walker]:
    def make(walker: str) -> Walker:
        with contextlib.redirect_stderr(io.StringIO()):  # its `gym` says that it is old
            import torch
            import vmas
        torch.set_num_threads(1)
        envs = vmas.make_env(
            "kinematic_bicycle", num_envs=count, device="cpu", continuous_actions=True, seed=0,
            n_agents=1,
        )  # fmt: skip
        high = torch.as_tensor(envs.action_space[0].high)
        generator = torch.Generator().manual_seed(0)
        actions = [
            [high * (2.0 * torch.rand(count, 2, generator=generator) - 1.0)] for _ in range(8)
        ]

        def walk() -> int:
            for i in range(calls):
                envs.step(actions[i % 8])
                if i % _EPISODE == _EPISODE - 1:
                    envs.reset()
            return calls * count

        return Walker(walker, walk)

    return make


#: The paper's scenario, moved into the world's corner at (2, 2): its coordinates are not negative.
_WORLD = """\
world: {height: 10, width: 10, step_time: 0.125}
robot:
  - kinematics: {name: acker}
    shape: {name: rectangle, length: 0.2, width: 0.1, wheelbase: 0.15}
    state: [2, 2, 0, 0]
    goal: [4.2, 5, 0]
    vel_min: [-2, -0.6]
    vel_max: [2, 0.6]
obstacle:
  - {shape: {name: circle, radius: 0.2}, state: [3.5, 3.9]}
  - {shape: {name: circle, radius: 0.3}, state: [2.6, 4.0]}
  - {shape: {name: circle, radius: 0.3}, state: [3.15, 2.4]}
  - {shape: {name: circle, radius: 0.25}, state: [2.35, 2.75]}
"""


def _ir_sim(walker: str) -> Walker:
    # It says which windows it cannot open, and every collision.
    with contextlib.redirect_stdout(io.StringIO()), tempfile.TemporaryDirectory() as folder:
        import irsim

        world = Path(folder) / "world.yaml"
        world.write_text(_WORLD, encoding="utf-8")
        env = irsim.make(str(world), display=False, disable_all_plot=True, log_level="CRITICAL")
    rng = np.random.default_rng(0)
    actions = [rng.uniform([[-2.0], [-0.6]], [[2.0], [0.6]]) for _ in range(8)]

    def walk() -> int:
        calls = 10 * _EPISODE
        for i in range(calls):
            env.step(actions[i % 8])
            if i % _EPISODE == _EPISODE - 1:
                env.reset()
        return calls

    return Walker(walker, walk)

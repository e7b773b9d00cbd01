"""`SlipCar-v0` as a fleet of tensors: simulated, seen and rewarded on a device, in Torch."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from slipcar.envs.arrays import Functions, tensor_functions
from slipcar.envs.car import CONTROL_DIM
from slipcar.envs.cost import arrived
from slipcar.envs.families import Family
from slipcar.envs.observation import Layout
from slipcar.envs.options import check_source, layout_for, read_options
from slipcar.envs.parameters import Parameters
from slipcar.envs.scenario import Scenario
from slipcar.envs.sources import Source, base_of, longest_horizon, source_of
from slipcar.envs.torch_backend import (
    checked_device,
    checked_dtype,
    compiled,
    tensor,
    torch_module,
)
from slipcar.envs.torch_paths import observe
from slipcar.envs.torch_worlds import TensorWorlds
from slipcar.envs.transition import goal_cost, proximity, step
from slipcar.envs.validate import checked_array, checked_int

if TYPE_CHECKING:
    from torch import Tensor


class Seen(NamedTuple):
    """What one step of the fleet led to: tensors (cars,) unless said otherwise.

    Attributes:
        state: five components of the states.
        least: the smallest signed distance to a rim since the start [m].
        observation: float32, (cars, d).
        reward: −(effort + obstacle).
        effort: of the step.
        obstacle: of the step.
        inside: whether the node lies in an obstacle.
        control: in physical units, (cars, 2).
    """

    state: Any
    least: Tensor
    observation: Tensor
    reward: Tensor
    effort: Tensor
    obstacle: Tensor
    inside: Tensor
    control: Tensor


class SlipCarTorchEnv(VectorEnv["Tensor", "Tensor", "Tensor"]):
    """Many `SlipCar-v0` at once as tensors on a device; see :class:`SlipCarEnv` for the task.

    Rewards, observations and `info` mean what they mean for :class:`SlipCarVectorEnv` with
    SAME_STEP autoreset, and all are tensors on the device. All episodes have the same number of
    steps, so all end together, and a step never waits for the device. The cars share one
    generator: their paths depend on the seed, on `num_envs`, and on the kind of device.

    With a family the worlds come from a pool, drawn at every `reset`; each episode puts every car
    into one of the pool's by chance (:mod:`slipcar.envs.torch_worlds`). Episodes do not end at a
    collision; `info["collision"]` tells of it.

    Args:
        num_envs: how many, at least 1.
        scenario: a :class:`Scenario`, a name, JSON text or data; or a :class:`Family` or
            `"family:NAME"`.
        observation: `"features"`, `"state"` or `"egocentric"`; float32.
        obstacle_slots: how many obstacles an observation shows; see `SlipCarEnv`.
        substeps: Euler–Maruyama steps per control interval.
        device: anything `torch.device` takes.
        dtype: `"float32"` or `"float64"`, or Torch's own: of states, rewards and costs.
        seed: of the first reset, if that has none.
        compile: fuse each step into few kernels with `torch.compile`: some seconds at the first
            step, and several times the speed from some 10⁴ cars.
        check_actions: whether actions that are not finite raise. To look makes the host wait for
            the device, so the default is to look on the processor alone; unchecked, they turn the
            car's states and rewards into NaN until its episode ends.
        pool: how many worlds of a family to draw at a reset, at least 1.

    Raises:
        ValueError: naming a bad argument.
        RuntimeError: if `compile` does not work on this machine.
        ImportError: if PyTorch is not installed.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Any = "paper",
        observation: str = "features",
        obstacle_slots: int | None = None,
        substeps: int = 1,
        device: Any = "cpu",
        dtype: Any = "float32",
        seed: int | None = None,
        compile: bool = False,
        check_actions: bool | None = None,
        pool: int = 16384,
    ) -> None:
        torch = torch_module()
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self.render_mode = None
        self.num_envs = checked_int("num_envs", num_envs, at_least=1)
        self.substeps = checked_int("substeps", substeps, at_least=1)
        self._pool = checked_int("pool", pool, at_least=1)
        self.device, self.dtype = checked_device(device), checked_dtype(dtype)
        self._source: Source = source_of(scenario)
        self.layout = layout_for(self._source, observation, obstacle_slots)
        self.single_action_space = Box(-1.0, 1.0, (CONTROL_DIM,), np.float32)
        self.single_observation_space = self.layout.space(longest_horizon(self._source))
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        check_source(self.layout, self.single_observation_space, self._source)
        self.check_actions = self.device.type == "cpu" if check_actions is None else check_actions
        self.compile = bool(compile)
        advance = functools.partial(_advance, self.layout, tensor_functions())
        self._advance = compiled(advance, self.device) if compile else advance
        self._seed = None if seed is None else checked_int("seed", seed, at_least=0)
        self._generator = torch.Generator(self.device)
        self._worlds: TensorWorlds | None = None
        #: Of the episode that runs: given variates, states (5 tensors), smallest distance, step.
        self._noise: Tensor | None = None
        self._x: Any = []
        self._least: Any = None
        self._step = 0
        self._scale: list[float] = []

    @property
    def scenario(self) -> Scenario:
        """The scenario that all share; of a family, what all its worlds share."""
        return base_of(self._source)

    @property
    def scenarios(self) -> list[Scenario]:
        """The world that each car is in; waits for the device.

        Raises:
            ResetNeeded: before the first reset.
        """
        return self._ready().scenarios()

    @property
    def states(self) -> Tensor:
        """The cars' states, (num_envs, 5) [m, m, rad, m/s, rad/s].

        Raises:
            ResetNeeded: before the first reset.
        """
        self._ready()
        return torch_module().stack(list(self._x), dim=-1)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start an episode in every car.

        Args:
            seed: None goes on with the generator (at first, one seeded from the system).
            options: `scenario`, as the argument of that name, until another is given; `noise`,
                standard normal variates (num_envs, N − 1, substeps, 3 + p) of this episode in
                place of drawn ones.

        Raises:
            ValueError: for an unknown option, or a bad value of one.
        """
        given, noise = read_options(options, ("scenario", "noise"))
        source = self._source
        if given is not None:
            source = source_of(given)
            check_source(self.layout, self.single_observation_space, source)
        if noise is not None:
            base = base_of(source)
            shape = (self.num_envs, base.nodes - 1, self.substeps, base.noise_dim)
            noise = checked_array("noise", noise, shape).transpose(1, 2, 3, 0)
            noise = tensor(noise, self.device, self.dtype)
        if seed is not None:
            checked_int("seed", seed, at_least=0)
        elif self._worlds is None:
            seed = self._seed
        if seed is not None or self._worlds is None:
            self._np_random, self._np_random_seed = seeding.np_random(seed)
            self._generator.manual_seed(int(self._np_random.integers(2**63)))
        if self._worlds is None or source is not self._source or isinstance(source, Family):
            self._source = source
            self._worlds = TensorWorlds(
                source, self.num_envs, self._pool, self.np_random, self.device, self.dtype
            )
        return self._start(noise)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """One control interval of every car.

        Args:
            actions: (num_envs, 2), clipped to [−1, 1]; no gradients flow.

        Returns:
            Observations float32 (num_envs, d), rewards, terminated and truncated (num_envs,), and
            the costs. When episodes end, observations and costs are those of the next ones' start,
            and `final_obs` and `final_info` those of the end.

        Raises:
            ValueError: for misshapen actions; or non-finite ones, if they are checked.
            ResetNeeded: before the first reset.
        """
        torch, worlds = torch_module(), self._ready()
        with torch.no_grad():
            seen = self._advance(
                worlds.parameters,
                self._scale,
                self._x,
                self._least,
                self._checked(actions),
                self._variates(),
                self._time(self._step + 1),
            )
            self._step += 1
            self._x, self._least = seen.state, seen.least
            over = self._step == base_of(self._source).nodes - 1
            goal, success = self._nothing(), self._all(False)
            reward = seen.reward
            if over:
                goal, success = goal_cost(worlds.parameters, self._x), self._arrived()
                reward = reward - goal
            info = {
                "effort": seen.effort,
                "obstacle": seen.obstacle,
                "goal": goal,
                "cost": seen.inside.to(self.dtype),
                "collision": self._least < 0.0,
                "clearance": self._least.clone(),
                "control": seen.control,
                "is_success": success,
            }
            observation = seen.observation
            if over:
                last = {"final_obs": observation, "final_info": info}
                observation, info = self._start(None)
                masks = {"_final_obs": self._all(True), "_final_info": self._all(True)}
                info = {**info, **last, **masks}
            return observation, reward, self._all(over), self._all(False), info

    def _ready(self) -> TensorWorlds:
        if self._worlds is None:
            raise ResetNeeded("call reset() first")
        return self._worlds

    def _start(self, noise: Tensor | None) -> tuple[Tensor, dict[str, Any]]:
        """New episodes for all, in new worlds where these differ."""
        torch, worlds, base = torch_module(), self._ready(), base_of(self._source)
        worlds.choose(self._generator)
        # Clones, for a compiled step may be handed only tensors that nobody else writes to.
        x = [component.clone() for component in worlds.start]
        for i in np.flatnonzero(base.start_deviation):
            x[i] += float(base.start_deviation[i]) * self._normal(self.num_envs)
        self._x, self._step, self._noise = x, 0, noise
        self._scale = base.action_scale.tolist()
        self._least = torch.full_like(x[0], torch.inf)
        if self.compile:  # a time that is a float would be compiled for each of its values
            self._times = torch.arange(base.nodes, device=self.device, dtype=self.dtype)
        p = worlds.parameters
        functions = tensor_functions()
        _, distance, rims = proximity(p, x, functions)
        info = {name: self._nothing() for name in ("effort", "obstacle", "goal", "cost")} | {
            "collision": self._all(False),
            "clearance": distance,
            "control": torch.zeros(self.num_envs, CONTROL_DIM, **self._where),
            "is_success": self._all(False),
        }
        seen = observe(self.layout, p, self._time(0), x, rims, functions)
        return seen.to(torch.float32), info

    def _checked(self, actions: Any) -> Tensor:
        torch = torch_module()
        try:
            actions = torch.as_tensor(actions).detach().to(**self._where)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"action must be an array of numbers, not {actions!r}") from error
        if actions.shape != (self.num_envs, CONTROL_DIM):
            wanted = (self.num_envs, CONTROL_DIM)
            raise ValueError(f"action must have shape {wanted}, not {tuple(actions.shape)}")
        if self.check_actions and not torch.isfinite(actions).all():
            index = torch.argwhere(~torch.isfinite(actions))[0].tolist()
            raise ValueError(
                f"action{index} is {actions[tuple(index)].item()}; actions must be finite "
                "(they are clipped to [-1, 1])"
            )
        return actions

    def _variates(self) -> Tensor:
        """Of this step, (substeps, 3 + p, num_envs): drawn now, so that they need little room."""
        if self._noise is not None:
            return self._noise[self._step]
        return self._normal(self.substeps, base_of(self._source).noise_dim, self.num_envs)

    def _normal(self, *shape: int) -> Tensor:
        return torch_module().randn(shape, generator=self._generator, **self._where)

    def _time(self, k: int) -> Any:
        dt = self._ready().parameters.dt
        return dt * (self._times[k] if self.compile else k)

    def _arrived(self) -> Tensor:
        tolerance = base_of(self._source).goal_tolerance.tolist()
        return arrived(self._x, self._ready().parameters.goal, tolerance) & (self._least >= 0.0)

    @property
    def _where(self) -> dict[str, Any]:
        return {"device": self.device, "dtype": self.dtype}

    def _nothing(self) -> Tensor:
        return torch_module().zeros(self.num_envs, **self._where)

    def _all(self, value: bool) -> Tensor:
        torch = torch_module()
        return torch.full((self.num_envs,), value, dtype=torch.bool, device=self.device)


def _advance(
    layout: Layout,
    functions: Functions,
    p: Parameters,
    scale: list[float],
    x: Any,
    least: Tensor,
    actions: Tensor,
    noise: Tensor,
    t: Any,
) -> Seen:
    """One control interval, up to time t: what a compiler may fuse."""
    import torch

    u = [torch.clamp(actions[:, i], -1.0, 1.0) * scale[i] for i in range(CONTROL_DIM)]
    moved = step(p, x, u, noise, functions)
    return Seen(
        state=moved.state,
        least=torch.minimum(least, moved.distance),
        observation=observe(layout, p, t, moved.state, moved.rims, functions).to(torch.float32),
        reward=-(moved.effort + moved.obstacle),
        effort=moved.effort,
        obstacle=moved.obstacle,
        inside=moved.distance < 0.0,
        control=torch.stack(u, dim=-1),
    )

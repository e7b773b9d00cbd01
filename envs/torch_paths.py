"""Paths and their costs in Torch: many at once on any device, and differentiable.

    J(u) = E[ effort + obstacle + goal ],     ∂J/∂u ≈ mean of ∂cost/∂u over paths

The noise of a path is drawn before it is driven and does not depend on the controls, so a path's
cost is a differentiable function of them (or of a policy's weights), and the mean of its gradients
is an unbiased estimate of the gradient of the expected cost: the pathwise, or reparametrised, one.
Collisions have no such gradient: how many there are jumps from path to path.

    noise = draw_noise(scenario, paths=4096, seed=0, device="cuda")
    path_costs(scenario, controls, noise).total.mean().backward()
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from slipcar.envs import observation as layouts
from slipcar.envs.arrays import Functions, tensor_functions
from slipcar.envs.car import CONTROL_DIM, STATE_DIM
from slipcar.envs.parameters import Parameters
from slipcar.envs.scenario import Scenario
from slipcar.envs.torch_backend import (
    checked_device,
    checked_dtype,
    compiled,
    dtype_of_network,
    tensor,
    torch_module,
)
from slipcar.envs.transition import goal_cost, proximity, step
from slipcar.envs.validate import checked_int

if TYPE_CHECKING:
    import torch
    from torch import Tensor

#: Controls (paths, 2) [m/s², rad/s²] from the time [s] and the states (paths, 5).
Policy: TypeAlias = "Callable[[float, Tensor], Tensor]"


class PathCosts(NamedTuple):
    """What each path cost (docs/method.md), and where it ended.

    Attributes:
        effort: Σ dt ‖u_k‖², (paths,).
        obstacle: Σ dt λ Σ_o max(0, c_o)², (paths,).
        goal: (x_N − x^f)ᵀ W (x_N − x^f), (paths,).
        total: their sum, (paths,).
        distance: the smallest signed distance to a rim at any node [m], (paths,); negative is a
            collision.
        state: x_N, (paths, 5).
    """

    effort: Tensor
    obstacle: Tensor
    goal: Tensor
    total: Tensor
    distance: Tensor
    state: Tensor


def draw_noise(
    scenario: Scenario,
    paths: int,
    substeps: int = 1,
    seed: int | torch.Generator | None = None,
    device: Any = "cpu",
    dtype: Any = "float32",
) -> Tensor:
    """Standard normal variates of many paths, drawn on the device.

    Args:
        scenario: says how many control steps and Brownian motions there are.
        paths: how many, at least 1.
        substeps: Euler–Maruyama steps in each control interval.
        seed: the same seed on the same kind of device gives the same variates; a generator of that
            device goes on from where it is; None takes Torch's own.
        device: anything `torch.device` takes.
        dtype: `float32` or `float64`.

    Returns:
        (N − 1, substeps, 3 + p, paths).

    Raises:
        ValueError: for a bad number, dtype or seed, or a device that is not there.
        ImportError: if PyTorch is not installed.
    """
    where, kind = checked_device(device), checked_dtype(dtype)
    shape = (
        scenario.nodes - 1,
        checked_int("substeps", substeps, at_least=1),
        scenario.noise_dim,
        checked_int("paths", paths, at_least=1),
    )
    return _normals(shape, seed, where, kind)


def draw_starts(
    scenario: Scenario,
    paths: int,
    seed: int | torch.Generator | None = None,
    device: Any = "cpu",
    dtype: Any = "float32",
) -> Tensor:
    """States at the start of many paths, (paths, 5): normal round the scenario's.

    Arguments and errors are those of :func:`draw_noise`. The same seed there and here would tie
    the start to the noise: pass a generator to both, or two seeds.
    """
    where, kind = checked_device(device), checked_dtype(dtype)
    shape = (checked_int("paths", paths, at_least=1), STATE_DIM)
    deviation = tensor(scenario.start_deviation, where, kind)
    return tensor(scenario.start, where, kind) + deviation * _normals(shape, seed, where, kind)


def path_costs(
    scenario: Scenario,
    controls: Tensor | Policy,
    noise: Tensor,
    start: Any = None,
    *,
    compile: bool = False,
) -> PathCosts:
    """Drive many paths and add up what they cost; gradients flow back to what is given.

    Device and dtype are the noise's. Controls are limited to the scenario's bounds as in the
    environment, and have no gradient beyond them.

    Args:
        scenario: the world.
        controls: in physical units, (N − 1, 2) for all paths; or a function of the time [s] and
            the states (paths, 5) that gives (paths, 2). See :func:`observed` for networks.
        noise: (N − 1, substeps, 3 + p, paths), as :func:`draw_noise` gives it.
        start: x(0), (5,) or (paths, 5); None is the scenario's.
        compile: fuse each interval into few kernels with `torch.compile`, which takes seconds
            once. Worth it from some 10⁵ paths.

    Raises:
        ValueError: for wrong shapes or types, naming them; or if the scenario's start is uncertain
            and none is given.
        RuntimeError: if `compile` does not work on this machine.
        ImportError: if PyTorch is not installed.
    """
    torch = torch_module()
    _check_noise(scenario, noise)
    x: Any = _starts(scenario, start, noise)
    control = _played(scenario, controls, noise)
    limits = None if scenario.control_bounds is None else scenario.control_bounds.tolist()
    p = Parameters.like(x[0], scenario)
    interval = _interval(noise.device if compile else None)
    # The effort of controls that are given is the same for all.
    effort = noise.new_zeros(noise.shape[3:] if callable(controls) else ())
    obstacle, distance = torch.zeros_like(x[0]), torch.full_like(x[0], torch.inf)
    for k in range(scenario.nodes - 1):
        u = control(k, x)
        if limits is not None:
            u = [torch.clamp(a, -most, most) for a, most in zip(u, limits, strict=True)]
        x, effort, obstacle, distance = interval(p, x, u, noise[k], effort, obstacle, distance)
    goal = goal_cost(p, x)
    effort = effort.expand_as(goal).contiguous()
    total = effort + obstacle + goal
    return PathCosts(effort, obstacle, goal, total, distance, torch.stack(list(x), dim=-1))


def observed(
    scenario: Scenario,
    network: Callable[[Tensor], Tensor],
    observation: str = "features",
    obstacle_slots: int = 0,
) -> Policy:
    """A network on the environment's observations as a policy for :func:`path_costs`.

    Args:
        scenario: the world.
        network: observations (paths, d) to actions (paths, 2), which are limited to [−1, 1] and
            scaled by the scenario's control bounds. It is shown the dtype of its own parameters,
            if it has some, else the states'.
        observation: `"features"`, `"state"` or `"egocentric"`.
        obstacle_slots: how many of the nearest obstacles are seen.

    Raises:
        ValueError: for an unknown kind or a bad number, or a scenario without control bounds.
    """
    torch, functions = torch_module(), tensor_functions()
    layout = layouts.Layout(observation, obstacle_slots)
    scenario.action_scale  # noqa: B018  raises if unbounded

    @functools.cache  # to copy them to a device at every step would make it wait
    def numbers(device: Any, dtype: Any) -> tuple[Parameters, Tensor]:
        like = torch.empty(1, device=device, dtype=dtype)
        return Parameters.like(like, scenario), tensor(scenario.action_scale, device, dtype)

    def policy(t: float, x: Tensor) -> Tensor:
        (p, scale), components = numbers(x.device, x.dtype), x.unbind(dim=-1)
        rims = proximity(p, components, functions)[2] if layout.slots else None
        seen = observe(layout, p, t, components, rims, functions)
        answer = network(seen.to(dtype_of_network(network) or seen.dtype))
        return torch.clamp(answer, -1.0, 1.0).to(scale.dtype) * scale

    return policy


def observe(
    layout: layouts.Layout, p: Parameters, t: Any, x: Any, rims: Any, functions: Functions
) -> Tensor:
    """`observation.entries` of tensors (paths,) side by side: (paths, d) in their dtype."""
    import torch

    seen, _ = layouts.entries(layout, p, t, x, rims, functions)
    seen += [0.0] * (layout.size - len(seen))
    # Some are the same for all: the time, and what worlds share.
    columns = [e if torch.is_tensor(e) else torch.full_like(x[0], e) for e in seen]
    return torch.stack([column.expand_as(x[0]) for column in columns], dim=-1)


@functools.cache
def _interval(device: torch.device | None = None) -> Callable[..., Any]:
    """:func:`_driven` for tensors, compiled if a device is given."""
    interval = functools.partial(_driven, tensor_functions())
    return interval if device is None else compiled(interval, device)


def _driven(
    functions: Functions,
    p: Parameters,
    x: Any,
    u: Any,
    noise: Tensor,
    effort: Tensor,
    obstacle: Tensor,
    distance: Tensor,
) -> tuple[Any, Tensor, Tensor, Tensor]:
    """One interval further: the states' components, the costs so far, the smallest distance."""
    import torch

    moved = step(p, x, u, noise, functions)
    nearest = torch.minimum(distance, moved.distance)
    return moved.state, effort + moved.effort, obstacle + moved.obstacle, nearest


def _played(
    scenario: Scenario, controls: Tensor | Policy, noise: Tensor
) -> Callable[[int, Any], Any]:
    """The two components of the controls, from the step and the states' five."""
    torch = torch_module()
    if callable(controls):
        policy, wanted = controls, (noise.shape[3], CONTROL_DIM)

        def decided(k: int, x: Any) -> Any:
            u = policy(k * scenario.dt, torch.stack(list(x), dim=-1))
            if not torch.is_tensor(u) or u.shape != wanted:
                given = tuple(u.shape) if torch.is_tensor(u) else type(u)
                raise ValueError(f"the policy must give controls {wanted}, not {given}")
            return u.to(noise.dtype).unbind(dim=-1)

        return decided
    if not torch.is_tensor(controls):
        raise ValueError(f"controls must be a tensor or a function, not {type(controls)}")
    shape = (scenario.nodes - 1, CONTROL_DIM)
    if controls.shape != shape:
        raise ValueError(f"controls must have shape {shape}, not {tuple(controls.shape)}")
    rows = controls.to(noise.device, noise.dtype)
    return lambda k, _: rows[k].unbind()


def _normals(shape: Any, seed: Any, device: torch.device, dtype: torch.dtype) -> Tensor:
    torch = torch_module()
    generator = seed
    if not isinstance(seed, torch.Generator) and seed is not None:
        checked_int("seed", seed, at_least=0)
        generator = torch.Generator(device).manual_seed(int(seed))
    return torch.randn(shape, generator=generator, device=device, dtype=dtype)


def _check_noise(scenario: Scenario, noise: Any) -> None:
    torch = torch_module()
    if not torch.is_tensor(noise) or not noise.is_floating_point():
        kind = noise.dtype if torch.is_tensor(noise) else type(noise).__name__
        raise ValueError(f"noise must be a tensor of floating-point numbers, not {kind}")
    wanted = (scenario.nodes - 1, scenario.noise_dim)
    if noise.ndim != 4 or (noise.shape[0], noise.shape[2]) != wanted or 0 in noise.shape:
        raise ValueError(
            f"noise must have shape ({wanted[0]}, substeps, {wanted[1]}, paths), "
            f"not {tuple(noise.shape)}"
        )


def _starts(scenario: Scenario, start: Any, noise: Tensor) -> list[Tensor]:
    """Five components (paths,)."""
    torch = torch_module()
    paths = noise.shape[3]
    if start is None:
        if scenario.start_deviation.any():
            raise ValueError(
                "the scenario's start is uncertain (start_deviation > 0): pass "
                "start=draw_starts(...), or start=scenario.start for its mean"
            )
        start = scenario.start
    if not torch.is_tensor(start):
        start = tensor(start, noise.device, noise.dtype)
    if start.shape not in ((STATE_DIM,), (paths, STATE_DIM)):
        raise ValueError(f"start must have shape (5,) or ({paths}, 5), not {tuple(start.shape)}")
    start = start.to(noise.device, noise.dtype).expand(paths, STATE_DIM)
    return [component.contiguous() for component in start.unbind(dim=-1)]

"""Worlds for a fleet on a device: one for all, or one for each car and episode from a pool.

A family's worlds are drawn on the host by :meth:`Family.draw`, as for every other environment: at
each `reset` a pool of them, from which each episode takes one for each car, chosen by chance on
the device. To draw anew for every episode would leave a GPU waiting for its host.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from slipcar.envs.families import Family
from slipcar.envs.fleet import Worlds
from slipcar.envs.parameters import Parameters
from slipcar.envs.scenario import Scenario
from slipcar.envs.sources import base_of
from slipcar.envs.torch_backend import tensor, torch_module

if TYPE_CHECKING:
    import torch
    from torch import Tensor


class TensorWorlds:
    """The worlds that cars on a device drive in.

    Attributes:
        source: what they are drawn from.
        parameters: the numbers of a step: floats where all cars share them, else tensors (cars,).
        start: means of the states at the start, five tensors (cars,).
        which: each car's row of the pool, (cars,), or None where all share one scenario.

    Args:
        source: a scenario, or a family.
        cars: how many.
        pool: how many worlds of a family to draw.
        rng: what the pool is drawn with.
        device: where the numbers go.
        dtype: of the numbers.
    """

    def __init__(
        self,
        source: Scenario | Family,
        cars: int,
        pool: int,
        rng: np.random.Generator,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.source, self._cars, self._device = source, cars, device
        base = base_of(source)
        shape = torch_module().empty(cars, device=device, dtype=dtype)
        self.parameters = Parameters.like(shape, base)
        self.which: Tensor | None = None
        self._pool: Worlds | None = None
        start = base.start[:, None].repeat(cars, axis=1)
        if isinstance(source, Family):
            #: The words that the pool was drawn from, (pool, source.words).
            self.words = rng.integers(0, 2**64, size=(pool, source.words), dtype=np.uint64)
            self._pool = Worlds(pool, np.float64, base)
            self._pool.put(np.arange(pool), source, source.draw(self.words))
            start = self._pool.start
            self._drawn = varied(
                self._pool.parameters, self.parameters, lambda a: tensor(a, device, dtype)
            )
        self._starts = tensor(start, device, dtype)
        self.start = list(self._starts.unbind())

    def choose(self, generator: torch.Generator) -> None:
        """Put every car into a world of the pool, by chance."""
        if self._pool is None:
            return
        torch = torch_module()
        rows = self._starts.shape[1]
        which = torch.randint(rows, (self._cars,), generator=generator, device=self._device)
        self.which = which
        self.start = list(self._starts[:, which].unbind())
        self.parameters = varied(self._drawn, self._drawn, lambda a: a[..., which])

    def scenarios(self) -> list[Scenario]:
        """Each car's world, brought to the host."""
        base = base_of(self.source)
        if self._pool is None or self.which is None:
            return [base] * self._cars
        rows, inverse = np.unique(self.which.cpu().numpy(), return_inverse=True)
        worlds = [self._pool.scenario(int(row), self.source) for row in rows]
        return [worlds[i] for i in inverse]


def varied(p: Parameters, shared: Parameters, f: Callable[[Any], Any]) -> Parameters:
    """The numbers that a family varies as f(those of `p`), and the rest as in `shared`."""
    return shared._replace(
        dt=f(p.dt),
        horizon=f(p.horizon),
        slip=[f(s) for s in p.slip],
        goal=[f(g) for g in p.goal],
        obstacles=tuple(f(column) for column in p.obstacles),
    )

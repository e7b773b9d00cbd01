"""Rates of a plan's violations: machine code where there is one, few paths where few will do."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.moments.monte_carlo import BLOCK, Kept, Law, chain, control_of, path
from slipcar.planner.newton.paths import CompiledPaths, compiles
from slipcar.planner.newton.posing import Posed, pose
from slipcar.planner.newton.running import Steered
from slipcar.planner.problem.model import Model
from slipcar.planner.search.tasks import in_threads

Array = np.ndarray

#: Substeps of an interval to begin with, and at most; see :meth:`Counting.refine`.
_SUBSTEPS, _FINEST = 4, 64
#: Blocks of paths that judge a number of substeps, and those after which a rate that is more than
#: so many standard errors off its target needs no more.
_JUDGED, _FIRST, _OFF = 6, 4, 4.0


class Counting:
    """Counts paths of plans of one model.

    Args:
        model: the plans'; at nodes, its integrator makes the chain.
        posed: the problem with its constraints as rows.
        at_path: whether to count at every instant of the SDE, or at nodes of the chain.

    Attributes:
        substeps: of each interval, in verification; 1 at nodes.
        seconds: spent so far.
    """

    def __init__(self, model: Model, posed: Posed, *, at_path: bool) -> None:
        self._model, self._posed, self.at_path = model, posed, at_path
        self.substeps, self.seconds = _SUBSTEPS if at_path else 1, 0.0
        self._coarse = 1.0  # the rate in `substeps`, of that in as few as possible

    def rates(self, plan: Steered, episodes: int, seed: int) -> tuple[float, float]:
        """Share of paths that violate, as promised and at nodes; path i depends on (seed, i)."""
        return self._rates(plan, episodes, seed, self.substeps, None)

    def search_rate(self, plan: Steered, episodes: int, seed: int, target: float) -> float:
        """What :meth:`rates` would say; on the path in few substeps, and few paths if far off."""
        if not self.at_path:
            return self.rates(plan, episodes, seed)[0]
        substeps = min(_SUBSTEPS, self.substeps)
        return self._coarse * self._rates(plan, episodes, seed, substeps, target / self._coarse)[0]

    def refine(self, plan: Steered, delta: float, episodes: int, seed: int) -> None:
        """Double the substeps until the rate moves by less than its error.

        Both numbers of substeps see the same Brownian motions. The error is that of a rate δ on
        `episodes` paths; a rate that is not near δ moves in proportion.
        """
        if not self.at_path:
            return
        began, error = time.perf_counter(), math.sqrt(delta * (1.0 - delta) / episodes)
        self.substeps, self._coarse = _SUBSTEPS, 1.0
        while self.substeps < _FINEST:
            blocks = [(seed, block) for block in range(_JUDGED)]
            pairs = self._each(plan, blocks, lambda driven, at: driven.pair(*at, self.substeps))
            fine, coarse = 1.0 - np.mean(pairs, axis=(0, 2))
            if self.substeps > _SUBSTEPS and coarse > 0.0:
                self._coarse *= fine / coarse
            if abs(fine - coarse) * delta <= error * max(fine, delta):
                break
            self.substeps *= 2
        self.seconds += time.perf_counter() - began

    def _rates(
        self, plan: Steered, episodes: int, seed: int, substeps: int, target: float | None
    ) -> tuple[float, float]:
        began = time.perf_counter()
        blocks = [(seed, block) for block in range(-(-episodes // BLOCK))]
        broken: list[Array] = []
        for first in range(0, len(blocks), _FIRST):
            group = blocks[first : first + _FIRST]
            kept = self._each(plan, group, lambda driven, at: driven.kept(*at, substeps))
            broken += [1.0 - np.asarray(each) for each in kept]
            if target is not None:
                p = np.concatenate(broken, axis=1)[0]
                if abs(p.mean() - target) > _OFF * max(p.std(), target**0.5) / len(p) ** 0.5:
                    break
        rates = np.concatenate(broken, axis=1)[:, :episodes].mean(axis=1)
        self.seconds += time.perf_counter() - began
        return float(rates[0]), float(rates[-1])

    def _each(
        self, plan: Steered, blocks: list[Any], count: Callable[[Any, Any], Any]
    ) -> list[Any]:
        """What `count` says of blocks, shared out over threads: the numbers do not depend on it."""
        self._simulated  # noqa: B018  traced once, by one thread
        return in_threads(lambda at: count(self._driven(plan), at), blocks, 0)

    def _driven(self, plan: Steered) -> Any:
        law = Law(plan.x, plan.u, plan.gains)
        model, posed = self._simulated
        if compiles(posed):
            return _Compiled(posed, law, self.at_path)
        return _InNumPy(model, law, self.at_path)

    @functools.cached_property
    def _simulated(self) -> tuple[Model, Posed]:
        """The chain is the plan's own; a path's drift is integrated in substeps."""
        if not self.at_path:
            return self._model, self._posed
        model = dataclasses.replace(self._model, integrator="midpoint")
        compiled = None if self._posed.native else False
        return model, pose(model, constraints=True, compiled=compiled)


class _Compiled:
    def __init__(self, posed: Posed, law: Law, on_path: bool) -> None:
        self._paths, self._on_path = CompiledPaths(posed, law), on_path

    def kept(self, seed: int, block: int, substeps: int) -> Kept | list[Array]:
        if not self._on_path:
            return [self._paths.chain(seed, block)]
        return self._paths.path(seed, block, substeps, False)[0]

    def pair(self, seed: int, block: int, substeps: int) -> list[Array]:
        return [kept.path for kept in self._paths.path(seed, block, substeps, True)]


class _InNumPy:
    def __init__(self, model: Model, law: Law, on_path: bool) -> None:
        self._model, self._control, self._on_path = model, control_of(model, law), on_path

    def kept(self, seed: int, block: int, substeps: int) -> Kept | list[Array]:
        if not self._on_path:
            return [chain(self._model, self._control, seed, block)]
        return path(self._model, self._control, seed, block, substeps)[0]

    def pair(self, seed: int, block: int, substeps: int) -> list[Array]:
        return [kept.path for kept in path(self._model, self._control, seed, block, substeps, True)]

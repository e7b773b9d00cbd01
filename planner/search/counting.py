"""Rates of a plan's violations: machine code where there is one, few paths where few will do."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from typing import Any

import numpy as np

from slipcar.planner.moments.monte_carlo import BLOCK, Kept, Law, chain, control_of, path
from slipcar.planner.newton.paths import CompiledPaths, compiles
from slipcar.planner.newton.posing import Posed, pose
from slipcar.planner.newton.running import Steered
from slipcar.planner.problem.model import Model

Array = np.ndarray

#: Substeps of an interval to begin with, and at most; see :meth:`Counting.refine`.
_SUBSTEPS, _FINEST = 4, 64
#: Blocks of paths that judge a number of substeps, and those after which a rate that is more than
#: so many standard errors off its target needs no more.
_JUDGED, _FIRST, _OFF = 5, 4, 4.0


class Counting:
    """Counts paths of plans of one model.

    Args:
        model: the plans'; at nodes, its integrator makes the chain.
        posed: the problem with its constraints as rows.
        at_path: whether to count at every instant of the SDE, or at nodes of the chain.

    Attributes:
        substeps: of each interval; 1 at nodes.
        seconds: spent so far.
    """

    def __init__(self, model: Model, posed: Posed, *, at_path: bool) -> None:
        self._model, self._posed, self.at_path = model, posed, at_path
        self.substeps, self.seconds = _SUBSTEPS if at_path else 1, 0.0

    def rate(
        self, plan: Steered, episodes: int, seed: int, target: float | None = None
    ) -> tuple[float, float]:
        """Share of paths that violate, as promised and at nodes.

        Args:
            plan: whose law drives.
            episodes: how many paths; path i depends on (seed, i), and on the substeps.
            seed: of the Brownian paths.
            target: where the first paths tell that the rate is far off it, they are enough.
        """
        began, driven = time.perf_counter(), self._driven(plan)
        broken: list[Array] = []
        for block in range(-(-episodes // BLOCK)):
            kept = driven.path(seed, block, self.substeps) if self.at_path else driven(seed, block)
            broken.append(1.0 - np.asarray(kept))
            if target is not None and block % _FIRST == _FIRST - 1:
                p = np.concatenate(broken, axis=1)[0]
                if abs(p.mean() - target) > _OFF * max(p.std(), target**0.5) / len(p) ** 0.5:
                    break
        rates = np.concatenate(broken, axis=1)[:, :episodes].mean(axis=1)
        self.seconds += time.perf_counter() - began
        return float(rates[0]), float(rates[-1])

    def refine(self, plan: Steered, delta: float, episodes: int, seed: int) -> bool:
        """Double the substeps until the rate moves by less than its error; whether they changed.

        Both numbers of substeps see the same Brownian motions. The error is that of a rate δ on
        `episodes` paths; a rate that is not near δ moves in proportion.
        """
        if not self.at_path:
            return False
        began, before, driven = time.perf_counter(), self.substeps, self._driven(plan)
        error = math.sqrt(delta * (1.0 - delta) / episodes)
        while self.substeps < _FINEST:
            pairs = [driven.pair(seed, block, self.substeps) for block in range(_JUDGED)]
            fine, coarse = 1.0 - np.mean(pairs, axis=(0, 2))
            if abs(fine - coarse) * delta <= error * max(fine, delta):
                break
            self.substeps *= 2
        self.seconds += time.perf_counter() - began
        return self.substeps != before

    def _driven(self, plan: Steered) -> Any:
        law = Law(plan.x, plan.u, plan.gains)
        model, posed = self._simulated
        return _Compiled(CompiledPaths(posed, law)) if compiles(posed) else _InNumPy(model, law)

    @functools.cached_property
    def _simulated(self) -> tuple[Model, Posed]:
        """The chain is the plan's own; a path's drift is integrated in substeps."""
        if not self.at_path:
            return self._model, self._posed
        model = dataclasses.replace(self._model, integrator="midpoint")
        compiled = None if self._posed.native else False
        return model, pose(model, constraints=True, compiled=compiled)


class _Compiled:
    def __init__(self, paths: CompiledPaths) -> None:
        self._paths = paths

    def __call__(self, seed: int, block: int) -> Array:
        return self._paths.chain(seed, block)[None]

    def path(self, seed: int, block: int, substeps: int) -> Kept:
        return self._paths.path(seed, block, substeps, False)[0]

    def pair(self, seed: int, block: int, substeps: int) -> list[Array]:
        return [kept.path for kept in self._paths.path(seed, block, substeps, True)]


class _InNumPy:
    def __init__(self, model: Model, law: Law) -> None:
        self._model, self._control = model, control_of(model, law)

    def __call__(self, seed: int, block: int) -> Array:
        return chain(self._model, self._control, seed, block)[None]

    def path(self, seed: int, block: int, substeps: int) -> Kept:
        return path(self._model, self._control, seed, block, substeps)[0]

    def pair(self, seed: int, block: int, substeps: int) -> list[Array]:
        return [kept.path for kept in path(self._model, self._control, seed, block, substeps, True)]

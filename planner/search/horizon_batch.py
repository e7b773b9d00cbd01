"""Replanning for many episodes that are at the same interval, from what each observes.

A replan begins where the episode's last plan leads from the observed state by its own feedback,

    x_0 = observed,   e_k = x_k − μ_k,   u_k = ū_k + K_k e_k,   e_{k+1} = (A + BK)_k e_k

which is, to first order, already the answer, and takes over gains, the weights of the rows and
the multipliers. A few steps of :mod:`slipcar.planner.expected.loop` remain to be made.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from slipcar.planner.expected import loop
from slipcar.planner.moments.stakes import Stakes
from slipcar.planner.newton.functions import Functions
from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.model import Model
from slipcar.planner.status import Status

Array = np.ndarray

#: Largest difference between a replan's mean and the path of its controls, per unit of the state.
CONSISTENCY = 1e-2


@dataclasses.dataclass(frozen=True, eq=False)
class Tails:
    """Plans of P episodes from a node on, K intervals before the end; never written to.

    Attributes:
        x: means, (P, K + 1, n).
        u: controls, (P, K, m).
        gains: (P, K, m, n).
        held: what the rows' spread is charged, (P, K, p).
        adjoint: (P, K, n).
        terminal: (P, q).
        A: ∂x⁺/∂x along the plan, (P, K, n, n).
        B: ∂x⁺/∂u, (P, K, n, m).
    """

    x: Array
    u: Array
    gains: Array
    held: Array
    adjoint: Array
    terminal: Array
    A: Array
    B: Array

    @classmethod
    def of(cls, plan: loop.Steered) -> Tails:
        """One plan, P = 1."""
        return cls(**{name: getattr(plan, name)[None] for name in FIELDS})

    def __len__(self) -> int:
        return len(self.x)

    def later(self, intervals: int) -> Tails:
        """The same plans so many intervals later: a view."""
        if intervals == 0:
            return self
        return self._each(lambda name, a: a if name == "terminal" else a[:, intervals:])

    def take(self, rows: Array) -> Tails:
        """Those of some episodes, (P',): a copy."""
        return self._each(lambda name, a: a[rows])

    def repeat(self, count: int) -> Tails:
        """The one plan for so many episodes: a view."""
        return self._each(lambda name, a: np.broadcast_to(a, (count, *a.shape[1:])))

    def choose(self, here: Array, other: Tails) -> Tails:
        """These plans where `here` (P,), the others elsewhere."""
        if here.all():
            return self

        def chosen(name: str, a: Array) -> Array:
            mask = here.reshape(-1, *[1] * (a.ndim - 1))
            return np.where(mask, a, getattr(other, name))

        return self._each(chosen)

    @classmethod
    def join(cls, parts: list[tuple[Array, Tails]], count: int) -> Tails:
        """Episodes from several places: rows (P_i,) of each part, together 0..count − 1."""
        if len(parts) == 1:
            rows, tails = parts[0]
            return tails if np.array_equal(rows, np.arange(count)) else tails.take(np.argsort(rows))
        joined = {}
        for name in FIELDS:
            shape = getattr(parts[0][1], name).shape[1:]
            joined[name] = np.empty((count, *shape))
            for rows, tails in parts:
                joined[name][rows] = getattr(tails, name)
        return cls(**joined)

    def law(self, x: Array) -> Array:
        """ū + K (x − μ) at the first node, for states (P, n): (P, m)."""
        # A sum rather than a matrix product: the same bits for any number of episodes.
        error = x - self.x[:, 0]
        return self.u[:, 0] + (self.gains[:, 0] * error[:, None, :]).sum(axis=-1)

    def steered_from(self, x: Array) -> tuple[Array, Array]:
        """Where the plans' feedback leads from states x (P, n), to first order.

        Returns:
            States (P, K + 1, n) and controls (P, K, m).
        """
        states, controls = np.array(self.x), np.array(self.u)
        closed = self.A + self.B @ self.gains
        errors = np.empty_like(controls, shape=(*controls.shape[:2], x.shape[1]))
        error = x - states[:, 0]
        for k in range(controls.shape[1]):
            errors[:, k] = error
            # A sum rather than a matrix product: the same bits for any number of episodes.
            error = np.add.reduce(closed[:, k] * error[:, None, :], axis=-1)
        states[:, :-1] += errors
        states[:, -1] += error
        states[:, 0] = x
        controls += np.add.reduce(self.gains * errors[:, :, None, :], axis=-1)
        return states, controls

    def _each(self, f: Callable[[str, Array], Array]) -> Tails:
        return Tails(**{name: f(name, getattr(self, name)) for name in FIELDS})


FIELDS = tuple(field.name for field in dataclasses.fields(Tails))


@dataclasses.dataclass(frozen=True, eq=False)
class Replanner:
    """Makes new plans from observed states.

    Attributes:
        model: of the whole horizon.
        functions: of its problem.
        stakes: what is charged.
        iterations: steps of the iteration, at most.
        tolerance: of the iteration.
        workers: threads.
        run: the compiled iteration; None runs the one in NumPy.
    """

    model: Model
    functions: Functions
    stakes: Stakes
    iterations: int
    tolerance: float
    workers: int
    run: ModuleType | None

    def replan(self, tails: Tails, x: Array, interval: int) -> tuple[Tails, Array]:
        """New plans for the intervals from `interval` on, from states x (P, n).

        Args:
            tails: the plans up to now, of that horizon.
            x: observed states, (P, n).
            interval: which one begins now.

        Returns:
            Plans, and which of them can be used, (P,): finite, consistent with their own
            controls, and not where the iteration gave up.
        """
        states, controls = tails.steered_from(x)
        lower, upper = self.model.lower, self.model.upper
        np.clip(controls, lower, upper, out=controls)
        found, ok = (self._slowly if self.run is None else self._compiled)(
            tails, states, controls, interval
        )
        return found, ok & self._sound(found, interval)

    def first(self, x: Array, u: Array, max_iterations: int) -> loop.Steered:
        """The plan of the whole horizon from states x (N, n) and controls u (K, m).

        Raises:
            ValueError: if the problem's functions are not finite along them.
        """
        iterate = loop.iterate if self.run is None else self.run.iterate
        found: loop.Steered = iterate(
            self.model,
            self.functions,
            self.stakes,
            x,
            u,
            tolerance=self.tolerance,
            max_iterations=max_iterations,
        )
        return found

    def _compiled(
        self, tails: Tails, states: Array, controls: Array, interval: int
    ) -> tuple[Tails, Array]:
        assert self.run is not None
        assert self.functions.kernels is not None
        p, q = tails.held.shape[2], tails.terminal.shape[1]
        batch = self.run.Batch.of(states, controls, p, q)
        for name in ("gains", "held", "adjoint", "terminal"):
            getattr(batch, name)[:] = getattr(tails, name)
        self.run.advance(
            self.functions.kernels,
            self.model,
            self.functions.parameters,
            self.stakes,
            batch,
            times=self.model.times[interval:],
            tolerance=self.tolerance,
            max_iterations=self.iterations,
            warm=True,
            workers=self.workers,
        )
        usable = [code for code, status in self.run.STATUS.items() if status in _USABLE]
        new = Tails(**{name: getattr(batch, name) for name in FIELDS})
        return new, np.isin(batch.ended[:, 0], usable)

    def _slowly(
        self, tails: Tails, states: Array, controls: Array, interval: int
    ) -> tuple[Tails, Array]:
        times = self.model.times[interval:]
        known = np.zeros_like(self.model.start_covariance)  # the state is observed
        model = dataclasses.replace(
            self.model, times=times, dt=np.diff(times), start_covariance=known
        )
        found, ok = {name: np.array(getattr(tails, name)) for name in FIELDS}, []
        for i in range(len(tails)):
            warm: Any = _Warm(*(getattr(tails, f.name)[i] for f in dataclasses.fields(_Warm)))
            try:
                new = loop.iterate(
                    model, self.functions, self.stakes, states[i], controls[i],
                    tolerance=self.tolerance, max_iterations=self.iterations, warm=warm,
                )  # fmt: skip
            except (ValueError, np.linalg.LinAlgError):  # not finite
                ok.append(False)
                continue
            for name in FIELDS:
                found[name][i] = getattr(new, name)
            ok.append(new.status in _USABLE)
        return Tails(**found), np.array(ok, dtype=bool)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def _sound(self, found: Tails, interval: int) -> Array:
        """Whether plans are finite and their means follow their controls, (P,)."""
        axes = {name: tuple(range(1, getattr(found, name).ndim)) for name in FIELDS}
        # A sum is finite only if every entry is.
        total = sum(getattr(found, name).sum(axis=axes[name]) for name in FIELDS)
        times = self.model.times[interval:]
        P, K = found.u.shape[:2]
        t, dt = np.broadcast_to(times[:-1], (P, K)), np.broadcast_to(np.diff(times), (P, K))
        before, after = found.x[:, :-1], found.x[:, 1:]
        model = self.model
        moved = change(model.integrator, model.drift, t, dt, before, found.u)
        gap = np.abs(before + moved - after).max(axis=(1, 2))
        return np.isfinite(total) & (gap <= CONSISTENCY * (1.0 + np.abs(found.x).max(axis=(1, 2))))


#: How a replan may end: with few iterations, seldom converged to the tolerance.
_USABLE = (Status.CONVERGED, Status.MAX_ITERATIONS)


@dataclasses.dataclass(frozen=True)
class _Warm:
    """What `loop.iterate` takes over from a plan."""

    gains: Array
    held: Array
    adjoint: Array
    terminal: Array

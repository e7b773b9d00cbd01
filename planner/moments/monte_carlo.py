"""How often a controller breaks a constraint: paths of the non-linear equation, counted.

Two answers, from x_0 ~ N(start, Σ_0) with the control held over each interval, Δ(x; h) a step of
the model's integrator and ξ standard normal:

* the *chain* on the planner's own nodes, x_{k+1} = x_k + Δ(x_k; dt) + √dt σ(t_k, x_k) ξ_k, for
  Euler's integrator that of Euler and Maruyama: does it break a constraint at a node?
* the *path* of the SDE, in m substeps of h = dt/m, each half a drift, the noise, the other half:

      y = x + Δ(x; h/2),    z = y + √h σ(t + h/2, y) ξ,    x⁺ = z + Δ(z; h/2)

  Does it break a constraint at any instant? Between substeps it is a Brownian bridge
  (:mod:`.bridge`). Strang's splitting has no error of first order where noise is additive or is a
  function of states that it does not reach, where Euler and Maruyama's substeps have one.

Starts and noise are common to all controllers: path i of a seed meets the same x_0 and ξ whoever
drives and however many paths are asked for, so two rates differ by what the controllers do, and a
search over plans sees a nearly monotone function.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from slipcar.planner.moments.bridge import crossing
from slipcar.planner.moments.gains import wrap
from slipcar.planner.options import check_count
from slipcar.planner.problem.integrators import change
from slipcar.planner.problem.model import Model, model_of
from slipcar.planner.problem.protocol import Problem

Array = np.ndarray

#: Paths stepped together: enough to hide Python's overhead, few enough to stay in the cache.
#: Part of what a seed means: other blocks, other paths.
BLOCK = 2048
#: Which stream of a block starts are drawn from.
_START = 1


def violations(
    problem: Problem,
    control: Callable[[float, Array], Array],
    *,
    episodes: int,
    seed: int,
    project: Callable[[Array], Array] | None = None,
) -> Array:
    """Which paths break `problem.constraint` at a node 1..N−1, (episodes,) of bool.

    Starts are drawn from N(start, start_covariance). A path whose state or constraint is no longer
    a finite number counts as one that does: nothing can be promised for it.

    Args:
        problem: with `constraint(t, x)` -> (..., p), violated where > 0.
        control: (t_k [s], states (batch, n)) -> controls (batch, m) in physical units, or (m,)
            for all; `OpenLoop(p).control`, for example.
        episodes: how many paths, ≥ 1.
        seed: of the Brownian paths, ≥ 0; path i depends on (seed, i) alone.
        project: applied to the controls before they act, e.g. clipping to the bounds.

    Raises:
        TypeError: if the problem lacks a required member.
        ValueError: if it has no `constraint`, if a function's result has the wrong shape, or for
            a bad number of episodes or seed.
    """
    if getattr(problem, "constraint", None) is None:
        raise ValueError(
            f"{type(problem).__name__} has no constraint(t, x) -> (..., p), violated where > 0: "
            f"without one there is no risk to measure"
        )
    check_count("episodes", episodes)
    check_count("seed", seed, least=0)
    model = model_of(problem)
    drive = control if project is None else lambda t, x: project(control(t, x))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        blocks = [~chain(model, drive, seed, b) for b in range(-(-episodes // BLOCK))]
    return np.concatenate(blocks)[:episodes]


class Law(NamedTuple):
    """The law u = ū_k + K_k (x − μ_k) of a plan, within its bounds.

    Attributes:
        x: μ, (N, n).
        u: ū, (N−1, m).
        gains: K, (N−1, m, n); zeros in open loop.
    """

    x: Array
    u: Array
    gains: Array


class Kept(NamedTuple):
    """How likely each path keeps its constraints, given its steps; (paths,) each.

    Attributes:
        path: at every instant.
        nodes: at every node 1..N−1, 0 or 1.
    """

    path: Array
    nodes: Array


def control_of(model: Model, law: Law) -> Callable[[float, Array], Array]:
    """A law within bounds, as a function (t, x (..., n)) -> (..., m)."""
    angles = tuple(getattr(model.problem, "angles", ()))
    closed = bool(law.gains.any())

    def control(t: float, x: Array) -> Array:
        k = int(np.argmin(np.abs(model.times[:-1] - t)))
        if not closed:
            return np.broadcast_to(law.u[k], (*np.shape(x)[:-1], law.u.shape[1]))
        return model.admissible(law.u[k] + wrap(x - law.x[k], angles) @ law.gains[k].T)

    return control


def block_generator(seed: int, *key: int) -> np.random.Generator:
    """Where a block's noise comes from."""
    # A spawned child, never SeedSequence((seed, block)): the paths of an evaluation come from
    # there, and a risk verified on the very paths it is later judged by would verify nothing.
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def block_starts(model: Model, seed: int, block: int) -> Array:
    """x(0) of each path of a block, (BLOCK, n)."""
    x = np.tile(model.start, (BLOCK, 1))
    if model.start_covariance.any():
        # Of a stream of their own: the Brownian paths stay those of a known start.
        normal = block_generator(seed, block, _START).standard_normal(x.shape)
        values, vectors = np.linalg.eigh(model.start_covariance)
        x += normal @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    return x


def _gaps(model: Model, t: Array, x: Array) -> Array:
    """−h of each path, (BLOCK, p); NaN where the state is no longer finite."""
    h = np.asarray(model.problem.constraint(t, x))  # type: ignore[attr-defined]
    if h.ndim != 2 or len(h) != BLOCK:
        raise ValueError(
            f"constraint(t, x) must have shape ({BLOCK}, p) for {BLOCK} states, not {h.shape}"
        )
    if np.isfinite(x.sum()):  # a sum is cheap; only when it is not finite look closer
        return -h
    return np.where(np.isfinite(x).all(axis=1)[:, None], -h, np.nan)


def _controls(model: Model, control: Callable[[float, Array], Array], t: float, x: Array) -> Array:
    u = np.asarray(control(t, x))
    if u.shape not in ((model.control_dim,), (BLOCK, model.control_dim)):
        raise ValueError(
            f"control(t, x) must have shape ({BLOCK}, {model.control_dim}) for {BLOCK} states, or "
            f"({model.control_dim},) for all of them, not {u.shape}"
        )
    return np.broadcast_to(u, (BLOCK, model.control_dim))


def chain(model: Model, control: Callable[[float, Array], Array], seed: int, block: int) -> Array:
    """Which paths of one block keep the constraints at every node, (BLOCK,) of bool.

    Always a whole block: results may round by its shape.
    """
    rng, x = block_generator(seed, block), block_starts(model, seed, block)
    kept = np.ones(BLOCK, dtype=bool)
    for k, dt in enumerate(model.dt):
        t = np.full(BLOCK, model.times[k])  # one for each path: all functions are batched alike
        u = _controls(model, control, float(model.times[k]), x)
        sigma = model.diffusion(t, x)
        noise = np.sqrt(dt) * rng.standard_normal((BLOCK, sigma.shape[-1]))
        moved = change(model.integrator, model.drift, t, dt, x, u)
        x = x + moved + np.einsum("bij,bj->bi", sigma, noise)
        at = np.full(BLOCK, model.times[k + 1])
        kept &= (_gaps(model, at, x) >= 0.0).all(axis=1)  # NaN is a violation
        lost = ~np.isfinite(x).all(axis=1)
        x[lost] = model.start  # any finite state: their verdict stands
    return kept


def path(
    model: Model,
    control: Callable[[float, Array], Array],
    seed: int,
    block: int,
    substeps: int,
    halved: bool = False,
) -> list[Kept]:
    """What the paths of one block keep; `halved` in half as many substeps too, the finer first.

    Both see the same Brownian motion.
    """
    rng = block_generator(seed, block)
    strands = [_Strand(model, block_starts(model, seed, block)) for _ in range(1 + halved)]
    for k, dt in enumerate(model.dt):
        h, t, coarse = dt / substeps, float(model.times[k]), np.zeros(())
        held = [_controls(model, control, t, strand.x) for strand in strands]
        d = np.shape(model.diffusion(np.full(1, t), model.start[None]))[-1]
        for j in range(substeps):
            noise = rng.standard_normal((BLOCK, d))
            strands[0].move(t + j * h, h, held[0], noise)
            coarse = coarse + noise if j % 2 else noise
            if halved and j % 2:
                strands[1].move(t + (j - 1) * h, 2.0 * h, held[1], coarse * np.sqrt(0.5))
        for strand in strands:
            strand.nodes *= strand.whole
    return [Kept(strand.kept, strand.nodes) for strand in strands]


class _Strand:
    """Paths of a block, on their way."""

    def __init__(self, model: Model, x: Array) -> None:
        self._model, self.x = model, x
        self.gap = _gaps(model, np.full(BLOCK, model.times[0]), x)
        self.whole = (self.gap >= 0.0).all(axis=1)
        self.kept, self.nodes = self.whole.astype(float), np.ones(BLOCK)

    def move(self, t: float, h: float, u: Array, noise: Array) -> None:
        """One substep, its bridges charged."""
        model, half = self._model, np.full(BLOCK, 0.5 * h)
        begin, middle, end = (np.full(BLOCK, t + part * h) for part in (0.0, 0.5, 1.0))
        x = self.x + change(model.integrator, model.drift, begin, half, self.x, u)
        sigma = model.diffusion(middle, x)
        pushed = np.asarray(model.jacobians.state("constraint", middle, x)) @ sigma
        x = x + np.einsum("bij,bj->bi", sigma, np.sqrt(h) * noise)
        x = x + change(model.integrator, model.drift, middle, half, x, u)
        before, self.x, self.gap = self.gap, x, _gaps(model, end, x)
        q = crossing(before, self.gap, h * (pushed * pushed).sum(axis=-1))
        self.whole = (self.gap >= 0.0).all(axis=1)  # NaN is a violation
        self.kept *= np.where(self.whole, (1.0 - q).prod(axis=1), 0.0)
        lost = ~np.isfinite(x).all(axis=1)
        if lost.any():  # any finite state: their verdict stands
            self.x[lost], self.nodes[lost], self.kept[lost] = model.start, 0.0, 0.0

"""How often a controller breaks a constraint: paths of the non-linear equation, counted.

    x_{k+1} = x_k + dt_k b(t_k, x_k, u_k) + √dt_k σ(t_k, x_k) ξ_k,    u_k = control(t_k, x_k)

Euler–Maruyama on the planner's own nodes, from x_0 ~ N(start, Σ_0). Starts and noise are common
to all controllers: path i of a seed meets the same x_0 and ξ whoever drives and however many paths
are asked for, so two rates differ by what the controllers do, and a search over plans sees a
nearly monotone function.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from slipcar.planner.options import check_count
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
        blocks = [_violated(model, drive, seed, b) for b in range(-(-episodes // BLOCK))]
    return np.concatenate(blocks)[:episodes]


def _generator(seed: int, *key: int) -> np.random.Generator:
    # A spawned child, never SeedSequence((seed, block)): the paths of an evaluation come from
    # there, and a risk verified on the very paths it is later judged by would verify nothing.
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def _starts(model: Model, seed: int, block: int) -> Array:
    """x(0) of each path of a block, (BLOCK, n)."""
    x = np.tile(model.start, (BLOCK, 1))
    if model.start_covariance.any():
        # Of a stream of their own: the Brownian paths stay those of a known start.
        normal = _generator(seed, block, _START).standard_normal(x.shape)
        values, vectors = np.linalg.eigh(model.start_covariance)
        x += normal @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    return x


def _violated(
    model: Model, control: Callable[[float, Array], Array], seed: int, block: int
) -> Array:
    """Which paths of one block; always a whole one, (BLOCK,): results may round by its shape."""
    problem: Any = model.problem
    rng, x, m = _generator(seed, block), _starts(model, seed, block), model.control_dim
    violated = np.zeros(BLOCK, dtype=bool)
    for k, dt in enumerate(model.dt):
        t = np.full(BLOCK, model.times[k])  # one for each path: all functions are batched alike
        u = np.asarray(control(float(model.times[k]), x))
        if u.shape not in ((m,), (BLOCK, m)):
            raise ValueError(
                f"control(t, x) must have shape ({BLOCK}, {m}) for {BLOCK} states, or ({m},) for "
                f"all of them, not {u.shape}"
            )
        sigma = model.diffusion(t, x)
        noise = np.sqrt(dt) * rng.standard_normal((BLOCK, sigma.shape[-1]))
        moved = dt * model.drift(t, x, np.broadcast_to(u, (BLOCK, m)))
        x = x + moved + np.einsum("bij,bj->bi", sigma, noise)
        if not np.isfinite(x.sum()):  # a sum is cheap; only when it is not finite look closer
            lost = ~np.isfinite(x).all(axis=1)
            violated |= lost
            x[lost] = model.start  # any finite state: their verdict stands
        h = np.asarray(problem.constraint(np.full(BLOCK, model.times[k + 1]), x))
        if h.ndim != 2 or len(h) != BLOCK:
            raise ValueError(
                f"constraint(t, x) must have shape ({BLOCK}, p) for {BLOCK} states, not {h.shape}"
            )
        kept = h <= 0.0  # written so that NaN is a violation
        if not kept.all():
            violated |= ~kept.all(axis=1)
    return violated

"""Noisy paths of any problem under any control law, few and fast: the cloud round a plan.

    x_{k+1} = x_k + dt_k b(t_k, x_k, u_k) + √dt_k σ(t_k, x_k) ξ_k

Euler–Maruyama on the planner's nodes. The ξ of a path are the same in every picture, so what moves
while one drags is what dragging changed.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

#: How many paths a picture shows.
PATHS = 200


def cloud(
    problem: Any, control: Callable[[float, np.ndarray], np.ndarray], paths: int = PATHS
) -> np.ndarray:
    """States of the paths, (paths, N, n); those of a path that left the numbers are NaN.

    Args:
        problem: a :class:`slipcar.planner.Problem`.
        control: (t [s], states (paths, n)) -> controls (paths, m) or (m,), in physical units.
        paths: how many, ≥ 1.
    """
    times = np.asarray(problem.times, dtype=np.float64)
    start = np.asarray(problem.start, dtype=np.float64)
    x = np.repeat(start[None], paths, axis=0)
    spread = getattr(problem, "start_covariance", None)
    if spread is not None and np.any(spread):
        values, vectors = np.linalg.eigh(spread)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        x += _normal(paths, len(start), 1)[0] @ root.T
    controls = len(problem.control_weight)
    states = np.empty((paths, len(times), len(start)))
    states[:, 0] = x
    with np.errstate(all="ignore"):
        for k, dt in enumerate(np.diff(times)):
            t = np.full(paths, times[k])
            sigma = np.asarray(problem.diffusion(t, x))
            u = np.broadcast_to(control(float(times[k]), x), (paths, controls))
            xi = _normal(paths, sigma.shape[-1], len(times))[k]
            noise = np.einsum("pij,pj->pi", sigma, xi)
            x = x + dt * np.asarray(problem.drift(t, x, u)) + np.sqrt(dt) * noise
            states[:, k + 1] = x
    return states


def violated(problem: Any, states: np.ndarray) -> np.ndarray | None:
    """Which paths break `problem.constraint` at a node 1..N−1; None for a problem without one."""
    constraint = getattr(problem, "constraint", None)
    if constraint is None:
        return None
    times = np.broadcast_to(problem.times[1:], states[:, 1:].shape[:2])
    with np.errstate(all="ignore"):
        broken = ~(np.asarray(constraint(times, states[:, 1:])) <= 0.0)  # NaN is a violation
    return np.asarray(broken.any(axis=(1, 2)))


@functools.lru_cache(maxsize=16)
def _normal(paths: int, width: int, steps: int) -> np.ndarray:
    """Standard normal variates (steps, paths, width), read-only."""
    variates = np.random.default_rng((0, paths, width)).standard_normal((steps, paths, width))
    variates.setflags(write=False)
    return variates

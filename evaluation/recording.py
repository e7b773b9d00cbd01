"""Episodes as they happened, and what the controller meant to do at each node.

A controller that has plans can show them: by an optional method

    preview(state, row) -> states (k, n), covariances (k, n, n) or None

where `state` is what its `predict` returned and `row` an episode of that batch: the planned
states at the nodes ahead, of which the first two are the position [m].
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from slipcar.envs.overlay import Overlay
from slipcar.envs.scenario import Scenario
from slipcar.evaluation.rollout import BLOCK, Controller, sample_paths


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """Episodes of one controller in one world.

    Attributes:
        scenario: the world.
        states: (episodes, N, 5).
        overlays: what was meant at node k of episode i, `overlays[i][k]` for k = 0..N−2; None
            where the controller does not say, or was not asked.
    """

    scenario: Scenario
    states: np.ndarray
    overlays: tuple[tuple[Overlay | None, ...], ...]

    def overlay(self, episode: int, node: int) -> Overlay | None:
        """What was meant at a node; at the last, what was meant on the way there."""
        return self.overlays[episode][min(node, len(self.overlays[episode]) - 1)]

    def collided(self, episode: int, node: int) -> bool:
        """Whether the path has met an obstacle by this node."""
        so_far = self.states[episode, 1 : node + 1]
        return bool((self.scenario.signed_distance(so_far) < 0.0).any())


def overlay_of(controller: Any, state: Any = None, row: int = 0) -> Overlay | None:
    """What a controller means to do, as something to draw.

    Args:
        controller: any; those without a method `preview` do not say.
        state: the hidden state that its last `predict` returned.
        row: which episode of those `predict` was asked for.

    Raises:
        ValueError: if the preview is no path of finite states with semidefinite covariances.
    """
    preview = getattr(controller, "preview", None)
    if not callable(preview):
        return None
    states, covariances = preview(state, row)
    return Overlay(states, None if covariances is None else np.asarray(covariances)[:, :2, :2])


def record(
    controller: Controller,
    scenario: Scenario | str,
    episodes: int,
    seed: int = 0,
    *,
    overlay: bool = True,
) -> Recording:
    """Drive the first episodes of an evaluation and keep what is needed to film them.

    Args:
        controller: who drives.
        scenario: a scenario or the name of one.
        episodes: how many, 1 to 1024.
        seed: of the Brownian paths, ≥ 0.
        overlay: whether to ask the controller what it means to do.

    Raises:
        ValueError: as `slipcar.evaluation.rollout`, for more episodes, or for a bad preview.
    """
    scenario = Scenario.of(scenario)
    if episodes > BLOCK:
        raise ValueError(f"episodes must be at most {BLOCK} to be recorded, not {episodes}")
    if not overlay or not callable(getattr(controller, "preview", None)):
        states, _ = sample_paths(controller, scenario, episodes, seed)
        return Recording(scenario, states, ((None,),) * episodes)
    asked = _Asked(controller, episodes)
    states, _ = sample_paths(asked, scenario, episodes, seed)
    return Recording(scenario, states, tuple(tuple(meant) for meant in asked.overlays))


class _Asked:
    """The controller itself, asked after each `predict` what it means to do."""

    def __init__(self, controller: Controller, episodes: int) -> None:
        self._controller = controller
        self._chunk = int(getattr(controller, "rows", BLOCK))
        self._chunks = -(-episodes // self._chunk)
        self._calls = 0
        self._constant: Overlay | None = None
        self.overlays: list[list[Overlay | None]] = [[] for _ in range(episodes)]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._controller, name)

    def predict(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, Any]:
        action, state = self._controller.predict(*args, **kwargs)
        first = self._calls % self._chunks * self._chunk
        self._calls += 1
        for row, meant in enumerate(self.overlays[first : first + self._chunk]):
            meant.append(self._overlay(state, row))
        return action, state

    def _overlay(self, state: Any, row: int) -> Overlay | None:
        if state is not None:
            return overlay_of(self._controller, state, row)
        # Nothing is remembered, so nothing changes; and the same object is drawn only once.
        if self._constant is None:
            self._constant = overlay_of(self._controller, None, row)
        return self._constant

"""The episodes that a policy is judged by while it learns: always the same, and none of training's.

Of a scenario: noise of its own. Of a family: worlds of its own as well, one for each episode,
which are neither drawn for training nor in the held-out test (:mod:`slipcar.envs.families`).
"""

from __future__ import annotations

from slipcar.envs import Family, Scenario
from slipcar.envs.sources import Source

#: First seed of the validation episodes' noise, and first number of a family's worlds.
VALIDATION_SEED = 1_000_000_000


def validation_worlds(source: Source, episodes: int) -> Source | list[Scenario]:
    """What `score` is to drive in: the scenario, or as many worlds of the family as episodes."""
    if not isinstance(source, Family):
        return source
    return [source.sample(VALIDATION_SEED + i) for i in range(episodes)]

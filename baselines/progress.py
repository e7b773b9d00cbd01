"""What a training run tells its caller on the way."""

from __future__ import annotations

import dataclasses

from slipcar.baselines.score import Score


@dataclasses.dataclass(frozen=True)
class Progress:
    """Where training stands after an iteration.

    Attributes:
        iteration: how many are done.
        steps: environment steps done.
        total_steps: environment steps in all.
        seconds: training time so far, all sessions together.
        validation: the last evaluation of this session, if there was one.
    """

    iteration: int
    steps: int
    total_steps: int
    seconds: float
    validation: Score | None

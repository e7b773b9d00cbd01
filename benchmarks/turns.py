"""Timing by turns: every contender once a round, so that a busy machine is busy for all.

A turn begins with a call that is not counted, where a call is short: the caches hold what the
last contender left, and a worker process has slept.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from contenders import Answer, Contender
from rich.console import Console
from rich.progress import track

#: Rounds, unless told otherwise.
ROUNDS = 100
#: A contender that has taken so many seconds after so many runs sits the other rounds out.
_ENOUGH_SECONDS, _ENOUGH_RUNS = 4.0, 5
#: A call of less than this is short.
_SHORT = 0.05


@dataclasses.dataclass(frozen=True)
class Timing:
    """What one contender did.

    Attributes:
        contender: who.
        answer: of the last run.
        seconds: of every timed run, (runs,); a run makes `contender.plans` plans.
    """

    contender: Contender
    answer: Answer
    seconds: np.ndarray

    @property
    def ms(self) -> tuple[float, float, float]:
        """Lower quartile, median and upper quartile of a plan [ms]."""
        per_plan = self.seconds / self.contender.plans
        low, median, high = 1e3 * np.quantile(per_plan, [0.25, 0.5, 0.75])
        return float(low), float(median), float(high)

    def columns(self) -> dict[str, Any]:
        """The columns every table of times has."""
        low, median, high = self.ms
        return {
            "ms (median)": median,
            "quartiles": f"{low:.3g}–{high:.3g}",
            "fastest": 1e3 * float(self.seconds.min()) / self.contender.plans,
        }


def take_turns(contenders: Sequence[Contender], rounds: int, title: str) -> list[Timing]:
    """Time all of them in turns, in an order drawn anew each round.

    The first call of each is not counted: it imports, compiles and allocates.
    """
    console = Console(stderr=True)
    answers: list[Answer] = []
    for contender in track(contenders, f"{title}: warming up", console=console):
        answers.append(contender.solve()[1])
    seconds: list[list[float]] = [[] for _ in contenders]
    rng = np.random.default_rng(0)
    for _ in track(range(rounds), f"{title}: in turns", console=console):
        for i in rng.permutation(len(contenders)):
            if len(seconds[i]) >= _ENOUGH_RUNS and sum(seconds[i]) > _ENOUGH_SECONDS:
                continue
            if not seconds[i] or seconds[i][-1] < _SHORT:
                contenders[i].solve()
            took, answers[i] = contenders[i].solve()
            seconds[i].append(took)
    return [
        Timing(contender, answer, np.array(took))
        for contender, answer, took in zip(contenders, answers, seconds, strict=True)
    ]

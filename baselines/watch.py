"""What is kept of a run while it learns: scores on the way, the best policy, the time it took."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

from slipcar.baselines.checkpoint import versions
from slipcar.baselines.policy import Policy
from slipcar.baselines.score import Score, score
from slipcar.baselines.validation import VALIDATION_SEED, validation_worlds
from slipcar.envs.sources import Source


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A policy met on the way.

    Attributes:
        policy: its actor.
        steps: environment steps after which it stood.
        validation: its score on the validation episodes.
    """

    policy: Policy
    steps: int
    validation: Score

    def record(self) -> dict[str, Any]:
        """When it stood and what it scored, as plain data."""
        return {"steps": self.steps, "validation": dataclasses.asdict(self.validation)}


class Watch:
    """Looks at a policy from time to time, always on the same episodes.

    Attributes:
        best: the candidate with the lowest validation cost so far.
        latest: the last one looked at in this session.
        history: of every look so far, all sessions together: `steps`, `seconds` and
            `cpu_seconds` until then (what looking takes included), `total`, `collision_rate`.

    Args:
        source: a scenario, or a family.
        episodes: of one look.
    """

    def __init__(self, source: Source, episodes: int) -> None:
        self.best: Candidate | None = None
        self.latest: Candidate | None = None
        self.history: list[dict[str, Any]] = []
        self._episodes = episodes
        self._worlds = validation_worlds(source, episodes)
        self._began, self._began_cpu = time.perf_counter(), time.process_time()

    @property
    def seconds(self) -> float:
        """Training time so far, all sessions together."""
        return time.perf_counter() - self._began

    @property
    def cpu_seconds(self) -> float:
        """Processor time so far, all sessions together: what other programs do does not count."""
        return time.process_time() - self._began_cpu

    def go_on(
        self,
        seconds: float,
        cpu_seconds: float,
        history: list[dict[str, Any]],
        best: Candidate | None,
    ) -> None:
        """Stand where an earlier session left off."""
        self._began -= seconds
        self._began_cpu -= cpu_seconds
        self.history, self.best = list(history), best

    def take_up(self, initial: Policy) -> int:
        """Let the training of the policy that is started from count; its steps."""
        wall, cpu = (float(initial.training.get(n, 0.0)) for n in ("seconds", "cpu_seconds"))
        self.go_on(wall, cpu, [], None)
        return int(initial.training.get("steps", 0))

    def judge(self, policy: Policy, steps: int) -> Candidate:
        """The candidate that this policy is; nothing is kept of it."""
        found = score(policy, self._worlds, self._episodes, VALIDATION_SEED)
        return Candidate(policy, steps, found)

    def look(self, policy: Policy, steps: int) -> Candidate:
        """Judge a policy and keep what came of it."""
        self.latest = found = self.judge(policy, steps)
        self.history.append(
            {
                "steps": steps,
                "seconds": round(self.seconds, 2),
                "cpu_seconds": round(self.cpu_seconds, 2),
                "total": found.validation.total,
                "collision_rate": found.validation.collision_rate,
            }
        )
        if self.best is None or found.validation.total < self.best.validation.total:
            self.best = found
        return found

    def finish(self, latest: Candidate, shared: dict[str, Any]) -> dict[str, Policy]:
        """The `last` policy and the `best`, with their records.

        Args:
            latest: the last one.
            shared: what is to be recorded of both: algorithm, configuration, seed, ...
        """
        policies = {}
        best = self.best or latest
        for selected, candidate in (("last", latest), ("best", best)):
            record = {
                **shared,
                "seconds": round(self.seconds, 1),
                "cpu_seconds": round(self.cpu_seconds, 1),
                "versions": versions(),
                "selected": selected,
                **candidate.record(),
                "validation_seed": VALIDATION_SEED,
                "history": self.history,
            }
            policies[selected] = dataclasses.replace(candidate.policy, training=record)
        return policies

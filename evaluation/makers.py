"""Rows that plan for the world they are put in: functions of a scenario that make a controller.

A suite has many worlds, and workers plan for them. A maker is therefore plain data: it can be
sent anywhere, and its `fingerprint` identifies what it will make.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from slipcar import baselines
from slipcar.envs.scenario import Scenario
from slipcar.evaluation.controller import Controller
from slipcar.planner import Feedback, OpenLoop, RecedingHorizon, plan


def chargeable(scenario: Scenario, variance_weight: float = 1.0) -> float:
    """The weight itself, or 0 where the slip depends on states that are uncertain (§6.1)."""
    uncertain = scenario.process_noise[3:].any() or scenario.start_deviation[3:].any()
    return 0.0 if uncertain else variance_weight


def _straight(scenario: Scenario) -> Controller:
    return baselines.straight(scenario)


def _deterministic(scenario: Scenario, **options: Any) -> Controller:
    return OpenLoop(baselines.deterministic_scp(scenario, **options))


def _stochastic(scenario: Scenario, variance_weight: float = 1.0, **options: Any) -> Controller:
    return OpenLoop(
        plan(scenario, variance_weight=chargeable(scenario, variance_weight), **options)
    )


def _tracked(scenario: Scenario, variance_weight: float = 1.0, **options: Any) -> Controller:
    return Feedback(
        plan(scenario, variance_weight=chargeable(scenario, variance_weight), **options)
    )


def _chance(scenario: Scenario, risk: float) -> Controller:
    return OpenLoop(plan(scenario, risk=risk))


def _steered(scenario: Scenario, **options: Any) -> Controller:
    return Feedback(plan(scenario, feedback=True, **options))


def _receding(scenario: Scenario, **options: Any) -> Controller:
    return RecedingHorizon(scenario, **options)


def _shipped(scenario: Scenario) -> Controller:
    return baselines.load_policy()


#: Kind of row -> what makes it.
KINDS: dict[str, Callable[..., Controller]] = {
    "straight": _straight,
    "deterministic": _deterministic,
    "stochastic": _stochastic,
    "feedback": _tracked,
    "chance": _chance,
    "planned-feedback": _steered,
    "receding": _receding,
    "ppo": _shipped,
}


@dataclasses.dataclass(frozen=True)
class Maker:
    """Makes a row's controller for any scenario.

    Attributes:
        kind: one of :data:`KINDS`.
        options: of the planner, as (name, value) pairs, so that a maker is hashable.
    """

    kind: str
    options: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, kind: str, **options: Any) -> Maker:
        """A maker with these options of the planner.

        Raises:
            ValueError: for an unknown kind.
        """
        if kind not in KINDS:
            raise ValueError(f"unknown kind of row {kind!r}; known: {list(KINDS)}")
        return cls(kind, tuple(sorted(options.items())))

    def __call__(self, scenario: Scenario) -> Controller:
        """The controller for this scenario."""
        return KINDS[self.kind](scenario, **dict(self.options))

    def fingerprint(self) -> str:
        """Identifies what it makes, given the scenario and the code."""
        return f"{self.kind}{dict(self.options)}"

"""The record of a reproduction: plans, what their paths did, and how many were driven.

:class:`slipcar.evaluation.reproduction.reproduce.Reproduction` is one that can also write itself
as tables and figures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from slipcar.envs.scenario import Scenario
from slipcar.evaluation.metrics import Result
from slipcar.evaluation.reproduction.runs import Agreement, PathMoments, Rate, Run
from slipcar.planner.display import brief

#: Paths of the paper.
PAPER_EPISODES = 10_000


@dataclasses.dataclass(frozen=True)
class ReproductionRecord:
    """What was computed.

    Attributes:
        scenario: the paper's.
        episodes: a run.
        seed: of the Brownian paths, common to all.
        runs: by the names of :data:`slipcar.evaluation.reproduction.runs.PLANS`.
        paper: our plan on as many paths as the paper drove.
        moments: of our plan's paths.
        sweep: clearance [m] -> what the plan with it does.
        agreement: with the reference arrays, by part; empty without the file.
        solvers: see :func:`slipcar.evaluation.reproduction.runs.backends`.
        provenance: versions, machine, date, commit.
    """

    scenario: Scenario
    episodes: int
    seed: int
    runs: Mapping[str, Run]
    paper: Result
    moments: PathMoments
    sweep: Mapping[float, Rate]
    agreement: Mapping[str, Agreement]
    solvers: Mapping[str, Mapping[str, Any]]
    provenance: Mapping[str, Any]

    __repr__ = brief

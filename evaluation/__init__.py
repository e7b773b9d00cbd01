"""The comparison: every controller over the same Brownian paths, with honest intervals.

    r = evaluate(OpenLoop(p), scenario, episodes=10_000, seed=0)
    c = compare({"SCP": OpenLoop(p), "PPO": policy}, scenario, episodes=10_000, seed=0)
    c.frame, c.to_markdown(), c.save("results/mine")

The command line `slipcar compare|frontier|plan|simulate|train|dataset` is
:mod:`slipcar.evaluation.cli`.
"""

from slipcar.evaluation.compare import Comparison, compare
from slipcar.evaluation.controller import Controller
from slipcar.evaluation.metrics import EpisodeMetrics, Result
from slipcar.evaluation.rollout import evaluate, sample_paths

__all__ = [
    "Comparison",
    "Controller",
    "EpisodeMetrics",
    "Result",
    "compare",
    "evaluate",
    "sample_paths",
]

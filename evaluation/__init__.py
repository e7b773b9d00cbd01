"""The comparison: every controller over the same Brownian paths, with honest intervals.

    r = evaluate(OpenLoop(p), scenario, episodes=10_000, seed=0)
    c = compare({"SCP": OpenLoop(p), "PPO": policy}, scenario, episodes=10_000, seed=0)
    c.frame, c.to_markdown(), c.save("results/mine")

The command line `slipcar compare|frontier|plan|simulate|train|dataset` is
:mod:`slipcar.evaluation.cli`.
"""

from slipcar.evaluation.compare import Comparison, compare, evaluate
from slipcar.evaluation.metrics import EpisodeMetrics, Result
from slipcar.evaluation.rollout import Controller, rollout, sample_paths

__all__ = [
    "Comparison",
    "Controller",
    "EpisodeMetrics",
    "Result",
    "compare",
    "evaluate",
    "rollout",
    "sample_paths",
]

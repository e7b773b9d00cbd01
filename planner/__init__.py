"""Stochastic sequential convex programming: plans for stochastic control problems.

    from slipcar.planner import plan, OpenLoop, Feedback
    p = plan(problem)                    # any object that satisfies Problem
    action, _ = OpenLoop(p).predict(observation)

Needs NumPy and SciPy alone; with llvmlite it runs as machine code made from your functions. The
`osqp` and `cvxpy` backends import their packages when used.
"""

from slipcar.planner.batch import plan_batch
from slipcar.planner.controllers import Feedback, OpenLoop
from slipcar.planner.extremal.certificate import Certificate
from slipcar.planner.plan import Plan
from slipcar.planner.planning import plan
from slipcar.planner.problem.protocol import Problem
from slipcar.planner.receding_horizon import RecedingHorizon
from slipcar.planner.records import Alternative, ExpectedCost, Iteration, Multipliers, TimeStep
from slipcar.planner.search.risk import Risk
from slipcar.planner.status import Status

__all__ = [
    "Alternative",
    "Certificate",
    "ExpectedCost",
    "Feedback",
    "Iteration",
    "Multipliers",
    "OpenLoop",
    "Plan",
    "Problem",
    "RecedingHorizon",
    "Risk",
    "Status",
    "TimeStep",
    "plan",
    "plan_batch",
]
